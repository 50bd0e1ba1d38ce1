"""Covariances of measured boxes: the models the document compares (sections 4.3.1, 5.2.1 and 5.2.4).

`fixed` gives every edge the same standard deviation (eq. 5.2.1). `quadricslam` takes for each object the spread
of its box sizes over time (eq. 4.3.1): online as a running estimate over the boxes seen so far, since a robot does
not know the ones to come, and over all of them where the whole graph is optimised at the end (`--batch`).
`calibrated` believes the covariance that came with the box (eq. 4.3.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import Settings, setting

FIXED, QUADRICSLAM, CALIBRATED = "fixed", "quadricslam", "calibrated"


@dataclass(frozen=True)
class NoiseSettings(Settings):
    noise_model: str = setting(
        CALIBRATED, "where the covariance of a box comes from", choices=(CALIBRATED, FIXED, QUADRICSLAM)
    )
    fixed_sigma: float = setting(
        5.0, "edge of a box: model fixed, and boxes of unknown covariance", unit="px", low=0.1, high=1000.0
    )
    covariance_scale: float = setting(
        1.0, "factor on every standard deviation; 2 is underconfident, 0.5 overconfident", low=1e-3, high=1e3
    )


class RunningSpread:
    """Standard deviation of width plus that of height of an object's boxes (eq. 4.3.1), as they come in."""

    def __init__(self) -> None:
        self.count = 0
        self._mean = np.zeros(2)
        self._sum_of_squares = np.zeros(2)

    def add(self, corners: Array) -> None:
        """One more box (4,) xmin ymin xmax ymax [px] (Welford's update)."""
        size = corners[2:] - corners[:2]
        self.count += 1
        difference = size - self._mean
        self._mean += difference / self.count
        self._sum_of_squares += difference * (size - self._mean)

    def sigma(self) -> float:
        """sigma_w + sigma_h [px]; NaN before the second box."""
        if self.count < 2:
            return np.nan
        return float(np.sqrt(self._sum_of_squares / self.count).sum())


# A box seen twice alike has no spread; a detector is never better than this [px].
LEAST_SPREAD = 1.0


def spread(corners: Array) -> float:
    """sigma_w + sigma_h [px] of boxes (N, 4) of one object (eq. 4.3.1)."""
    return max(float((corners[:, 2:] - corners[:, :2]).std(axis=0).sum()), LEAST_SPREAD)


class NoiseModel:
    """Gives each box of an object the covariance the factor graph uses."""

    def __init__(self, settings: NoiseSettings) -> None:
        self._settings = settings
        self._spreads: dict[int, RunningSpread] = {}

    def observe(self, object_key: int, corners: Array) -> None:
        """A box (4,) of an object was seen."""
        if self._settings.noise_model == QUADRICSLAM:
            self._spreads.setdefault(object_key, RunningSpread()).add(corners)

    def covariance(self, object_key: int, own: Array) -> Array:
        """(4, 4) [px^2] for a box of this object whose message says `own` (4, 4), NaN where unknown."""
        settings, sigma = self._settings, self._settings.fixed_sigma
        if settings.noise_model == CALIBRATED and not np.isnan(own[0, 0]):
            return settings.covariance_scale**2 * own
        if settings.noise_model == QUADRICSLAM and object_key in self._spreads:
            running = self._spreads[object_key].sigma()
            sigma = sigma if np.isnan(running) else max(running, LEAST_SPREAD)
        return np.eye(4) * (settings.covariance_scale * sigma) ** 2
