"""How honest covariances are, as pure functions of numpy arrays.

Most take standardised residuals z (N, d): see `whitened`. Expectations are those of a normal distribution.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular
from scipy.stats import chi2

from calibslam_msgs_py.measurements import Array

# Probabilities 0.05, 0.10 ... 0.95, the bins of the f-Cal paper; 0 and 1 are met by every predictor.
LEVELS = np.arange(1, 20) / 20.0
ENERGY_SAMPLES = 100


def whitened(errors: Array, covariances: Array) -> Array:
    """z (N, d) = L^-1 error with covariance = L L^T.

    Args:
        errors: (N, d), target minus prediction.
        covariances: variances (N, d) or matrices (N, d, d), in squared units of the errors.

    Raises:
        numpy.linalg.LinAlgError: a matrix that is not positive definite.
    """
    errors, covariances = np.asarray(errors, float), np.asarray(covariances, float)
    if covariances.ndim == 2:
        return np.asarray(errors / np.sqrt(covariances))
    L = np.linalg.cholesky(covariances)
    return np.asarray(solve_triangular(L, errors[:, :, None], lower=True)[:, :, 0])


def coverage(z: Array, levels: Array = LEVELS) -> Array:
    """Share of rows (N, d) inside the ellipsoid of each probability, |z|^2 <= quantile of chi-squared with d degrees
    of freedom; for d = 1 the central interval. For boxes (d = 4) that is the joint coverage.
    """
    z = _rows(z)
    return _share(np.square(z).sum(axis=1), z.shape[1], levels)


def coverage_of_sums(z: Array, K: int, levels: Array = LEVELS, rng: np.random.Generator | None = None) -> Array:
    """Share of sums of K squares that are below the quantile of each probability of chi-squared with K degrees.

    Args:
        z: (N, d); K/d rows make a sum, each row is in one sum, so sums of independent rows are independent.
        K: a multiple of d.
        levels: probabilities.
        rng: shuffles the rows; None: neighbours are summed.

    Raises:
        ValueError: K does not fit.
    """
    z = _rows(z)
    n, d = z.shape
    sums = n * d // K
    if K % d or not sums:
        raise ValueError(f"sums of K = {K} squares cannot be made of {n} residuals with {d} components")
    squares = np.square(z).sum(axis=1)
    if rng is not None:
        squares = rng.permutation(squares)
    return _share(squares[: sums * (K // d)].reshape(sums, -1).sum(axis=1), K, levels)


def ece_z(z: Array, levels: Array = LEVELS) -> float:
    """ECE(z): mean over the levels of |share inside - level|, of all components (any shape) alike.

    That of Kuleshov et al. (2018) with central intervals, of equal weight as all bins are of equal probability.
    """
    return float(np.abs(coverage(np.reshape(z, (-1, 1)), levels) - levels).mean())


def ece_q(z: Array, K: int, levels: Array = LEVELS, rng: np.random.Generator | None = None) -> float:
    """ECE(q): the same of sums of K squares; arguments as of `coverage_of_sums`. More sensitive to a common factor
    on all variances by sqrt(K/2), and at most 0.5.
    """
    return float(np.abs(coverage_of_sums(z, K, levels, rng) - levels).mean())


def negative_log_likelihood(errors: Array, covariances: Array) -> float:
    """Mean over rows of -log N(error; 0, covariance), natural logarithm; arguments as of `whitened`."""
    covariances = np.asarray(covariances, float)
    z = whitened(errors, covariances)
    log_determinants = np.log(covariances).sum(axis=1) if covariances.ndim == 2 else np.linalg.slogdet(covariances)[1]
    return float(0.5 * np.mean(np.square(z).sum(axis=1) + log_determinants + z.shape[1] * np.log(2.0 * np.pi)))


def energy_score(errors: Array, covariances: Array, rng: np.random.Generator, samples: int = ENERGY_SAMPLES) -> float:
    """Mean over rows of E|X - y| - E|X - X'|/2 with X, X' drawn from the prediction (Gneiting and Raftery, 2007).

    Proper, in units of the target, less is better; for d = 1 it is the CRPS. Each row's expectations are means over
    its own samples, of |X_i - y| and of |X_i - X_(i+1)| (Gneiting et al., 2008, eq. 7), so they are without bias and
    their noise falls with the number of rows too.
    """
    errors, covariances = np.asarray(errors, float), np.asarray(covariances, float)
    if samples < 2:
        raise ValueError(f"an energy score needs at least 2 samples, not {samples}")
    unit = rng.standard_normal((samples, *errors.shape))
    if covariances.ndim == 2:
        draws = unit * np.sqrt(covariances)
    else:
        draws = np.einsum("nij,mnj->mni", np.linalg.cholesky(covariances), unit)
    to_target = np.linalg.norm(draws - errors, axis=2).mean()
    to_each_other = np.linalg.norm(np.diff(draws, axis=0), axis=2).mean()
    return float(to_target - 0.5 * to_each_other)


def sharpness(covariances: Array) -> float:
    """Root of the mean variance over rows and components, in units of the target: how much a predictor dares to say.

    Only comparable between calibrated predictors.
    """
    covariances = np.asarray(covariances, float)
    variances = covariances if covariances.ndim == 2 else np.diagonal(covariances, axis1=1, axis2=2)
    return float(np.sqrt(variances.mean()))


def _rows(z: Array) -> Array:
    z = np.asarray(z, float)
    if z.ndim != 2 or z.size == 0 or not np.isfinite(z).all():
        raise ValueError(f"standardised residuals must be finite and (N, d) with N > 0, not {z.shape}")
    return z


def _share(squares: Array, degrees: int, levels: Array) -> Array:
    """Share of squares (N,) below the quantile of each level."""
    ordered = np.sort(squares)
    return np.asarray(np.searchsorted(ordered, chi2.ppf(levels, degrees), side="right") / len(ordered))
