"""`save_map`: asks a running back end to write its map, and waits until it has."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import rclpy
from calibslam_msgs.srv import SaveMap
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from calibslam_msgs_py.command import INTERRUPTED, ArgumentParser


class SaveError(Exception):
    """The map was not written; the text says why."""


def save_map(backend: str, path: Path, timeout: float) -> str:
    """Call the service; returns what the back end says.

    Raises:
        SaveError: there is no such back end, it does not answer in time [s], or it could not save.
    """
    end = time.monotonic() + timeout
    node = rclpy.create_node("save_map", start_parameter_services=False)
    try:
        client = node.create_client(SaveMap, f"{backend}/save_map")
        if not client.wait_for_service(timeout_sec=timeout):
            raise SaveError(f"no back end offers {backend}/save_map; is it running? (--backend names another)")
        future = client.call_async(SaveMap.Request(path=str(path.absolute())))
        rclpy.spin_until_future_complete(node, future, timeout_sec=max(end - time.monotonic(), 0.0))
        if not future.done():
            raise SaveError(f"{backend} has not answered within {timeout:g} s")
        answer = future.result()
        if not answer.success:
            raise SaveError(answer.message)
        return str(answer.message)
    finally:
        node.destroy_node()


def main(args: Sequence[str] | None = None) -> int:
    """Command line of `save_map`; returns the exit code."""
    parser = ArgumentParser(prog="save_map", description=__doc__)
    parser.add_argument("path", type=Path, metavar="FILE", help="map file to write, e.g. run/map.json")
    parser.add_argument("--backend", default="/backend", metavar="NODE", help="(default: /backend)")
    parser.add_argument("--timeout", type=float, default=60.0, metavar="S", help="(default: 60)")
    argv = list(sys.argv if args is None else ["save_map", *args])
    arguments = parser.parse_args(remove_ros_args(argv)[1:])
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, signal.default_int_handler)
    try:
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
        print(save_map(arguments.backend, arguments.path, arguments.timeout))
    except KeyboardInterrupt:
        return INTERRUPTED  # nothing was saved
    except SaveError as error:
        print(f"save_map: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
