"""Maximum likelihood of the standard deviation of edges, with outliers modelled.

An edge's residual e is drawn from

    p(e) = (1 - share) N(0, sigma^2) + share N(0, (spread sigma)^2),    log sigma = intercept + features . coefficients,

the core that a covariance can describe, and broad outliers (hidden halves, wrong objects) that would otherwise blow
it up: residuals of real detectors have an rms of five times their median. The back end doubts outliers anyway.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import LinearConstraint, minimize
from scipy.special import expit
from scipy.stats import norm

from calibslam_msgs_py.measurements import Array

# Keeps a coefficient at zero that the data say nothing about; of coefficients per standard deviation of the feature,
# against the mean log-likelihood of an edge.
RIDGE = 1e-3
LARGEST_LOGARITHM = 7.0  # of sigma [log px] and of the spread
NEARLY = 1.0 - 1e-6  # of what is allowed: limits are met to rounding


@dataclass(frozen=True)
class EdgeMixture:
    """A fitted model.

    Attributes:
        intercept: log sigma [log px] where all features are zero.
        coefficients: (F,).
        outlier_share: share of the outliers, in (0, 1).
        outlier_spread: their standard deviation in units of sigma, above 1.
    """

    intercept: float
    coefficients: Array
    outlier_share: float
    outlier_spread: float

    def sigmas(self, features: Array) -> Array:
        """(N,) standard deviations [px] of the core, of features (N, F)."""
        return np.asarray(np.exp(self.intercept + features @ self.coefficients))

    def negative_log_likelihoods(self, errors: Array, features: Array) -> Array:
        """(N,) of errors (N,) [px]."""
        return _terms(errors, np.log(self.sigmas(features)), self.outlier_share, self.outlier_spread)[0]

    def inliers(self, errors: Array, features: Array) -> Array:
        """(N,) probability that an error is of the core."""
        return _terms(errors, np.log(self.sigmas(features)), self.outlier_share, self.outlier_spread)[1]


def _terms(errors: Array, log_sigmas: Array, share: float, spread: float) -> tuple[Array, Array]:
    """Negative log-likelihood and probability of the core."""
    z = errors * np.exp(-log_sigmas)
    core = np.log1p(-share) + norm.logpdf(z) - log_sigmas
    outlier = np.log(share) + norm.logpdf(z / spread) - np.log(spread) - log_sigmas
    return -np.logaddexp(core, outlier), expit(core - outlier)


def fit_mixture(errors: Array, features: Array, largest: Array | None = None) -> EdgeMixture:
    """The model of largest likelihood.

    Args:
        errors: (N,) [px].
        features: (N, F); F = 0 gives the best constant.
        largest: (1 + F,) absolute values that intercept and coefficients may have; None: any. A feature that hardly
            varies, as the scores of a confident detector, asks for a steep slope, and what that says of values that
            were never seen is absurd.
    """
    mean, scale = features.mean(axis=0), features.std(axis=0)
    scale = np.where(scale > 1e-9, scale, np.inf)  # a feature that never changes tells nothing
    standardised = (features - mean) / scale

    def loss(parameters: Array) -> tuple[float, Array]:
        share, spread = expit(parameters[0]), 1.0 + np.exp(parameters[1])
        log_sigmas = parameters[2] + standardised @ parameters[3:]
        values, core = _terms(errors, log_sigmas, share, spread)
        squares = (errors * np.exp(-log_sigmas)) ** 2
        by_log_sigma = 1.0 - core * squares - (1.0 - core) * squares / spread**2
        gradient = np.empty(len(parameters))
        gradient[0] = np.mean(share - (1.0 - core))
        gradient[1] = np.mean((1.0 - core) * (1.0 / spread - squares / spread**3)) * (spread - 1.0)
        gradient[2] = by_log_sigma.mean()
        gradient[3:] = standardised.T @ by_log_sigma / len(errors) + 2.0 * RIDGE * parameters[3:]
        return float(values.mean() + RIDGE * parameters[3:] @ parameters[3:]), gradient

    median = max(float(np.median(np.abs(errors))), 1e-3)
    start = np.concatenate([[-2.0, 1.0, np.log(1.5 * median)], np.zeros(features.shape[1])])
    limit = LARGEST_LOGARITHM
    bounds = [(-limit, 0.0), (-2.0, limit), (-limit, limit)] + [(-3.0, 3.0)] * features.shape[1]
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    if largest is not None:
        # Intercept and coefficients of the features as they are, from the parameters.
        unscaled = np.zeros((len(largest), len(start)))
        unscaled[0, 2:] = np.concatenate([[1.0], -mean / scale])
        unscaled[1:, 3:] = np.diag(1.0 / scale)
        if (np.abs(unscaled @ found) > largest).any():
            inside = NEARLY * largest
            limits = LinearConstraint(unscaled, -inside, inside)
            found = minimize(loss, start, jac=True, method="SLSQP", bounds=bounds, constraints=[limits]).x
    coefficients = found[3:] / scale
    return EdgeMixture(
        float(found[2] - mean @ coefficients), coefficients, float(expit(found[0])), float(1.0 + np.exp(found[1]))
    )
