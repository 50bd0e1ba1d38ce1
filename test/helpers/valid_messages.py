"""One valid message of each type that is read somewhere, for rclpy or for bags."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_msgs_py import conversions as c
from calibslam_msgs_py.measurements import QuadricEstimate, StampedPose
from calibslam_msgs_py.message_types import MessageTypes

WORLD = SmallWorld(around(30), objects())
PIXELS = np.random.default_rng(3).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def boxes(types: MessageTypes) -> Any:
    return c.boxes_to_msg(WORLD.boxes()[0], types)


def motion(types: MessageTypes) -> Any:
    return c.motion_to_msg(WORLD.motions()[0], types)


def camera(types: MessageTypes) -> Any:
    return c.camera_to_msg(CAMERA, WORLD.stamps[0], types)


def odometry(types: MessageTypes) -> Any:
    pose = StampedPose(WORLD.stamps[1], WORLD.poses[1])
    return c.odometry_to_msg(pose, types, velocity=np.full(6, 0.1), velocity_covariance=np.eye(6) * 1e-4)


def pose(types: MessageTypes) -> Any:
    return c.stamped_pose_to_msg(StampedPose(WORLD.stamps[1], WORLD.poses[1]), "world", types)


def pose_with_covariance(types: MessageTypes) -> Any:
    stamped = StampedPose(WORLD.stamps[1], WORLD.poses[1])
    return c.pose_with_covariance_to_msg(stamped, np.eye(6) * 0.01, "map", types)


def quadrics(types: MessageTypes) -> Any:
    estimates = [
        QuadricEstimate(i, "cup", o.T_world_object, o.radii, np.eye(9) * 1e-3, 5) for i, o in enumerate(WORLD.objects)
    ]
    return c.quadrics_to_msg(WORLD.stamps[1], estimates, types)


def image(types: MessageTypes) -> Any:
    height, width, channels = PIXELS.shape
    return types("sensor_msgs/msg/Image")(
        header=c.header_to_msg(WORLD.stamps[1], "camera", types),
        height=height,
        width=width,
        encoding="rgb8",
        is_bigendian=0,
        step=width * channels,
        data=types.octets(PIXELS.tobytes()),
    )


def compressed(types: MessageTypes) -> Any:
    return types("sensor_msgs/msg/CompressedImage")(
        header=c.header_to_msg(WORLD.stamps[1], "camera", types),
        format="jpeg",
        data=types.octets(cv2.imencode(".jpg", PIXELS)[1].tobytes()),
    )


VALID: dict[str, Callable[[MessageTypes], Any]] = {
    "calibslam_msgs/msg/BoundingBoxArray": boxes,
    "calibslam_msgs/msg/RelativePose": motion,
    "calibslam_msgs/msg/QuadricArray": quadrics,
    "sensor_msgs/msg/CameraInfo": camera,
    "sensor_msgs/msg/Image": image,
    "sensor_msgs/msg/CompressedImage": compressed,
    "nav_msgs/msg/Odometry": odometry,
    "geometry_msgs/msg/PoseStamped": pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": pose_with_covariance,
}
