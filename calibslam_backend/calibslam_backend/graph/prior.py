"""What is believed of a quadric before its boxes: hardly more than that it is no needle and no disc."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import Settings, setting


@dataclass(frozen=True)
class PriorSettings(Settings):
    prior_centre: float = setting(10.0, "weak prior on the centre of a quadric", unit="m", low=1e-3)
    prior_shape: float = setting(0.3, "prior on the proportions of a quadric: logarithm of its radii", low=1e-3)
    prior_size: float = setting(1.0, "weak prior on the size of a quadric: logarithm of its radii", low=1e-3)

    def prior_covariance(self) -> Array:
        """(9, 9) of centre and logarithmic shape around the first guess.

        The first guess knows proportions, but hardly sizes: early objects all share the error that odometry had
        made by then, and a prior on their sizes would make it the scale of the map.
        """
        return prior_covariance(self.prior_centre, self.prior_shape, self.prior_size)


def prior_covariance(centre: float, shape: float, size: float) -> Array:
    """(9, 9) from the standard deviations of centre [m], proportions and size [log m]."""
    covariance = np.eye(9) * centre**2
    direction = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) / np.sqrt(3.0)
    share = np.outer(direction, direction)
    covariance[3:, 3:] = shape**2 * (np.eye(6) - share) + size**2 * share
    return covariance
