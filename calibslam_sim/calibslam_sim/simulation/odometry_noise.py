"""Odometry that drifts: relative motions with an error of known covariance."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from calibslam_msgs_py.measurements import Array, RelativeMotion


@dataclass(frozen=True)
class OdometryNoise:
    """Gaussian error of one step, in the body frame at its end: T = T_true Exp(error).

    Attributes:
        rotation: standard deviation about each axis [rad].
        translation: standard deviation along each axis [m].
        gross_share: share of steps that fail grossly, with errors `gross_factor` times as large, of which the
            stated covariance says nothing (as with real visual odometry under fast motion).
        gross_factor: see above.
    """

    rotation: float
    translation: float
    gross_share: float = 0.0
    gross_factor: float = 10.0

    @property
    def covariance(self) -> Array:
        """(6, 6) of one step, [rotation, translation]."""
        return np.diag([self.rotation**2] * 3 + [self.translation**2] * 3)

    def perturb(self, T_start_end: Array, rng: np.random.Generator) -> Array:
        """The motion (4, 4) as measured; draws seven numbers whatever the settings are."""
        error = rng.standard_normal(6) * ([self.rotation] * 3 + [self.translation] * 3)
        if rng.random() < self.gross_share:
            error *= self.gross_factor
        return np.asarray(T_start_end @ gtsam.Pose3.Expmap(error).matrix())


def add_noise(motion: RelativeMotion, noise: OdometryNoise, rng: np.random.Generator) -> RelativeMotion:
    """The motion with additional error; a known covariance grows by what was added, an unknown one stays so.

    A covariance of all zeros (exact motion, nothing added) would claim certainty, so it comes out as unknown.
    """
    covariance = None if motion.covariance is None else motion.covariance + noise.covariance
    if covariance is not None and not covariance.any():
        covariance = None
    return RelativeMotion(motion.start, motion.end, noise.perturb(motion.T_start_end, rng), covariance, motion.frame_id)
