"""Rigid transforms: as the user writes them, and on the way from one to another."""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from calibslam_msgs_py.measurements import Array


def transform_from_text(text: str) -> Array:
    """(4, 4) from "x y z qx qy qz qw".

    Raises:
        ValueError: not seven numbers, or no unit quaternion.
    """
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        raise ValueError(f'a pose is seven numbers "x y z qx qy qz qw", not "{text}"')
    if abs(np.linalg.norm(numbers[3:]) - 1.0) > 1e-3:
        raise ValueError(f'the quaternion in "{text}" has length {np.linalg.norm(numbers[3:]):.4f}, not 1')
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(numbers[3:]).as_matrix()
    T[:3, 3] = numbers[:3]
    return T


def on_the_way(start: gtsam.Pose3, end: gtsam.Pose3, share: float) -> gtsam.Pose3:
    """After this share of the geodesic from start to end."""
    return start.compose(gtsam.Pose3.Expmap(share * gtsam.Pose3.Logmap(start.between(end))))
