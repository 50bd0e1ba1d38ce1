"""A first quadric from boxes and the poses the robot believes in (document, section 2.3.2).

The linear system (2.3.3) of the document is fragile: noise easily gives a quadric that is no ellipsoid. Here the
centre is the point nearest to the rays through the boxes, the radii are those that give the median apparent size,
and Levenberg-Marquardt with fixed poses refines all nine parameters under the same robust loss as the factor
graph. An object that cannot be told yet (too few views, rays too parallel) waits for more boxes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from calibslam_backend.association.matching import median_overlap
from calibslam_backend.geometry.box_measurement import BoxMeasurement, stacked
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.graph.box_factor import INVISIBLE, whitened_residual
from calibslam_backend.graph.prior import PriorSettings, prior_covariance
from calibslam_backend.graph.robust import robust_loss
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import setting

FREE = 1e3  # standard deviation of a prior that says nothing [m, log m]


@dataclass(frozen=True)
class InitialisationSettings(PriorSettings):
    min_boxes: int = setting(4, "boxes an object needs", low=2)
    max_boxes: int = setting(40, "boxes of an object that are looked at", low=3)
    max_depth_uncertainty: float = setting(
        0.1, "largest standard deviation of the centre, as a share of its distance", low=0.0, high=1.0
    )
    max_residual: float = setting(3.0, "largest median distance of a box, in standard deviations", low=0.1)
    min_fit: float = setting(
        0.8,
        "median overlap of boxes that suffices whatever their standard deviations",
        low=0.0,
        high=1.0,
    )
    max_radius: float = setting(3.0, "largest semi-axis", unit="m", low=0.01)


@dataclass(frozen=True)
class Initialised:
    """A quadric and how well its boxes tell it.

    Attributes:
        vector: (9,) centre and logarithmic shape in the map, see `ellipsoid`.
        covariance: (9, 9) of the vector, given the poses.
        distances: (N,) Mahalanobis distance of each box.
    """

    vector: Array
    covariance: Array
    distances: Array


def initialise(
    poses: Array, boxes: list[BoxMeasurement], K: Array, robust_scale: float, settings: InitialisationSettings
) -> Initialised | None:
    """A quadric from N boxes, or None while they do not determine one.

    Args:
        poses: (N, 4, 4) T_map_camera of each box.
        boxes: what was measured.
        K: (3, 3) camera matrix [px].
        robust_scale: as in `box_factor`.
        settings: what is demanded.
    """
    if len(boxes) < settings.min_boxes:
        return None
    if len(boxes) > settings.max_boxes:
        chosen = np.linspace(0, len(boxes) - 1, settings.max_boxes).round().astype(int)
        poses, boxes = poses[chosen], [boxes[i] for i in chosen]
    corners, whiteners, bounds, clip = stacked(boxes)
    guess = _first_guess(poses, corners, clip, K)
    if guess is None:
        return None
    prior = np.linalg.inv(settings.prior_covariance())
    vector, information, distances = _refine(
        np.ascontiguousarray(poses),
        guess,
        K,
        corners,
        whiteners,
        bounds,
        clip,
        robust_scale,
        prior,
    )
    covariance = np.linalg.inv(information)
    # What the boxes say of centre and size must not be helped by priors that are but a first guess.
    free = np.linalg.inv(prior_covariance(FREE, settings.prior_shape, FREE))
    by_boxes = np.linalg.inv(information - prior + free)
    depth = np.median(np.linalg.norm(poses[:, :3, 3] - vector[:3], axis=1))
    centre_sigma = np.sqrt(np.linalg.eigvalsh(by_boxes[:3, :3])[-1])
    largest = Ellipsoid.from_vector(vector).radii.max()
    # Sharp boxes contradict poses less certain than they are: where boxes fit well, the quadric is not at fault.
    if (
        not np.isfinite(distances).all()
        or centre_sigma > settings.max_depth_uncertainty * depth
        or (np.median(distances) > settings.max_residual and median_overlap(poses, boxes, vector, K) < settings.min_fit)
        or largest > settings.max_radius
    ):
        return None
    return Initialised(vector, covariance, distances)


def initialise_by_newest(
    poses: Array, boxes: list[BoxMeasurement], K: Array, robust_scale: float, settings: InitialisationSettings
) -> Initialised | None:
    """As `initialise`, of N boxes in the order of time, or of the newer half of them, or of the newer half of that ...

    Odometry that drifts fast soon contradicts the boxes of an object that is long in view; over the last stretch it is
    still right. An object that had to agree with all of its boxes would never be one.
    """
    found = None
    while found is None and len(boxes) >= settings.min_boxes:
        found = initialise(poses, boxes, K, robust_scale, settings)
        older = max(len(boxes) // 2, 1)
        poses, boxes = poses[older:], boxes[older:]
    return found


def _first_guess(poses: Array, corners: Array, clip: NDArray[np.bool_], K: Array) -> Array | None:
    """Vector (9,) of an ellipsoid with the axes of the middle view; None if it is behind a camera."""
    whole = ~clip.any(axis=1)
    use = whole if np.count_nonzero(whole) >= 3 else np.ones(len(poses), bool)
    poses, corners = poses[use], corners[use]
    centres = np.stack([corners[:, 0] + corners[:, 2], corners[:, 1] + corners[:, 3]], axis=1) / 2
    rays = np.concatenate([centres, np.ones((len(centres), 1))], axis=1) @ np.linalg.inv(K).T
    rays = np.einsum("nij,nj->ni", poses[:, :3, :3], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # projects onto the plane across each ray
    A, b = across.sum(axis=0), np.einsum("nij,nj->i", across, poses[:, :3, 3])
    centre = np.linalg.lstsq(A, b, rcond=1e-9)[0]
    depths = np.einsum("nij,nj->ni", poses[:, :3, :3].transpose(0, 2, 1), centre - poses[:, :3, 3])[:, 2]
    if np.count_nonzero(depths > 0.0) < len(depths):
        return None
    half_width = np.median(depths * (corners[:, 2] - corners[:, 0])) / (2 * K[0, 0])
    half_height = np.median(depths * (corners[:, 3] - corners[:, 1])) / (2 * K[1, 1])
    T = np.eye(4)
    T[:3, :3] = poses[len(poses) // 2, :3, :3]
    T[:3, 3] = centre
    return Ellipsoid(T, np.array([half_width, half_height, np.sqrt(half_width * half_height)])).vector()


@numba.njit(cache=True)
def _normal_equations(poses, vector, K, corners, whiteners, bounds, clip, k, A, b, distances):  # type: ignore[no-untyped-def]
    """Adds the boxes to A (9, 9) and b (9,), writes the distances (N,); returns the cost."""
    cost = 0.0
    for n in range(len(poses)):
        visible, r, dr = whitened_residual(poses[n], vector, K, corners[n], whiteners[n], bounds[n], clip[n])
        q = r @ r if visible else INVISIBLE**2
        rho, weight = robust_loss(q, k)
        cost += rho
        distances[n] = np.sqrt(q)
        if visible:
            J = np.ascontiguousarray(dr[:, 6:])
            A += weight * (J.T @ J)
            b -= weight * (J.T @ r)
    return cost


@numba.njit(cache=True)
def _refine(poses, guess, K, corners, whiteners, bounds, clip, k, prior):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt over one quadric; the prior (9, 9 information) sits at the guess.

    Returns vector (9,), information (9, 9) and the distance of each box.
    """
    distances, scratch = np.empty(len(poses)), np.empty(len(poses))
    damping, cost = 1e-2, np.inf
    A, b, step = np.empty((9, 9)), np.empty(9), np.zeros(9)
    best, A_best, b_best = guess.copy(), prior.copy(), np.zeros(9)
    for _ in range(50):
        vector = best + step
        A[:] = prior
        b[:] = prior @ (guess - vector)
        c = (guess - vector) @ b
        c += _normal_equations(poses, vector, K, corners, whiteners, bounds, clip, k, A, b, scratch)
        if c <= cost:
            converged = cost - c < 1e-4 * c
            cost, best, A_best, b_best = c, vector, A.copy(), b.copy()
            distances[:] = scratch
            damping = max(damping / 10.0, 1e-6)
            if converged:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
        step[:] = np.linalg.solve(A_best + damping * np.diag(np.diag(A_best)), b_best)
    return best, A_best, distances
