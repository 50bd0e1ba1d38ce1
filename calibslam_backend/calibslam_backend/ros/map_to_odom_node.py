"""The transform map -> odom, where the installation has tf2_msgs (the Python wheels of ROS have not).

tf2 does not extrapolate: between two keyframes, look-ups of the present would fail. So the last transform is published
again with each odometry message, dated a little ahead, as nodes that localise do (REP 105; AMCL's transform_tolerance).
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from calibslam_backend.geometry.transform import on_the_way
from calibslam_backend.session.intake import Report
from calibslam_backend.session.time_guard import TimeGuard
from calibslam_msgs_py.conversions import RosTypes, odometry_from_msg
from calibslam_msgs_py.geometry_conversions import transform_to_msg
from calibslam_msgs_py.measurements import SECOND, Array, InvalidMeasurement, StampedPose
from calibslam_msgs_py.node import MEASUREMENT_INPUT

# Of whatever publisher: the transform bears that some are lost.
ODOMETRY_INPUT = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=MEASUREMENT_INPUT.depth, reliability=ReliabilityPolicy.BEST_EFFORT
)


def map_to_odom(T_map_body: Array, T_odom_body: Array) -> Array:
    """(4, 4) T_map_odom: what odometry has to be moved by so that the body is where the map says."""
    return T_map_body @ np.linalg.inv(T_odom_body)


class OdometryHistory:
    """The last poses of an odometry topic, to be looked up by time; for one thread."""

    KEPT = 30 * SECOND  # images wait for their detector and their turn; at 1 kHz these are 8 MB
    LARGEST_STEP = SECOND // 2  # at 1 m/s² a body is at most 0.03 m from the geodesic between two poses

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._poses: list[Array] = []

    @property
    def end(self) -> int | None:
        """Time of the newest pose [ns]."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp: int, T_odom_body: Array) -> bool:
        """A newer pose; whether it goes on from the one before, without a gap.

        One that comes twice, or a little late, is left out. If time went back, the poses before are forgotten.
        """
        end = self.end
        if end is not None and stamp <= end:
            if stamp > end - TimeGuard.LATE:
                return False
            self._stamps.clear()
            self._poses.clear()
        self._stamps.append(stamp)
        self._poses.append(T_odom_body)
        old = bisect_left(self._stamps, stamp - self.KEPT)
        del self._stamps[:old], self._poses[:old]
        return end is not None and end < stamp <= end + self.LARGEST_STEP

    def at(self, stamp: int) -> Array | None:
        """(4, 4) T_odom_body at a time [ns], interpolated along the geodesic; None outside what is kept and in gaps."""
        i = bisect_left(self._stamps, stamp)
        if i == len(self._stamps):
            return None
        end = self._stamps[i]
        if stamp == end:
            return self._poses[i]
        if i == 0 or end - self._stamps[i - 1] > self.LARGEST_STEP:
            return None
        start, before, after = self._stamps[i - 1], gtsam.Pose3(self._poses[i - 1]), gtsam.Pose3(self._poses[i])
        return np.asarray(on_the_way(before, after, (stamp - start) / (end - start)).matrix())


class MapToOdom:
    """Publishes /tf with each odometry message; does nothing where tf2_msgs is not installed.

    Args:
        node: that publishes and subscribes; all but `pose` belongs to the thread that calls it back.
        map_frame: name of the map's frame.
        tolerance: how far ahead [s] of odometry the transform is dated.
        report: who is told of poses without odometry.

    Attributes:
        pose: newest of the body in the map, from any thread; None: not known, and nothing is published.
    """

    def __init__(self, node: Any, map_frame: str, tolerance: float, report: Report) -> None:
        self.pose: StampedPose | None = None
        self._used: StampedPose | None = None  # the last one that was compared with odometry
        self._T_map_odom: StampedPose | None = None  # what came of it
        self._history = OdometryHistory()
        self._map_frame, self._odom_frame = map_frame, "odom"
        self._tolerance, self._report, self._types = int(tolerance * SECOND), report, RosTypes()
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            node.get_logger().info("tf2_msgs is not installed: map -> odom is not published on /tf")
            return
        from nav_msgs.msg import Odometry

        self._publisher = node.create_publisher(TFMessage, "/tf", 100)
        node.create_subscription(Odometry, "odom", self._receive, ODOMETRY_INPUT)

    def _receive(self, message: Any) -> None:
        try:
            odometry, _ = odometry_from_msg(message)
        except InvalidMeasurement:
            return  # the odometry node counts and reports it
        goes_on = self._history.add(odometry.stamp, odometry.T)
        self._odom_frame = message.header.frame_id or self._odom_frame
        self._compare()
        # tf2 warns of stamps that come twice, and a single one far ahead would have it forget all before.
        if goes_on and self._T_map_odom is not None:
            dated = replace(self._T_map_odom, stamp=odometry.stamp + self._tolerance)
            self._publisher.publish(transform_to_msg(dated, self._map_frame, self._odom_frame, self._types))

    def _compare(self) -> None:
        """Use the pose in the map, if it is a new one and odometry has come so far."""
        pose, now = self.pose, self._history.end
        assert now is not None
        if pose is None or (self._T_map_odom is not None and self._T_map_odom.stamp > now):  # time went back
            self._T_map_odom = None
        if pose is None or pose is self._used or pose.stamp > now:
            return
        self._used = pose
        T_odom_body = self._history.at(pose.stamp)
        if T_odom_body is None:
            self._report.reject(InvalidMeasurement("odom_gap", f"map -> odom: no odometry around {pose.stamp} ns"))
            return
        self._T_map_odom = StampedPose(pose.stamp, map_to_odom(pose.T, T_odom_body))
