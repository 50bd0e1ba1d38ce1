"""A camera that is found in a known map: it stands beside an object there, wherever the map's errors have put that.

A prior on its place in the room would say where the whole map is, anew with each camera that is found in it.
"""

from __future__ import annotations

import gtsam
import numpy as np

from calibslam_backend.graph.known import Known
from calibslam_msgs_py.measurements import Array


def found_factor(camera: int, quadric: int, T_map_camera: Array, known: Known, sigma: float) -> gtsam.CustomFactor:
    """r = (R^T (c - t) - measured) / sigma, the centre of a quadric in the camera.

    Args:
        camera: key of a Pose3, T_map_camera = (R, t).
        quadric: key of a vector (9,) that begins with its centre c.
        T_map_camera: (4, 4) where the camera was found.
        known: what the map says of the quadric.
        sigma: standard deviation of each component [m].
    """
    measured = T_map_camera[:3, :3].T @ (known.vector[:3] - T_map_camera[:3, 3])

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        pose = values.atPose3(camera)
        R = pose.rotation().matrix()
        seen = R.T @ (values.atVector(quadric)[:3] - pose.translation())
        if H is not None:
            H[0] = np.hstack([gtsam.Rot3.Hat(seen), -np.eye(3)]) / sigma
            H[1] = np.hstack([R.T, np.zeros((3, 6))]) / sigma
        return np.asarray((seen - measured) / sigma)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [camera, quadric], error)
