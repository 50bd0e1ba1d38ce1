"""Subscriptions of images, as reliable as who publishes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from calibslam_msgs_py.node import SENSOR

LOOK_PERIOD = 0.5  # [s] of wall time between two looks at the publishers
RELIABLE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE)


class SensorSubscription:
    """Best effort connects to every publisher, but loses most messages that are larger than a transport's buffers: raw
    images of 640 x 480 pixels are. So it becomes reliable where all publishers are.

    Args:
        node: that it belongs to.
        kind: class of the messages.
        topic: relative or absolute name.
        callback: takes a message.
    """

    def __init__(self, node: Node, kind: Any, topic: str, callback: Callable[[Any], None]) -> None:
        self._node, self._kind, self._topic, self._callback = node, kind, topic, callback
        self._reliable = False
        self._subscription = node.create_subscription(kind, topic, callback, SENSOR)
        self._timer = node.create_timer(LOOK_PERIOD, self._match, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _match(self) -> None:
        publishers = self._node.get_publishers_info_by_topic(self._subscription.topic_name)
        if not publishers:
            return
        reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
        if reliable != self._reliable:
            self._reliable = reliable
            self._node.destroy_subscription(self._subscription)
            profile = RELIABLE if reliable else SENSOR
            self._subscription = self._node.create_subscription(self._kind, self._topic, self._callback, profile)
