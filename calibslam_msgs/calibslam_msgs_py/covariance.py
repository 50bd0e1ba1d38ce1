"""Covariances: the order GTSAM uses, the order ROS uses, and what makes one usable."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibslam_msgs_py.measurements import Array

# Limits on a covariance that is read from a message, after scaling it to unit diagonal so that units do not
# matter: asymmetry that rounding explains, and the smallest eigenvalue that can be inverted sensibly.
SYMMETRY_TOLERANCE = 1e-6
DEFINITE_LIMIT = 1e-10
# Variances beyond these, in whatever SI unit or pixels, are garbage that no double can be weighted with: a nanometre
# and farther than the moon.
SMALLEST_VARIANCE, LARGEST_VARIANCE = 1e-18, 1e18


def ros_from_gtsam_jacobian(R: Array) -> Array:
    """J (6, 6): [x y z, fixed-axis rotation] = J [rotation, translation], for a pose of rotation R (3, 3).

    GTSAM perturbs a pose on the right, T Exp([w, v]): the position moves by R v, and the orientation becomes
    R Exp(w) = Exp(R w) R, a rotation by R w about the fixed axes of the parent frame.
    """
    J = np.zeros((6, 6))
    J[:3, 3:] = R
    J[3:, :3] = R
    return J


def ros_from_gtsam_covariance(covariance: Array, R: Array) -> Array:
    """Covariance (6, 6) of [x y z, fixed-axis rotation] from that of GTSAM's Pose3 tangent.

    Args:
        covariance: (6, 6) of [rotation, translation] in the body frame.
        R: (3, 3) rotation of the pose, parent frame from body frame.
    """
    J = ros_from_gtsam_jacobian(R)
    return J @ covariance @ J.T


def gtsam_from_ros_covariance(covariance: Array, R: Array) -> Array:
    """The inverse of `ros_from_gtsam_covariance` (J is orthogonal)."""
    J = ros_from_gtsam_jacobian(R)
    return J.T @ covariance @ J


def symmetric(covariances: Array) -> Array:
    """(..., n, n) without the rounding that makes a product of matrices asymmetric."""
    return 0.5 * (covariances + np.swapaxes(covariances, -1, -2))


def is_covariance(matrices: Array) -> NDArray[np.bool_]:
    """(...,) whether each of the matrices (..., n, n) is finite, symmetric, positive definite and of sensible size.

    A singular matrix would claim that some direction is known exactly; no factor can be weighted with it.
    """
    variances = np.diagonal(matrices, axis1=-2, axis2=-1)
    sensible = (variances >= SMALLEST_VARIANCE) & (variances <= LARGEST_VARIANCE)
    # No covariance is larger than the variances: this also keeps what follows from overflowing.
    usable = np.asarray(sensible.all(axis=-1) & (np.abs(matrices) <= LARGEST_VARIANCE).all(axis=(-1, -2)))
    safe = np.where(usable[..., None, None], matrices, np.eye(matrices.shape[-1]))
    scale = 1.0 / np.sqrt(np.diagonal(safe, axis1=-2, axis2=-1))
    correlation = scale[..., :, None] * safe * scale[..., None, :]
    asymmetry = np.abs(correlation - np.swapaxes(correlation, -1, -2)).max(axis=(-1, -2))
    smallest = np.linalg.eigvalsh(symmetric(correlation))[..., 0]
    return usable & (asymmetry <= SYMMETRY_TOLERANCE) & (smallest > DEFINITE_LIMIT)
