"""Where a new keyframe is, given odometry and the boxes of quadrics that are already in the map.

Odometry fails grossly now and then, and so do boxes. Both losses are heavy-tailed, hence have several minima, and
an optimiser started at odometry's prediction would stay with odometry. So the pose is sought twice, once from
there and once from where the boxes alone would put it, and the better one starts the keyframe.
"""

from __future__ import annotations

import gtsam
import numba
import numpy as np

from calibslam_backend.geometry.box_measurement import BoxMeasurement, stacked
from calibslam_backend.graph.box_factor import INVISIBLE, whitened_residual
from calibslam_backend.graph.robust import robust_loss
from calibslam_msgs_py.measurements import Array

# The second start believes odometry this much less: its standard deviations times ten.
DISTRUST = 10.0
ITERATIONS = 15
NEVER_DOUBTED = 1e6
# A prior of one radian and two metres: hardly any.
FREE = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])


def localise(
    predicted: Array,
    covariance: Array,
    quadrics: list[Array],
    boxes: list[BoxMeasurement],
    K: Array,
    robust_scale: float,
    robust_odometry: float,
    worth: float = 1.0,
) -> Array:
    """Pose (4, 4) of the camera in the map.

    Args:
        predicted: (4, 4) last pose and odometry.
        covariance: (6, 6) of the odometry since the last pose, [rotation, translation].
        quadrics: N vectors (9,) in the map, taken as exact.
        boxes: their N boxes.
        K: (3, 3) camera matrix [px].
        robust_scale, robust_odometry: as in the factor graph.
        worth: share of the boxes' log-likelihood that counts, see `BoxCorrelation`.
    """
    if not boxes:
        return predicted
    whitener = np.linalg.inv(np.linalg.cholesky(covariance))
    seen = _Seen(np.stack(quadrics), boxes, K, robust_scale, worth)
    first = gtsam.Pose3(predicted)
    _, guess = _minimise(first, first, whitener / DISTRUST, NEVER_DOUBTED, seen)
    results = [_minimise(start, first, whitener, robust_odometry, seen) for start in (first, guess)]
    return np.asarray(min(results, key=lambda result: result[0])[1].matrix())


def fit(start: Array, quadrics: list[Array], boxes: list[BoxMeasurement], K: Array, robust_scale: float) -> Array:
    """Pose (4, 4) of the camera from boxes alone, near `start` (4, 4); arguments as in `localise`."""
    first = gtsam.Pose3(start)
    seen = _Seen(np.stack(quadrics), boxes, K, robust_scale)
    return np.asarray(_minimise(first, first, FREE, NEVER_DOUBTED, seen)[1].matrix())


class _Seen:
    """Quadrics and their boxes as arrays."""

    def __init__(
        self, vectors: Array, boxes: list[BoxMeasurement], K: Array, robust_scale: float, worth: float = 1.0
    ) -> None:
        self._measured = stacked(boxes)
        self._vectors, self._K, self._robust_scale, self._worth = vectors, K, robust_scale, worth

    def add(self, pose: gtsam.Pose3, H: Array, g: Array) -> float:
        """Robust cost of the boxes at a pose; adds their normal equations to H (6, 6) and g (6,)."""
        scale, worth = self._robust_scale, self._worth
        cost: float = _boxes(pose.matrix(), self._vectors, self._K, *self._measured, scale, worth, H, g)
        return cost


def _minimise(
    start: gtsam.Pose3, predicted: gtsam.Pose3, whitener: Array, k: float, seen: _Seen
) -> tuple[float, gtsam.Pose3]:
    """Levenberg-Marquardt; returns cost and pose."""
    pose, best, damping, cost, A, b = start, start, 1e-3, np.inf, np.eye(6), np.zeros(6)
    for _ in range(ITERATIONS):
        e = whitener @ gtsam.Pose3.Logmap(predicted.between(pose))
        rho, weight = robust_loss(e @ e, k)
        H, g = weight * whitener.T @ whitener, -weight * whitener.T @ e
        c = rho + seen.add(pose, H, g)
        if c <= cost:
            done = cost - c < 1e-3 * c
            best, cost, A, b, damping = pose, c, H, g, max(damping / 10.0, 1e-6)
            if done:
                break
        else:
            damping *= 10.0
        pose = best.retract(np.linalg.solve(A + damping * np.diag(np.diag(A)), b))
    return cost, best


@numba.njit(cache=True)
def _boxes(T, vectors, K, corners, whiteners, bounds, clip, k, worth, H, g):  # type: ignore[no-untyped-def]
    """Robust cost of the boxes; adds their normal equations to H (6, 6) and g (6,)."""
    cost = 0.0
    for n in range(len(vectors)):
        visible, r, dr = whitened_residual(T, vectors[n], K, corners[n], whiteners[n], bounds[n], clip[n])
        rho, weight = robust_loss(r @ r if visible else INVISIBLE**2, k)
        cost += worth * rho
        if visible:
            J = np.ascontiguousarray(dr[:, :6])
            H += worth * weight * (J.T @ J)
            g -= worth * weight * (J.T @ r)
    return cost
