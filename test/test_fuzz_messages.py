"""Messages spoilt at random, in their fields and in their bytes: each is used or refused by name, and no node ends.

A share of it in every run. All of it, which takes some minutes and differs from run to run:

    CALIBSLAM_FUZZ=full ./calibslam test test/test_fuzz_messages.py test/test_fuzz_bags.py
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest
from fuzzing import fuzz
from mutations import spoilt_bytes, spoilt_message
from rclpy.serialization import deserialize_message, serialize_message
from valid_messages import VALID, WORLD, camera

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_detector.foreign_boxes.calibrator import load
from calibslam_detector.images.image_conversion import decode_compressed, decode_raw
from calibslam_msgs_py import bags
from calibslam_msgs_py import conversions as c
from calibslam_msgs_py.bag_types import calibslam_typestore
from calibslam_msgs_py.covariance import is_covariance
from calibslam_msgs_py.measurements import Boxes, InvalidMeasurement, RelativeMotion

# Why a whole message is refused.
REASONS = {"shape", "time", "pose", "covariance", "radii", "camera", "image_size", "encoding", "corrupt_image"}
TYPES = c.RosTypes()


def is_pose(T: np.ndarray) -> bool:
    R = T[:3, :3]
    return bool(np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-6))


def is_matrix(covariance: np.ndarray) -> bool:
    """As good as a covariance on the edge of being none is after it was rotated."""
    return bool(np.isfinite(covariance).all() and np.array_equal(covariance, covariance.T))


def read_boxes(message: Any) -> None:
    """What the calibrator's node does, whose output the back end reads."""
    boxes, dropped = c.valid_boxes(c.boxes_from_msg(message))
    assert len(boxes) + sum(dropped.values()) == len(message.boxes)
    assert dropped.keys() <= {"nan", "empty", "outside", "covariance"}
    calibrated = load(None)(boxes)
    assert is_covariance(calibrated.covariances).all()
    again, dropped = c.valid_boxes(c.boxes_from_msg(c.boxes_to_msg(calibrated, bags.types)))
    assert len(again) == len(boxes) and not dropped


def read_motion(message: Any) -> None:
    motion = c.motion_from_msg(message)
    assert motion.start < motion.end and is_pose(motion.T_start_end)
    assert motion.covariance is None or is_matrix(motion.covariance)


def read_odometry(message: Any) -> None:
    pose, covariance = c.odometry_from_msg(message)
    assert is_pose(pose.T) and (covariance is None or is_matrix(covariance))


def read_camera(message: Any) -> None:
    found = c.camera_from_msg(message)
    assert np.isfinite(found.K).all() and np.isfinite(found.distortion).all() and found.width > 0


def read_quadrics(message: Any) -> None:
    for quadric in c.quadrics_from_msg(message):
        assert is_pose(quadric.T_map_object) and (quadric.radii > 0.0).all()


def read_pose(message: Any) -> None:
    assert is_pose(c.stamped_pose_from_msg(message).T)


def read_image(message: Any) -> None:
    data = np.frombuffer(message.data, np.uint8)
    image = decode_raw(data, message.height, message.width, message.step, message.encoding)
    assert image.shape == (message.height, message.width, 3)


def read_compressed(message: Any) -> None:
    image = decode_compressed(np.frombuffer(message.data, np.uint8))
    assert image.ndim == 3 and image.dtype == np.uint8


READERS: dict[str, Callable[[Any], None]] = {
    "calibslam_msgs/msg/BoundingBoxArray": read_boxes,
    "calibslam_msgs/msg/RelativePose": read_motion,
    "calibslam_msgs/msg/QuadricArray": read_quadrics,
    "sensor_msgs/msg/CameraInfo": read_camera,
    "sensor_msgs/msg/Image": read_image,
    "sensor_msgs/msg/CompressedImage": read_compressed,
    "nav_msgs/msg/Odometry": read_odometry,
    "geometry_msgs/msg/PoseStamped": read_pose,
}


def used_or_refused(kind: str, message: Any) -> None:
    """By name; anything else that is raised is a defect."""
    try:
        READERS[kind](message)
    except InvalidMeasurement as error:
        assert error.reason in REASONS, error.reason
        assert str(error)


@pytest.mark.parametrize("kind", READERS)
def test_valid_messages_are_used(kind: str) -> None:
    for types in (bags.types, TYPES):
        READERS[kind](VALID[kind](types))


@pytest.mark.parametrize("kind", READERS)
def test_spoilt_fields(kind: str) -> None:
    valid = VALID[kind](bags.types)
    fuzz(lambda random: used_or_refused(kind, spoilt_message(valid, random, lengths_too=True)), few=50, many=1500)


@pytest.mark.parametrize("kind", READERS)
def test_spoilt_bytes(kind: str) -> None:
    """As both libraries that decode messages see them."""
    valid = VALID[kind](TYPES)
    data, store = serialize_message(valid), calibslam_typestore()

    def spoil(random: Random) -> None:
        spoilt = spoilt_bytes(data, random)
        # That of ROS raises its own errors, that of bags whatever its generated code does: `bags` counts both.
        for decode in (lambda: deserialize_message(spoilt, type(valid)), lambda: store.deserialize_cdr(spoilt, kind)):
            try:
                message = decode()
            except Exception:
                continue
            used_or_refused(kind, message)

    fuzz(spoil, few=50, many=1500)


def test_the_estimator_among_spoilt_messages() -> None:
    """What passes the checks of a message may still be nonsense: it must not make the estimate unusable."""
    fuzz(drive_among_spoilt_messages, few=4, many=300)


def drive_among_spoilt_messages(random: Random) -> None:
    estimator = Estimator(c.camera_from_msg(camera(TYPES)), np.eye(4), EstimatorSettings())
    for measured in WORLD.measurements():
        message = c.boxes_to_msg(measured, TYPES) if isinstance(measured, Boxes) else c.motion_to_msg(measured, TYPES)
        if random.random() < 0.2:
            message = spoilt_message(message, random, lengths_too=False)
        try:
            read: Boxes | RelativeMotion
            if isinstance(measured, Boxes):
                read, _ = c.valid_boxes(c.boxes_from_msg(message))
            else:
                read = c.motion_from_msg(message)
            estimator.add(read)
        except InvalidMeasurement as error:
            assert error.reason
    estimator.finish()
    if estimator.stamps:
        assert np.isfinite(estimator.trajectory()).all()
        assert all(np.isfinite(q.radii).all() and is_pose(q.T_map_object) for q in estimator.quadrics())
