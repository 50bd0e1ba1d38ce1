"""Covariances of measured boxes: the models the document compares (sections 4.3.1, 5.2.1 and 5.2.4).

`fixed` gives every edge the same standard deviation (eq. 5.2.1). `quadricslam` takes for each object the spread
of its box sizes over time (eq. 4.3.1): online over the boxes seen so far, since a robot does not know the ones to come,
and over all of them where the whole graph is optimised at the end (`--batch`).
`calibrated` believes the covariance that came with the box (eq. 4.3.2).
"""

from __future__ import annotations

from collections.abc import Sequence
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


# A box seen twice alike has no spread; a detector is never better than this [px].
LEAST_SPREAD = 1.0


def spread(corners: Array) -> float:
    """sigma_w + sigma_h [px] of boxes (N, 4) of one object (eq. 4.3.1)."""
    return max(float((corners[:, 2:] - corners[:, :2]).std(axis=0).sum()), LEAST_SPREAD)


def box_covariance(settings: NoiseSettings, own: Array, so_far: Sequence[Array]) -> Array:
    """(4, 4) [px^2] that the factor graph uses for a box.

    Args:
        settings: the model.
        own: (4, 4) [px^2] that came with it, NaN where unknown.
        so_far: the boxes (4,) [px] of its object that were seen, this one included; only `quadricslam` looks at them.
    """
    sigma = settings.fixed_sigma
    if settings.noise_model == CALIBRATED and not np.isnan(own[0, 0]):
        return settings.covariance_scale**2 * own
    if settings.noise_model == QUADRICSLAM and len(so_far) > 1:
        sigma = spread(np.stack(so_far))
    return np.eye(4) * (settings.covariance_scale * sigma) ** 2
