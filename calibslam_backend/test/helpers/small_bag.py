"""A bag of the small world, and its messages to spoil."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_msgs_py import bags
from calibslam_msgs_py import conversions as c
from calibslam_msgs_py.bags import BagWriter
from calibslam_msgs_py.measurements import StampedPose

WORLD = SmallWorld(around(110), objects())
Message = tuple[str, int, Any]  # topic, log time [ns], message of `bags.types`


def messages(world: SmallWorld = WORLD, odometry: bool = False) -> Iterator[Message]:
    """What a recording of the world holds, in order; `odometry`: poses on /odom instead of relative motions."""
    types = bags.types
    motions, T_odom_camera = world.motions(), np.eye(4)
    for k, boxes in enumerate(world.boxes()):
        stamp = boxes.stamp
        if odometry:
            T_odom_camera = T_odom_camera @ motions[k - 1].T_start_end if k else T_odom_camera
            pose = StampedPose(stamp, T_odom_camera)
            yield "/odom", stamp, c.odometry_to_msg(pose, types, velocity=np.zeros(6))
        elif k:
            yield "/relative_pose", stamp, c.motion_to_msg(motions[k - 1], types)
        yield "/camera/camera_info", stamp, c.camera_to_msg(CAMERA, stamp, types)
        yield "/ground_truth", stamp, c.stamped_pose_to_msg(StampedPose(stamp, world.poses[k]), "world", types)
        yield "/detections", stamp, c.boxes_to_msg(boxes, types)


def write(path: Path, content: Iterator[Message] | list[Message]) -> Path:
    """A bag with these messages."""
    with BagWriter(path) as bag:
        for topic, stamp, message in content:
            bag.write(topic, message, stamp)
    return path
