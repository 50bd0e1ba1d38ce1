"""Node `odometry`: relative motions with covariance, from an odometry or, in simulation, from the true poses.

Noise can be added, so that one recording serves for many runs: the same seed and the same messages give the
same motions.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from calibslam_msgs.msg import RelativePose
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from calibslam_backend.odometry.motion_chain import OdometryDifferencer
from calibslam_msgs_py.conversions import (
    RosTypes,
    motion_to_msg,
    odometry_from_msg,
    stamped_pose_from_msg,
)
from calibslam_msgs_py.measurements import InvalidMeasurement, RelativeMotion
from calibslam_msgs_py.node import MEASUREMENT, MEASUREMENT_INPUT, Counters, advertise, run
from calibslam_msgs_py.node_subscription import Subscription
from calibslam_msgs_py.settings import Settings, SettingsError, declare_parameters, setting
from calibslam_sim.simulation.odometry_noise import OdometryNoise, add_noise
from calibslam_sim.simulation.random_streams import stream

CAMERA_FRAME = "camera"  # whose pose the topic `ground_truth` is


@dataclass(frozen=True)
class OdometryNodeSettings(Settings):
    """Parameters of the node."""

    source: str = setting("odom", "topic to take poses from", choices=("odom", "ground_truth"))
    rotation_noise: float = setting(
        0.0, "standard deviation of the error added to each motion, about each axis", unit="rad", low=0.0
    )
    translation_noise: float = setting(
        0.0, "standard deviation of the error added to each motion, along each axis", unit="m", low=0.0
    )
    seed: int = setting(0, "of the added error", low=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source == "ground_truth" and (self.rotation_noise > 0.0) != (self.translation_noise > 0.0):
            raise SettingsError(
                "source ground_truth is exact: give it both rotation_noise and translation_noise, or neither "
                "(its covariance is then published as unknown)"
            )


class OdometryNode(Node):
    """odom or ground_truth -> relative_pose."""

    def __init__(self) -> None:
        super().__init__("odometry")
        settings = declare_parameters(self, OdometryNodeSettings)
        self._noise = OdometryNoise(settings.rotation_noise, settings.translation_noise)
        self._random = stream(settings.seed, "odometry node")
        self._differencer = OdometryDifferencer()
        self._types = RosTypes()
        self._counters = Counters(self)
        self._publisher = advertise(self, RelativePose, "relative_pose", MEASUREMENT)
        if settings.source == "odom":
            Subscription(self, self._counters, Odometry, "odom", self._receive_odometry, MEASUREMENT_INPUT)
        else:
            Subscription(self, self._counters, PoseStamped, "ground_truth", self._receive_truth, MEASUREMENT_INPUT)

    def _receive_odometry(self, message: Any) -> None:
        try:
            pose, velocity_covariance = odometry_from_msg(message)
            self._counters.arrived("odom", pose.stamp)
            motion = self._differencer.add(pose.stamp, pose.T, velocity_covariance, message.child_frame_id)
        except InvalidMeasurement as error:
            self._counters.reject(error)
            return
        if motion is not None:
            self._publish(motion)

    def _receive_truth(self, message: Any) -> None:
        try:
            pose = stamped_pose_from_msg(message)
            self._counters.arrived("ground_truth", pose.stamp)
            motion = self._differencer.add(pose.stamp, pose.T, frame_id=CAMERA_FRAME)
        except InvalidMeasurement as error:
            self._counters.reject(error)
            return
        if motion is not None:
            # Exact so far: the only error is the one added.
            self._publish(replace(motion, covariance=np.zeros((6, 6))))

    def _publish(self, motion: RelativeMotion) -> None:
        noisy = add_noise(motion, self._noise, self._random)
        self._publisher.publish(motion_to_msg(noisy, self._types))
        self._counters.count("motions")


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit code."""
    return run(OdometryNode, args)


if __name__ == "__main__":
    sys.exit(main())
