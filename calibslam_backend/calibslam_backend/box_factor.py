"""The factor between a camera pose, a quadric and a measured box (document, eq. 4.3.3).

A detector errs in two ways: a little, as its covariance says, and grossly (wrong object, half of it hidden). So
the squared Mahalanobis distance q = r^T Sigma^-1 r of a box does not enter as it is, but as the negative
log-likelihood of a heavy-tailed (multivariate Cauchy-like) distribution, rho(q) = k^2 log(1 + q / k^2), which is
q for a good box and grows ever more slowly for a bad one. The four edges of a box share one q: gross errors concern
the whole box.

GTSAM's robust noise model weighs the residual of the whole box so, by its norm. The optimisers see J and r times the
square root of the weight (iteratively reweighted least squares), never a derivative of sqrt(rho): for a doubtful box
that is far too flat, and Gauss-Newton steps without a line search, such as those of ISAM2, overshoot.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numba
import numpy as np

from calibslam_backend.box_measurement import BoxMeasurement
from calibslam_backend.quadric import DIMENSION, POSE, QUADRIC, box_of_visible_part
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
def robust_loss(q, k):  # type: ignore[no-untyped-def]
    """rho(q) = k^2 log(1 + q / k^2) and its derivative, the weight of the box."""
    return k * k * np.log1p(q / (k * k)), 1.0 / (1.0 + q / (k * k))


_UNIT = gtsam.noiseModel.Unit.Create(4)


def box_factor(pose: int, quadric: int, box: BoxMeasurement, K: Array, robust_scale: float) -> gtsam.CustomFactor:
    """The factor for one box.

    Args:
        pose: key of a Pose3, T_map_camera.
        quadric: key of a (9,) vector (t, L), see `quadric`.
        box: what was measured.
        K: (3, 3) camera matrix [px].
        robust_scale: k, the Mahalanobis distance from which a box counts as doubtful.
    """
    corners, whitener, bounds, clip = (np.ascontiguousarray(a) for a in vars(box).values())
    noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(robust_scale), _UNIT)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        T, vector = values.atPose3(pose).matrix(), values.atVector(quadric)
        visible, r, J = whitened_residual(T, vector, K, corners, whitener, bounds, clip)
        if not visible:
            r, J = np.full(4, 0.5 * INVISIBLE), np.zeros((4, DIMENSION))
        if H is not None:
            H[0], H[1] = J[:, POSE], J[:, QUADRIC]
        return np.asarray(r)

    handler: Callable[[gtsam.CustomFactor, gtsam.Values, list[Array] | None], Array] = error
    return gtsam.CustomFactor(noise, [pose, quadric], handler)
