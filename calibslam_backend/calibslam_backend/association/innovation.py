"""How well boxes agree with what is predicted of them before they are used: the check on all covariances together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibslam_backend.association.matching import predict
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_msgs_py.measurements import Array


def innovations(
    T_map_camera: Array,
    quadrics: Sequence[Array],
    covariances: Sequence[Array],
    boxes: Sequence[BoxMeasurement],
    K: Array,
) -> Array:
    """Normalised innovations squared (M,) of the boxes that are wholly in the image, each divided by its 4 degrees of
    freedom: 1 on average where covariances are right (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).

    Args:
        T_map_camera: (4, 4) as predicted by odometry.
        quadrics: N vectors (9,).
        covariances: N times (15, 15) of predicted pose and quadric together.
        boxes: N boxes.
        K: (3, 3) camera matrix [px].
    """
    result = []
    for vector, covariance, box in zip(quadrics, covariances, boxes, strict=True):
        if box.clip.any():
            continue
        prediction = predict(T_map_camera, vector, covariance, K, box, 0.0)
        if prediction is None:
            continue
        corners, uncertainty = prediction
        difference = box.corners - corners
        S = uncertainty + box.covariance
        result.append(difference @ np.linalg.solve(S, difference) / 4.0)
    return np.array(result)
