"""Names of topics and frames in bags, and the odometry as it stands there."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from calibslam_backend import recording
from calibslam_msgs_py.conversions import odometry_to_msg
from calibslam_msgs_py.measurements import Array, StampedPose
from calibslam_msgs_py.message_types import MessageTypes

DETECTIONS, DETECTIONS_WITHOUT_COVARIANCE = recording.BOXES, recording.RAW_BOXES
CAMERA_INFO, ODOMETRY, GROUND_TRUTH = recording.CAMERA, recording.ODOMETRY, recording.GROUND_TRUTH
IMAGE = "/camera/image_raw/compressed"
RAW_IMAGE = "/camera/image_raw"
DEPTH = "/camera/depth/image_raw"
COMPRESSED_DEPTH = "/camera/depth/image_raw/compressedDepth"
GROUND_TRUTH_QUADRICS = recording.TRUE_OBJECTS

WORLD = "world"  # frame of the ground truth


def odometry_msgs(poses: list[StampedPose], step_covariance: Array | None, types: MessageTypes) -> list[Any]:
    """nav_msgs/Odometry of each pose; its twist is the constant velocity of the step from the one before.

    Args:
        poses: of the body in the odometry frame.
        step_covariance: (6, 6) of each step, [rotation, translation] in the body; None: unknown.
        types: message classes.
    """
    messages = []
    for k, pose in enumerate(poses):
        velocity, covariance = np.zeros(6), None
        if k > 0:
            seconds = (pose.stamp - poses[k - 1].stamp) * 1e-9
            step = np.linalg.inv(poses[k - 1].T) @ pose.T
            velocity = gtsam.Pose3.Logmap(gtsam.Pose3(step)) / seconds
            covariance = None if step_covariance is None else step_covariance / seconds**2
        messages.append(odometry_to_msg(pose, types, velocity=velocity, velocity_covariance=covariance))
    return messages
