"""Messages <-> plain measurements, validated on entry. The one place where either side knows the other.

Reading functions take any object with the attributes of the message: of rclpy or of rosbags. Writing
functions take the message classes as `types` (`RosTypes()` live, `bags.types` offline). A message that cannot
be used as a whole raises `InvalidMeasurement`, whose `reason` is a short name to count by.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calibslam_msgs_py.box_conversions import BeyondImage, boxes_from_msg, boxes_to_msg, valid_boxes
from calibslam_msgs_py.covariance import (
    gtsam_from_ros_covariance,
    ros_from_gtsam_covariance,
    ros_from_gtsam_jacobian,
    symmetric,
)
from calibslam_msgs_py.geometry_conversions import (
    UNKNOWN,
    doubles_of,
    header_to_msg,
    path_to_msg,
    pose_covariance_from,
    pose_covariance_to,
    pose_from_msg,
    pose_to_msg,
    pose_with_covariance_to_msg,
    stamp_from_msg,
    stamp_to_msg,
    stamped_pose_from_msg,
    stamped_pose_to_msg,
    transform_to_msg,
    unknown_covariance,
    vector_from_msg,
    vector_to_msg,
)
from calibslam_msgs_py.measurements import (
    Array,
    Camera,
    InvalidMeasurement,
    QuadricEstimate,
    RelativeMotion,
    StampedPose,
)
from calibslam_msgs_py.message_types import MessageTypes, RosTypes

__all__ = [
    "BeyondImage",
    "MessageTypes",
    "RosTypes",
    "boxes_from_msg",
    "boxes_to_msg",
    "camera_from_msg",
    "camera_to_msg",
    "gtsam_from_ros_covariance",
    "header_to_msg",
    "motion_from_msg",
    "motion_to_msg",
    "odometry_from_msg",
    "odometry_to_msg",
    "path_to_msg",
    "pose_from_msg",
    "pose_to_msg",
    "pose_with_covariance_to_msg",
    "quadric_from_msg",
    "quadric_to_msg",
    "quadrics_from_msg",
    "quadrics_to_msg",
    "ros_from_gtsam_covariance",
    "stamp_from_msg",
    "stamp_to_msg",
    "stamped_pose_from_msg",
    "stamped_pose_to_msg",
    "transform_to_msg",
    "valid_boxes",
    "vector_from_msg",
    "vector_to_msg",
]


def motion_from_msg(msg: Any) -> RelativeMotion:
    """A RelativePose.

    Raises:
        InvalidMeasurement: `time` (does not end after its start), `pose` (not finite, no unit quaternion),
            `covariance` (known, but not symmetric and positive definite).
    """
    start, end = stamp_from_msg(msg.start), stamp_from_msg(msg.header.stamp)
    if start >= end:
        raise InvalidMeasurement("time", f"relative motion from {start} to {end} ns does not go forward")
    T = pose_from_msg(msg.motion.pose)
    covariance = pose_covariance_from(msg.motion.covariance, T[:3, :3], "a relative motion")
    return RelativeMotion(start, end, T, covariance, str(msg.header.frame_id))


def motion_to_msg(motion: RelativeMotion, types: MessageTypes) -> Any:
    """A RelativePose."""
    return types("calibslam_msgs/msg/RelativePose")(
        header=header_to_msg(motion.end, motion.frame_id, types),
        start=stamp_to_msg(motion.start, types),
        motion=types("geometry_msgs/msg/PoseWithCovariance")(
            pose=pose_to_msg(motion.T_start_end, types),
            covariance=pose_covariance_to(motion.covariance, motion.T_start_end[:3, :3]),
        ),
    )


def odometry_from_msg(msg: Any) -> tuple[StampedPose, Array | None]:
    """Pose of the body in the odometry frame, and the covariance (6, 6) of its velocity over the last step.

    The covariance is of [rotation rad/s, translation m/s] in the body; None where it is all zeros (which is
    how nav_msgs/Odometry says "unknown") or starts with -1.

    Raises:
        InvalidMeasurement: `pose`, or `covariance` (neither unknown nor symmetric and positive definite).
    """
    pose = StampedPose(stamp_from_msg(msg.header.stamp), pose_from_msg(msg.pose.pose))
    flat = doubles_of(msg.twist.covariance, 36, "twist covariance of an odometry")
    if not flat.any():
        return pose, None
    # A twist is given in the body frame: only the order differs.
    return pose, pose_covariance_from(flat, np.eye(3), "the twist of an odometry")


def odometry_to_msg(
    pose: StampedPose,
    types: MessageTypes,
    *,
    velocity: Array,
    velocity_covariance: Array | None = None,
    frame_id: str = "odom",
    child_frame_id: str = "camera",
) -> Any:
    """A nav_msgs/Odometry without pose covariance.

    Args:
        pose: of the body in the odometry frame.
        velocity: (6,) [rotation rad/s, translation m/s] of the body, in the body, over the step that ends at
            the stamp.
        velocity_covariance: (6, 6) of the velocity; None: unknown, written as zeros.
    """
    zeros = np.zeros(36)
    known = velocity_covariance is not None
    twist = types("geometry_msgs/msg/Twist")(
        linear=vector_to_msg(velocity[3:], types), angular=vector_to_msg(velocity[:3], types)
    )
    return types("nav_msgs/msg/Odometry")(
        header=header_to_msg(pose.stamp, frame_id, types),
        child_frame_id=child_frame_id,
        pose=types("geometry_msgs/msg/PoseWithCovariance")(pose=pose_to_msg(pose.T, types), covariance=zeros.copy()),
        twist=types("geometry_msgs/msg/TwistWithCovariance")(
            twist=twist, covariance=pose_covariance_to(velocity_covariance, np.eye(3)) if known else zeros
        ),
    )


def camera_from_msg(msg: Any) -> Camera:
    """A sensor_msgs/CameraInfo.

    Raises:
        InvalidMeasurement: `camera`, if it is not calibrated or its distortion is not plumb_bob.
    """
    K = doubles_of(msg.k, 9, "camera matrix").reshape(3, 3)
    if not (np.isfinite(K).all() and K[0, 0] > 0.0 and K[1, 1] > 0.0 and np.array_equal(K[2], [0.0, 0.0, 1.0])):
        raise InvalidMeasurement("camera", f"the camera is not calibrated: k = {K.ravel().tolist()}")
    if msg.width < 1 or msg.height < 1:
        raise InvalidMeasurement("camera", f"a camera of {msg.width} x {msg.height} pixels")
    coefficients = np.asarray(msg.d, dtype=np.float64).ravel()
    if coefficients.any() and not (msg.distortion_model == "plumb_bob" and coefficients.size <= 5):
        raise InvalidMeasurement(
            "camera",
            f"distortion model '{msg.distortion_model}' with {coefficients.size} coefficients: "
            "only plumb_bob is supported; rectify the images first",
        )
    distortion = np.zeros(5)
    if coefficients.any():
        distortion[: coefficients.size] = coefficients
    if not np.isfinite(distortion).all():
        raise InvalidMeasurement("camera", "distortion of the camera is not finite")
    return Camera(int(msg.width), int(msg.height), K, distortion, str(msg.header.frame_id))


def camera_to_msg(camera: Camera, stamp: int, types: MessageTypes) -> Any:
    """A sensor_msgs/CameraInfo of a monocular camera."""
    P = np.zeros((3, 4))
    P[:, :3] = camera.K
    return types("sensor_msgs/msg/CameraInfo")(
        header=header_to_msg(stamp, camera.frame_id, types),
        height=int(camera.height),
        width=int(camera.width),
        distortion_model="plumb_bob",
        d=types.doubles(camera.distortion),
        k=np.array(camera.K, dtype=np.float64).ravel(),
        r=np.eye(3).ravel(),
        p=P.ravel(),
        binning_x=0,
        binning_y=0,
        roi=types("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def _quadric_order(R: Array) -> Array:
    """(9, 9) J with [x y z, fixed-axis rotation, radii] = J [rotation, translation, radii]."""
    J = np.eye(9)
    J[:6, :6] = ros_from_gtsam_jacobian(R)
    return J


def quadric_from_msg(msg: Any) -> QuadricEstimate:
    """A Quadric.

    Raises:
        InvalidMeasurement: `pose`, `radii` (not finite or not above 0), `covariance` (known, but not finite).
    """
    T = pose_from_msg(msg.pose)
    radii = vector_from_msg(msg.radii)
    if not (np.isfinite(radii).all() and (radii > 0.0).all()):
        raise InvalidMeasurement("radii", f"semi-axes of quadric {msg.id} are not positive: {radii}")
    flat = doubles_of(msg.covariance, 81, "covariance of a quadric")
    if flat[0] == UNKNOWN:
        covariance = np.full((9, 9), np.nan)
    elif np.isfinite(flat).all():
        J = _quadric_order(T[:3, :3])
        covariance = symmetric(J.T @ flat.reshape(9, 9) @ J)
    else:
        raise InvalidMeasurement("covariance", f"covariance of quadric {msg.id} is not finite")
    return QuadricEstimate(int(msg.id), str(msg.class_id), T, radii, covariance, int(msg.observations))


def quadric_to_msg(quadric: QuadricEstimate, types: MessageTypes) -> Any:
    """A Quadric; its covariance is "unknown" unless all of it is known."""
    J = _quadric_order(quadric.T_map_object[:3, :3])
    known = bool(np.isfinite(quadric.covariance).all())
    return types("calibslam_msgs/msg/Quadric")(
        id=int(quadric.id),
        class_id=str(quadric.class_id),
        pose=pose_to_msg(quadric.T_map_object, types),
        radii=vector_to_msg(quadric.radii, types),
        covariance=symmetric(J @ quadric.covariance @ J.T).ravel() if known else unknown_covariance(9),
        observations=int(quadric.observations),
    )


def quadrics_from_msg(msg: Any) -> list[QuadricEstimate]:
    """All quadrics of a QuadricArray."""
    return [quadric_from_msg(quadric) for quadric in msg.quadrics]


def quadrics_to_msg(stamp: int, quadrics: Sequence[QuadricEstimate], types: MessageTypes, frame_id: str = "map") -> Any:
    """A QuadricArray."""
    return types("calibslam_msgs/msg/QuadricArray")(
        header=header_to_msg(stamp, frame_id, types),
        quadrics=[quadric_to_msg(quadric, types) for quadric in quadrics],
    )
