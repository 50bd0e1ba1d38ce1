"""How long after the boxes of an image the pose comes that they lead to, while a recording is played in real time.

    ./calibslam shell -c 'python test/benchmarks/live_delay.py [RECORDING] [--rate 1]'

RECORDING is a bag or a folder in TUM format (default: fr3_office of the shared data). From publishing the boxes to
receiving `pose`, between two processes. Targets: median 15 ms, 99 % 60 ms. Times depend on what else the machine does.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

import helpers_on_path  # noqa: F401
from geometry_msgs.msg import PoseWithCovarianceStamped
from live import Watcher, random_domain, wait_until
from live_graph import DATA, Player, backend, cpu_seconds, quantiles, recording_of

from calibslam_msgs_py.conversions import stamp_from_msg
from calibslam_msgs_py.node import LATCHED


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path, default=DATA / "fr3_office", metavar="RECORDING")
    parser.add_argument("--rate", type=float, default=1.0, help="times real time (default: 1)")
    arguments = parser.parse_args()
    domain, received = random_domain(), dict[int, float]()

    def receive(message: Any) -> None:
        received.setdefault(stamp_from_msg(message.header.stamp), time.monotonic())

    with (
        recording_of(arguments.recording) as recording,
        Watcher(domain) as watcher,
        backend(domain) as process,
    ):
        watcher.node.create_subscription(PoseWithCovarianceStamped, "pose", receive, LATCHED)
        player = Player(watcher, recording.camera)
        wait_until(lambda: watcher.counts("/backend"), lambda: process.output)
        before, began = cpu_seconds(process.pid), time.monotonic()
        player.play(list(recording.measurements()), arguments.rate)
        cpu, wall = cpu_seconds(process.pid) - before, time.monotonic() - began
        time.sleep(2.0)  # the last diagnostics
        counts = watcher.counts("/backend")
        process.end()
    delays = {
        stamp: 1e3 * (at - player.published[stamp]) for stamp, at in received.items() if stamp in player.published
    }
    print(f"{len(delays)} poses in {wall:.0f} s, load of the machine {os.getloadavg()[0]:.1f}")
    print(f"from boxes to pose [ms]: {quantiles(list(delays.values()))}")
    at_once = [delay for stamp, delay in delays.items() if stamp in player.known]
    print(f"the {len(at_once)} of them whose odometry was there: {quantiles(at_once)}")
    inside = {key: counts.get(key) for key in ("delay_ms_p50", "delay_ms_p99", "update_ms_p50", "update_ms_p99")}
    print(f"inside the node: {inside}")
    print(f"share of one core: {cpu / wall:.0%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
