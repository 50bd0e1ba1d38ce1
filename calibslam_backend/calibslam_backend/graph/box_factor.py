"""The factor between a camera pose, a quadric and a measured box (document, eq. 4.3.3).

The four edges of a box share one Mahalanobis distance: gross errors concern the whole box (see `robust`).
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numba
import numpy as np

from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.visible_box import POSE, QUADRIC, box_of_visible_part
from calibslam_backend.graph.box_correlation import BoxCorrelation
from calibslam_backend.graph.robust import robust_scales
from calibslam_msgs_py.measurements import Array

# Mahalanobis distance that an ellipsoid counts for which has no box, being behind or around the camera. It is
# constant: such a state is neither attractive nor does it pull; priors hold the landmark until it is seen again.
INVISIBLE = 10.0


@numba.njit(cache=True)
def whitened_residual(T_map_camera, quadric, K, corners, whitener, bounds, clip):  # type: ignore[no-untyped-def]
    """(visible, r (4,), dr (4, 15)): predicted minus measured box in units of its standard deviation."""
    visible, box, jacobian = box_of_visible_part(T_map_camera, quadric, K, bounds, clip)
    return visible, whitener @ (box - corners), whitener @ jacobian


@numba.njit(cache=True)
def _weighted(T_map_camera, quadric, K, measured, k, worth):  # type: ignore[no-untyped-def]
    """(4, 17): columns of dr by the pose and by the quadric, r for the linearisation, r for the error; see `robust`.

    All of a box that counts by its worth.
    One array, and one for all that was measured (`BoxMeasurement.packed`), since each that comes from or goes to Python
    takes as long as a tenth to a third of what is computed here.
    """
    result = np.zeros((4, 17))
    visible, r, dr = whitened_residual(
        T_map_camera, quadric, K, measured[0], measured[3:], measured[1], measured[2] != 0.0
    )
    if not visible:
        r[:] = 0.5 * INVISIBLE
    for_error, for_linearisation = robust_scales(r @ r, k)
    scale = np.sqrt(worth)
    if visible:
        result[:, :15] = scale * for_linearisation * dr
    result[:, 15] = scale * for_linearisation * r
    result[:, 16] = scale * for_error * r
    return result


@numba.njit(cache=True)
def _tangents(poses, quadrics, K, measured, k, worth):  # type: ignore[no-untyped-def]
    """(N, 17, 4) of N boxes: the transposed Jacobian by pose and quadric, minus the residual, and the residual of a box
    that counts fully."""
    result = np.empty((len(poses), 17, 4))
    for n in range(len(poses)):
        weighted = _weighted(poses[n], quadrics[n], K, measured[n], k, worth)
        result[n, :15] = weighted[:, :15].T
        result[n, 15] = -weighted[:, 15]
        result[n, 16] = weighted[:, 15] / np.sqrt(worth)
    return result


_UNIT = gtsam.noiseModel.Unit.Create(4)
INDEPENDENT = BoxCorrelation(is_estimated=False)


def box_factor(
    pose: int,
    quadric: int,
    box: BoxMeasurement,
    K: Array,
    robust_scale: float,
    correlation: BoxCorrelation = INDEPENDENT,
) -> gtsam.CustomFactor:
    """The factor for one box.

    Args:
        pose: key of a Pose3, T_map_camera.
        quadric: key of a (9,) vector (t, L), see `ellipsoid`.
        box: what was measured.
        K: (3, 3) camera matrix [px].
        robust_scale: k, the Mahalanobis distance beyond which a box is doubted.
        correlation: by which errors of neighbouring boxes are alike, as known when the factor is evaluated.
    """
    measured = box.packed

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        T, vector = values.atPose3(pose).matrix(), values.atVector(quadric)
        result: Array = _weighted(T, vector, K, measured, robust_scale, correlation.worth)
        if H is None:
            return result[:, 16]
        H[0], H[1] = result[:, POSE], result[:, QUADRIC]
        return result[:, 15]

    return gtsam.CustomFactor(_UNIT, [pose, quadric], error)


def box_tangents(
    keys: Sequence[tuple[int, int]],
    poses: Array,
    quadrics: Array,
    boxes: Sequence[BoxMeasurement],
    K: Array,
    robust_scale: float,
    worth: float = 1.0,
) -> tuple[list[gtsam.JacobianFactor], Array]:
    """The linearised factors of N boxes, as `box_factor(...).linearize` has them, in a third of the time.

    Args:
        keys: of pose and quadric, N.
        poses: (N, 4, 4) T_map_camera.
        quadrics: (N, 9) vectors.
        boxes: N.
        K, robust_scale: see `box_factor`.
        worth: share of their log-likelihood that counts.

    Returns:
        The factors, and the residuals (N, 4) of the boxes in standard deviations, those of doubted ones reduced.
    """
    if not boxes:
        return [], np.zeros((0, 4))
    rows = _tangents(poses, quadrics, K, np.stack([box.packed for box in boxes]), robust_scale, worth)
    factors = [
        gtsam.JacobianFactor(pose, row[POSE].T, quadric, row[QUADRIC].T, row[15], _UNIT)
        for (pose, quadric), row in zip(keys, rows, strict=True)
    ]
    return factors, rows[:, 16]


def pose_information(
    T_map_camera: Array, quadrics: Sequence[Array], boxes: Sequence[BoxMeasurement], K: Array
) -> Array:
    """Fisher information (6, 6) of N boxes on a pose [rotation, translation in the camera], their quadrics being known.

    Args:
        T_map_camera: (4, 4).
        quadrics: N vectors (9,).
        boxes: N, one of each quadric.
        K: (3, 3) camera matrix [px].
    """
    if not boxes:
        return np.zeros((6, 6))
    poses, packed = np.tile(T_map_camera, (len(boxes), 1, 1)), np.stack([box.packed for box in boxes])
    rows = _tangents(poses, np.stack(quadrics), K, packed, np.inf, 1.0)[:, POSE]
    return np.asarray(np.einsum("nai,nbi->ab", rows, rows))
