"""The messages the back end publishes, built alike for a live graph and for `run.mcap`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from calibslam_backend.estimator import Estimator
from calibslam_msgs_py.conversions import (
    MessageTypes,
    header_to_msg,
    path_to_msg,
    pose_to_msg,
    pose_with_covariance_to_msg,
    quadrics_to_msg,
    transform_to_msg,
)
from calibslam_msgs_py.measurements import Array, QuadricEstimate, StampedPose

MAP = "map"
TRAJECTORY, POSE, QUADRICS, MARKERS = "trajectory", "pose", "quadrics", "quadric_markers"
TOPICS = {
    TRAJECTORY: "nav_msgs/msg/Path",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    QUADRICS: "calibslam_msgs/msg/QuadricArray",
    MARKERS: "visualization_msgs/msg/MarkerArray",
}

# In `run.mcap` only: there is no odometry frame between. Live, map -> odom is published (see map_to_odom_node).
TRANSFORM = "tf"

# visualization_msgs/Marker
SPHERE, TEXT, ADD, DELETE_ALL = 2, 9, 0, 3


def pose_message(estimator: Estimator, types: MessageTypes, frame: str = MAP) -> Any:
    """The newest keyframe with its covariance, in a frame of this name."""
    k = len(estimator.stamps) - 1
    pose = StampedPose(estimator.stamps[k], estimator.pose(k))
    return pose_with_covariance_to_msg(pose, estimator.pose_covariance(k), frame, types)


def camera_transform_message(estimator: Estimator, camera_frame: str, types: MessageTypes) -> Any:
    """The newest keyframe as the transform map -> camera, so that what the camera sees can be shown in the map."""
    k = len(estimator.stamps) - 1
    return transform_to_msg(StampedPose(estimator.stamps[k], estimator.pose(k)), MAP, camera_frame or "camera", types)


def map_messages(estimator: Estimator, types: MessageTypes, frame: str = MAP) -> Iterator[tuple[str, Any]]:
    """Trajectory, quadrics and their markers, as (topic, message); each as things are when it is asked for."""
    poses = [StampedPose(t, T) for t, T in zip(estimator.stamps, estimator.trajectory(), strict=True)]
    yield TRAJECTORY, path_to_msg(poses, frame, types)
    stamp, quadrics = estimator.stamps[-1], estimator.quadrics()
    yield QUADRICS, quadrics_to_msg(stamp, quadrics, types, frame)
    yield MARKERS, markers_message(stamp, quadrics, types, frame)


def markers_message(stamp: int, quadrics: Sequence[QuadricEstimate], types: MessageTypes, frame: str = MAP) -> Any:
    """Quadrics as ellipsoids with their class names; the first marker removes those of before."""
    header = header_to_msg(stamp, frame, types)
    markers = [_marker(header, "", 0, ADD, np.eye(4), np.zeros(3), "", types)]
    markers[0].action = DELETE_ALL
    for quadric in quadrics:
        T, colour = quadric.T_map_object, _colour(quadric.class_id)
        label = np.eye(4)
        label[:3, 3] = T[:3, 3]
        markers.append(_marker(header, "quadrics", quadric.id, SPHERE, T, 2.0 * quadric.radii, "", types, colour))
        text = f"{quadric.class_id} {quadric.id}"
        markers.append(_marker(header, "labels", quadric.id, TEXT, label, np.full(3, 0.06), text, types))
    return types("visualization_msgs/msg/MarkerArray")(markers=markers)


def _marker(
    header: Any,
    namespace: str,
    number: int,
    kind: int,
    T: Array,
    size: Array,
    text: str,
    types: MessageTypes,
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Any:
    message = types("visualization_msgs/msg/Marker")
    empty = types("std_msgs/msg/ColorRGBA")
    red, green, blue = colour
    fields = {
        "header": header,
        "ns": namespace,
        "id": int(number),
        "type": kind,
        "action": ADD,
        "pose": pose_to_msg(T, types),
        "scale": types("geometry_msgs/msg/Vector3")(x=float(size[0]), y=float(size[1]), z=float(size[2])),
        "color": empty(r=red, g=green, b=blue, a=0.5 if kind == SPHERE else 1.0),
        "lifetime": types("builtin_interfaces/msg/Duration")(sec=0, nanosec=0),
        "frame_locked": False,
        "points": [],
        "colors": [],
        "texture_resource": "",
        "texture": types("sensor_msgs/msg/CompressedImage")(
            header=header_to_msg(0, "", types), format="", data=types.octets(b"")
        ),
        "uv_coordinates": [],
        "text": text,
        "mesh_resource": "",
        "mesh_file": types("visualization_msgs/msg/MeshFile")(filename="", data=types.octets(b"")),
        "mesh_use_embedded_materials": False,
    }
    return message(**fields)


def _colour(class_id: str) -> tuple[float, float, float]:
    """A colour per class, the same in every run."""
    hue = sum(ord(c) * 31**i for i, c in enumerate(class_id)) % 360 / 60.0
    x = 1.0 - abs(hue % 2.0 - 1.0)
    table = [(1.0, x, 0.0), (x, 1.0, 0.0), (0.0, 1.0, x), (0.0, x, 1.0), (x, 0.0, 1.0), (1.0, 0.0, x)]
    red, green, blue = table[int(hue)]
    return 0.3 + 0.7 * red, 0.3 + 0.7 * green, 0.3 + 0.7 * blue
