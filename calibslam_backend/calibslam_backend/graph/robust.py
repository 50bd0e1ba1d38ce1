"""The outlier model: a Gaussian that is believed as far as it is likely, with a heavy tail beyond.

Detectors and odometry err in two ways: a little, as their covariance says, and grossly (wrong object, half of it
hidden, lost track). The squared Mahalanobis distance q of a measurement therefore enters the optimisation as

    rho(q) = q                        up to k^2,
    rho(q) = k^2 (1 + log(q / k^2))   beyond,

the negative log-likelihood of a distribution that is Gaussian up to the distance k and falls off with the power k^2 of
the distance from there. Its weight d rho / d q is 1, then k^2 / q: a good measurement counts fully, so that a
calibrated covariance keeps its meaning (Cauchy's loss takes half of the information of Gaussian measurements
away), and a bad one ever less, but never nothing, so that an estimate that is still far off is pulled right.

Factors are whitened and weighted here, not by GTSAM: residual and Jacobian times the square root of the weight when
they are linearised (iteratively reweighted least squares), and when only the error is asked for, a residual with half
the squared length rho / 2. The derivative of sqrt(rho) itself would be far too flat for doubtful measurements, and
Gauss-Newton steps without line search, such as those of ISAM2, would overshoot.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True)
def robust_loss(q, k):  # type: ignore[no-untyped-def]
    """rho(q) and its derivative, the weight."""
    if q <= k * k:
        return q, 1.0
    return k * k * (1.0 + np.log(q / (k * k))), k * k / q


@numba.njit(cache=True)
def robust_scales(q, k):  # type: ignore[no-untyped-def]
    """Factors of a whitened residual with squared length q: for its error to be rho / 2, and for its linearisation."""
    rho, weight = robust_loss(q, k)
    return np.sqrt(rho / q) if q > 0.0 else 1.0, np.sqrt(weight)
