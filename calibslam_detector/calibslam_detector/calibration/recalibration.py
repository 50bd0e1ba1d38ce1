"""Calibration after training, on data that were held out: maps of standardised residuals.

Both are fitted to the residuals of held-out data and then called with those of new data; what they return is
calibrated where the new data are like the held-out ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm
from sklearn.isotonic import IsotonicRegression

from calibslam_msgs_py.measurements import Array


@dataclass(frozen=True)
class TemperatureScaling:
    """One factor on every standard deviation (Guo et al., 2017, for regression: Laves et al., 2020).

    Attributes:
        factor: a covariance times its square is the calibrated one.
    """

    factor: float

    @classmethod
    def fit(cls, z: Array) -> TemperatureScaling:
        """The factor of greatest likelihood, the root mean square of the held-out z of any shape."""
        return cls(float(np.sqrt(np.mean(np.square(_usable(z))))))

    def __call__(self, z: Array) -> Array:
        """Standardised residuals under the calibrated covariance."""
        return np.asarray(z) / self.factor


@dataclass(frozen=True)
class IsotonicRecalibration:
    """A monotonic map R of probabilities (Kuleshov et al., 2018): what was predicted with p happens with R(p).

    What it predicts is no normal distribution any more, so there is no covariance for a factor graph; the values
    it returns are standard normal where it is right.
    """

    R: IsotonicRegression

    @classmethod
    def fit(cls, z: Array) -> IsotonicRecalibration:
        """The map from held-out z of any shape."""
        z = np.sort(_usable(z).ravel())
        n = len(z)
        # The i-th of n is expected at (i - 1/2)/n: never at 0 or 1, where the map would give infinite residuals.
        observed = (np.arange(n) + 0.5) / n
        return cls(IsotonicRegression(out_of_bounds="clip").fit(norm.cdf(z), observed))

    def __call__(self, z: Array) -> Array:
        """Standard normal values with the probabilities that the map gives to z."""
        z = np.asarray(z)
        return np.asarray(norm.ppf(self.R.predict(norm.cdf(z.ravel()))).reshape(z.shape))


def _usable(z: Array) -> Array:
    z = np.asarray(z, float)
    if z.size == 0 or not np.isfinite(z).all():
        raise ValueError(f"recalibration needs finite standardised residuals, at least one; got {z.size}")
    return z
