"""Node `record`: a subscriber of what the back end publishes, writing it to a bag until it is ended."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.serialization import serialize_message

from calibslam_backend.output.published import TOPICS
from calibslam_msgs_py.bags import BagError, BagWriter
from calibslam_msgs_py.conversions import RosTypes, stamp_from_msg
from calibslam_msgs_py.node import LATCHED, run
from calibslam_msgs_py.settings import Settings, SettingsError, declare_parameters, setting


@dataclass(frozen=True)
class RecordSettings(Settings):
    """Parameters of the node."""

    out: str = setting("run.mcap", "bag to write: a folder, or a file that ends in .mcap")


class RecordNode(Node):
    """The back end's topics -> a bag, at the times of the measurements behind them."""

    def __init__(self) -> None:
        super().__init__("record")
        settings = declare_parameters(self, RecordSettings)
        self._open = ExitStack()
        try:
            self._bag = self._open.enter_context(BagWriter(settings.out, overwrite=True))
        except BagError as error:
            raise SettingsError(str(error)) from error
        self._last_stamp = 0
        types = RosTypes()
        for topic, kind in TOPICS.items():
            self._bag.add_topic(self.resolve_topic_name(topic), kind)
            self.create_subscription(types(kind), topic, partial(self._receive, topic, kind), LATCHED)

    def _receive(self, topic: str, kind: str, message: Any) -> None:
        # Markers carry no header of their own.
        header = getattr(message, "header", None)
        if header is not None:
            self._last_stamp = stamp_from_msg(header.stamp)
        self._bag.write_raw(self.resolve_topic_name(topic), kind, serialize_message(message), self._last_stamp)

    def close(self) -> None:
        """Complete the bag."""
        self._open.close()


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit code."""
    return run(RecordNode, args)


if __name__ == "__main__":
    sys.exit(main())
