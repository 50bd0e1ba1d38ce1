"""The transform map -> odom, where the installation has tf2_msgs (the Python wheels of ROS have not)."""

from __future__ import annotations

from bisect import bisect_left
from typing import Any

import numpy as np

from calibslam_msgs_py.measurements import Array


def map_to_odom(T_map_body: Array, T_odom_body: Array) -> Array:
    """(4, 4) T_map_odom: what odometry has to be moved by so that the body is where the map says."""
    return T_map_body @ np.linalg.inv(T_odom_body)


class OdometryHistory:
    """The last poses of an odometry topic, to be looked up by time."""

    LENGTH = 2000

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._poses: list[Array] = []

    def add(self, stamp: int, T_odom_body: Array) -> None:
        """A newer pose; if time went back, the ones before are forgotten."""
        if self._stamps and stamp <= self._stamps[-1]:
            self._stamps.clear()
            self._poses.clear()
        self._stamps.append(stamp)
        self._poses.append(T_odom_body)
        if len(self._stamps) > self.LENGTH:
            del self._stamps[: self.LENGTH // 2], self._poses[: self.LENGTH // 2]

    def nearest(self, stamp: int) -> Array | None:
        """The pose nearest in time; None if there is none."""
        if not self._stamps:
            return None
        i = bisect_left(self._stamps, stamp)
        candidates = [n for n in (i - 1, i) if 0 <= n < len(self._stamps)]
        return self._poses[min(candidates, key=lambda n: abs(self._stamps[n] - stamp))]


class MapToOdom:
    """Publishes /tf; does nothing where tf2_msgs is not installed."""

    def __init__(self, node: Any, map_frame: str) -> None:
        self._history = OdometryHistory()
        self._map_frame, self._odom_frame = map_frame, "odom"
        self._publisher = None
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            node.get_logger().info("tf2_msgs is not installed: map -> odom is not published on /tf")
            return
        from nav_msgs.msg import Odometry

        from calibslam_msgs_py.node import MEASUREMENT_INPUT

        self._publisher = node.create_publisher(TFMessage, "/tf", 100)
        node.create_subscription(Odometry, "odom", self._receive, MEASUREMENT_INPUT)

    def _receive(self, message: Any) -> None:
        from calibslam_msgs_py.conversions import odometry_from_msg
        from calibslam_msgs_py.measurements import InvalidMeasurement

        try:
            pose, _ = odometry_from_msg(message)
        except InvalidMeasurement:
            return  # the odometry node counts and reports it
        self._odom_frame = message.header.frame_id or self._odom_frame
        self._history.add(pose.stamp, pose.T)

    def publish(self, stamp: int, T_map_body: Array) -> None:
        """The transform that puts the body where the map says, at a time [ns]."""
        T_odom_body = self._history.nearest(stamp)
        if self._publisher is None or T_odom_body is None:
            return
        from geometry_msgs.msg import Transform, TransformStamped
        from tf2_msgs.msg import TFMessage

        from calibslam_msgs_py.conversions import RosTypes, header_to_msg, pose_to_msg

        pose = pose_to_msg(map_to_odom(T_map_body, T_odom_body), RosTypes())
        transform = TransformStamped(
            header=header_to_msg(stamp, self._map_frame, RosTypes()), child_frame_id=self._odom_frame
        )
        transform.transform = Transform(rotation=pose.orientation)
        transform.transform.translation.x = pose.position.x
        transform.transform.translation.y = pose.position.y
        transform.transform.translation.z = pose.position.z
        self._publisher.publish(TFMessage(transforms=[transform]))
