"""Times, poses and their covariances <-> messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calibslam_msgs_py.covariance import (
    gtsam_from_ros_covariance,
    is_covariance,
    ros_from_gtsam_covariance,
    symmetric,
)
from calibslam_msgs_py.measurements import SECOND, Array, InvalidMeasurement, StampedPose
from calibslam_msgs_py.message_types import MessageTypes

# covariance[0] of a message whose covariance is not known.
UNKNOWN = -1.0
# How far the norm of a quaternion may be from 1: text files with four decimals stay below, garbage does not.
QUATERNION_TOLERANCE = 1e-3


def doubles_of(values: Any, n: int, what: str) -> Array:
    """(n,) float64 of an array field: a copy, since what comes out of a bag is read-only."""
    flat = np.array(values, dtype=np.float64).ravel()
    if flat.size != n:
        raise InvalidMeasurement("shape", f"{what} has {flat.size} numbers instead of {n}")
    return flat


def unknown_covariance(n: int) -> Array:
    """A flat n x n covariance that says "unknown"."""
    covariance = np.zeros(n * n)
    covariance[0] = UNKNOWN
    return covariance


def stamp_from_msg(msg: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return int(msg.sec) * SECOND + int(msg.nanosec)


def stamp_to_msg(stamp: int, types: MessageTypes) -> Any:
    """A builtin_interfaces/Time."""
    sec, nanosec = divmod(int(stamp), SECOND)
    return types("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)


def header_to_msg(stamp: int, frame_id: str, types: MessageTypes) -> Any:
    """A std_msgs/Header."""
    return types("std_msgs/msg/Header")(stamp=stamp_to_msg(stamp, types), frame_id=str(frame_id))


def vector_from_msg(msg: Any) -> Array:
    """(3,) of anything with x, y and z."""
    return np.array([msg.x, msg.y, msg.z], dtype=np.float64)


def vector_to_msg(v: Array, types: MessageTypes, name: str = "geometry_msgs/msg/Vector3") -> Any:
    """A geometry_msgs/Vector3, or another message with x, y and z."""
    # float(): rclpy writes numpy's scalars as garbage, silently.
    return types(name)(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def rotation_from_quaternion(q: Array) -> Array:
    """(3, 3) of the unit quaternion x y z w."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(R: Array) -> Array:
    """(4,) x y z w with w >= 0, by the method of Shepperd (1978): the largest component first."""
    squares = np.array([R[0, 0], R[1, 1], R[2, 2], R[0, 0] + R[1, 1] + R[2, 2]])
    k = int(np.argmax(squares))
    q = np.empty(4)
    if k == 3:
        q[:3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        q[3] = 1.0 + squares[3]
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q[k] = 1.0 + R[k, k] - R[i, i] - R[j, j]
        q[i] = R[i, k] + R[k, i]
        q[j] = R[j, k] + R[k, j]
        q[3] = R[j, i] - R[i, j]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0.0 else -q


def pose_from_msg(msg: Any) -> Array:
    """(4, 4) of a geometry_msgs/Pose.

    Raises:
        InvalidMeasurement: `pose`, if a number is not finite or the quaternion is no unit quaternion.
    """
    orientation = msg.orientation
    q = np.array([orientation.x, orientation.y, orientation.z, orientation.w], dtype=np.float64)
    t = vector_from_msg(msg.position)
    if not (np.isfinite(q).all() and np.isfinite(t).all()):
        raise InvalidMeasurement("pose", f"pose is not finite: position {t}, orientation {q}")
    norm = float(np.linalg.norm(q))
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise InvalidMeasurement("pose", f"orientation is no unit quaternion: its norm is {norm:.6g}")
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(q / norm)
    T[:3, 3] = t
    return T


def pose_to_msg(T: Array, types: MessageTypes) -> Any:
    """A geometry_msgs/Pose of (4, 4)."""
    x, y, z, w = (float(c) for c in quaternion_from_rotation(T[:3, :3]))
    return types("geometry_msgs/msg/Pose")(
        position=vector_to_msg(T[:3, 3], types, "geometry_msgs/msg/Point"),
        orientation=types("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w),
    )


def pose_covariance_from(flat: Any, R: Array, what: str) -> Array | None:
    """(6, 6) in GTSAM's order; None where unknown."""
    covariance = doubles_of(flat, 36, f"covariance of {what}").reshape(6, 6)
    if covariance[0, 0] == UNKNOWN:
        return None
    if not is_covariance(covariance):
        raise InvalidMeasurement("covariance", f"covariance of {what} is not symmetric and positive definite")
    return symmetric(gtsam_from_ros_covariance(symmetric(covariance), R))


def pose_covariance_to(covariance: Array | None, R: Array) -> Array:
    """(36,) in ROS' order; -1 first where unknown."""
    return unknown_covariance(6) if covariance is None else symmetric(ros_from_gtsam_covariance(covariance, R)).ravel()


def stamped_pose_from_msg(msg: Any) -> StampedPose:
    """A geometry_msgs/PoseStamped."""
    return StampedPose(stamp_from_msg(msg.header.stamp), pose_from_msg(msg.pose))


def stamped_pose_to_msg(pose: StampedPose, frame_id: str, types: MessageTypes) -> Any:
    """A geometry_msgs/PoseStamped in the frame `frame_id`."""
    return types("geometry_msgs/msg/PoseStamped")(
        header=header_to_msg(pose.stamp, frame_id, types), pose=pose_to_msg(pose.T, types)
    )


def path_to_msg(poses: Sequence[StampedPose], frame_id: str, types: MessageTypes) -> Any:
    """A nav_msgs/Path with the stamp of its last pose."""
    return types("nav_msgs/msg/Path")(
        header=header_to_msg(poses[-1].stamp if poses else 0, frame_id, types),
        poses=[stamped_pose_to_msg(pose, frame_id, types) for pose in poses],
    )


def transform_to_msg(pose: StampedPose, frame_id: str, child_frame_id: str, types: MessageTypes) -> Any:
    """A tf2_msgs/TFMessage with one transform: the pose of the frame `child_frame_id` in `frame_id`."""
    as_pose = pose_to_msg(pose.T, types)
    transform = types("geometry_msgs/msg/Transform")(
        translation=vector_to_msg(pose.T[:3, 3], types), rotation=as_pose.orientation
    )
    stamped = types("geometry_msgs/msg/TransformStamped")(
        header=header_to_msg(pose.stamp, frame_id, types), child_frame_id=str(child_frame_id), transform=transform
    )
    return types("tf2_msgs/msg/TFMessage")(transforms=[stamped])


def pose_with_covariance_to_msg(pose: StampedPose, covariance: Array | None, frame_id: str, types: MessageTypes) -> Any:
    """A geometry_msgs/PoseWithCovarianceStamped; `covariance` (6, 6) of GTSAM's tangent, None: unknown."""
    return types("geometry_msgs/msg/PoseWithCovarianceStamped")(
        header=header_to_msg(pose.stamp, frame_id, types),
        pose=types("geometry_msgs/msg/PoseWithCovariance")(
            pose=pose_to_msg(pose.T, types), covariance=pose_covariance_to(covariance, pose.T[:3, :3])
        ),
    )
