"""Keys of the variables, and the poses of an estimate."""

from __future__ import annotations

import functools

import gtsam
import numpy as np
from gtsam import symbol

from calibslam_msgs_py.measurements import Array

D = int(symbol("d", 0))  # the drift of odometry


@functools.cache
def x(k: int) -> int:
    """The pose of keyframe k."""
    return int(symbol("x", k))


@functools.cache
def q(j: int) -> int:
    """Quadric j."""
    return int(symbol("q", j))


def poses_of(values: gtsam.Values) -> Array:
    """(N, 4, 4) of all poses, in their order."""
    rows = gtsam.utilities.extractPose3(values)  # rotation by rows, translation
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses
