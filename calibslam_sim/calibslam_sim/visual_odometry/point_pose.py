"""Pose of a camera from points whose places are known and seen: robust least squares, and how sure it is.

Most cameras expose row after row. A point in a row that is read `lag` seconds after the middle of the image is seen
from where the camera is then, T exp(lag * velocity) (Hedborg et al., "Rolling shutter bundle adjustment", CVPR 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from calibslam_msgs_py.measurements import Array

ITERATIONS = 10
CONVERGED = 1e-5  # [rad, m]
# A residual of so many standard deviations has a quarter of the weight of a small one (Geman and McClure, 1985).
OUTLIER = 3.0
INLIER_WEIGHT = 0.25
MAD_TO_SIGMA = 1.4826  # of a normal distribution
SMALLEST_SIGMA = 0.1  # [px]: no tracker is better


class Undetermined(ValueError):
    """The points do not determine a pose."""


@dataclass(frozen=True)
class PointPose:
    """A camera's pose in the frame of N points.

    Attributes:
        T: (4, 4) pose of the camera at the time of its middle row.
        sigma: standard deviation of a residual [px], of the inliers.
        inliers: (N,) bool.
        information: (6, 6) of [rotation, translation] in the camera for residuals of 1 px.
        lagged_information: (6, 6) the same with each point weighed by its lag [s].
    """

    T: Array
    sigma: float
    inliers: np.ndarray
    information: Array
    lagged_information: Array

    def covariance(self, sigma: float, velocity_sigma: Array) -> Array:
        """(6, 6) of the pose for residuals of `sigma` [px] and an error of the velocity.

        An error e of the velocity moves each point's residual by lag * J e, and so the solution by
        information^-1 lagged_information e.

        Args:
            sigma: of a residual [px].
            velocity_sigma: (6,) standard deviations of the velocity [rad/s, m/s].
        """
        inverse = np.linalg.inv(self.information)
        gain = inverse @ self.lagged_information
        return np.asarray(sigma**2 * inverse + (gain * velocity_sigma**2) @ gain.T)


def moved(points: Array, velocity: Array, seconds: Array) -> Array:
    """Points (N, 3) in a camera as it was, in the camera `seconds` (N,) before, if it moves by `velocity` (6,)."""
    return points + seconds[:, None] * (np.cross(velocity[:3], points) + velocity[3:])


def point_pose(points: Array, seen: Array, T: Array, focal_length: float, velocity: Array, lags: Array) -> PointPose:
    """The pose that minimises the robust reprojection error, by Gauss-Newton.

    Args:
        points: (N, 3) [m] in any frame.
        seen: (N, 2) where each is seen, in normalised image coordinates.
        T: (4, 4) a first guess.
        focal_length: [px], the unit of residuals.
        velocity: (6,) [rad/s, m/s] of the camera, in the camera.
        lags: (N,) when each point's row is read, after the image's middle row [s].

    Raises:
        Undetermined: the points do not determine it.
    """
    for _ in range(ITERATIONS):
        in_camera = (points - T[:3, 3]) @ T[:3, :3]
        at_row = moved(in_camera, -velocity, lags)
        residuals, J = _residuals(at_row, in_camera, seen, focal_length)
        sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(residuals))), SMALLEST_SIGMA)
        weights = (1.0 + (residuals**2).sum(axis=1) / (OUTLIER * sigma) ** 2) ** -2
        weighted = J * weights[:, None, None]
        flat, flat_weighted = J.reshape(-1, 6), weighted.reshape(-1, 6)
        information = flat_weighted.T @ flat
        try:
            step = -np.linalg.solve(information, flat_weighted.T @ residuals.ravel())
        except np.linalg.LinAlgError:
            raise Undetermined("the points do not determine a pose") from None
        T = T @ gtsam.Pose3.Expmap(step).matrix()
        if np.linalg.norm(step) < CONVERGED:
            break
    if not np.isfinite(T).all() or np.linalg.cond(information) > 1.0 / np.finfo(float).eps:
        raise Undetermined("the points do not determine a pose")
    lagged = (weighted * lags[:, None, None]).reshape(-1, 6).T @ flat
    return PointPose(T, sigma, weights > INLIER_WEIGHT, information, lagged)


def _residuals(at_row: Array, in_camera: Array, seen: Array, focal_length: float) -> tuple[Array, Array]:
    """Residuals (N, 2) [px] and their derivatives (N, 2, 6) by the camera's pose, [rotation, translation] in it."""
    depth = np.maximum(at_row[:, 2], 1e-6)
    projected = at_row[:, :2] / depth[:, None]
    by_point = np.zeros((len(depth), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = focal_length / depth
    by_point[:, :, 2] = -focal_length * projected / depth[:, None]
    # The camera moves by exp(x): a point Y in it becomes Y - w x Y - v.
    J = np.empty((len(depth), 2, 6))
    J[:, :, :3] = np.cross(by_point, in_camera[:, None, :])
    J[:, :, 3:] = -by_point
    return (projected - seen) * focal_length, J
