"""Where conversions take message classes from: rclpy live, rosbags offline (`bags.types`)."""

from __future__ import annotations

import array
import importlib
from typing import Any, Protocol

import numpy as np

from calibslam_msgs_py.measurements import Array


class MessageTypes(Protocol):
    """Builds messages of one library."""

    def __call__(self, name: str) -> Any:
        """The class of a message, e.g. "geometry_msgs/msg/Pose"; it is built with keyword arguments."""

    def doubles(self, values: Array) -> Any:
        """A float64[] field of variable length."""

    def octets(self, data: bytes) -> Any:
        """A uint8[] field of variable length."""


class RosTypes:
    """The message classes of the installed ROS packages, as rclpy publishes them."""

    def __init__(self) -> None:
        self._classes: dict[str, Any] = {}

    def __call__(self, name: str) -> Any:
        if name not in self._classes:
            package, kind, message = name.split("/")
            self._classes[name] = getattr(importlib.import_module(f"{package}.{kind}"), message)
        return self._classes[name]

    def doubles(self, values: Array) -> array.array[float]:
        return array.array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())

    def octets(self, data: bytes) -> array.array[int]:
        # rclpy copies an array.array at once, any other sequence number by number (120 ms per image).
        return array.array("B", data)
