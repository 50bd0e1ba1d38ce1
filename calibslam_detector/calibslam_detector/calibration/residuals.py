"""Errors in units of what a network says they may be."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class CalibrationError(ValueError):
    """Predictions or targets that no calibration loss can use; the text says what is wrong with them."""


def standardised(mean: Tensor, covariance: Tensor, target: Tensor) -> Tensor:
    """z = L^-1 (target - mean) with covariance = L L^T (eq. 4.2.5): standard normal where the covariance is true.

    Args:
        mean, target: (N, d).
        covariance: variances (N, d) or matrices (N, d, d), in squared units of the target.

    Returns:
        (N, d), without unit.

    Raises:
        CalibrationError: shapes that do not fit, numbers that are not finite, a covariance that is not positive.
    """
    n_d = tuple(mean.shape)
    if len(n_d) != 2 or target.shape != mean.shape or tuple(covariance.shape) not in (n_d, (*n_d, n_d[1])):
        raise CalibrationError(
            "mean and target must be (N, d), the covariance (N, d) or (N, d, d); got "
            f"{n_d}, {tuple(target.shape)} and {tuple(covariance.shape)}"
        )
    for name, values in (("mean", mean), ("target", target), ("covariance", covariance)):
        bad = int((~torch.isfinite(values)).sum())
        if bad:
            raise CalibrationError(f"{bad} of {values.numel()} numbers of the {name} are not finite")
    error = target - mean
    if covariance.dim() == 2:
        if bool((covariance <= 0.0).any()):
            raise CalibrationError(f"a variance is {float(covariance.min()):g}, not positive; see bounded_variance")
        return error / covariance.sqrt()
    L = cholesky(covariance)
    z: Tensor = torch.linalg.solve_triangular(L, error[:, :, None], upper=False)[:, :, 0]
    return z


def cholesky(covariance: Tensor) -> Tensor:
    """Lower triangular L (N, d, d) with L L^T = covariance.

    Raises:
        CalibrationError: a matrix that is not positive definite.
    """
    L, failed = torch.linalg.cholesky_ex(covariance)
    if bool(failed.any()):
        raise CalibrationError(f"{int((failed > 0).sum())} of {len(L)} covariances are not positive definite")
    return L


def bounded_variance(raw: Tensor, low: float, high: float) -> Tensor:
    """A variance between two bounds from a network's output, low^(1-s) high^s with s = logistic(raw).

    Sums of squared z are quartic in 1/sigma after the divergence squares them: with an exponential instead, one
    sample whose sigma comes too near zero decides the gradient of its batch, and a sigma may escape to infinity where
    that gradient vanishes. Between bounds z is at most |error|/sqrt(low), and the logistic takes the gradient back as
    a bound comes near. The published code bounds the variance itself by a logistic, from 1e-3 to 10; bounding its
    logarithm gives a unit of `raw` the same relative effect at both ends.
    """
    return torch.exp(math.log(low) + math.log(high / low) * torch.sigmoid(raw))
