"""Visual odometry that fails: for a while it says anything, or that nothing moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from calibslam_msgs_py.measurements import SECOND, Array, RelativeMotion


@dataclass(frozen=True)
class OdometryFailures:
    """How often odometry fails, for how long, and what it says then.

    Attributes:
        every: time between two failures [s], give or take a third.
        shortest, longest: how long they last [s].
        nothing: share of the steps that say that nothing moved.
        nearly: share of the steps that are wrong by a quarter of what others are.
        angular_velocity, velocity: standard deviation of what the others say about each axis [rad/s, m/s], which has
            nothing to do with the motion.
    """

    every: float = 15.0
    shortest: float = 0.4
    longest: float = 1.0
    nothing: float = 0.2
    nearly: float = 0.3
    angular_velocity: float = 1.5
    velocity: float = 2.0

    def spoil(self, motions: Sequence[RelativeMotion], rng: np.random.Generator) -> list[RelativeMotion]:
        """The same motions with failures drawn by `rng`; what they state of their covariance stays."""
        if not motions:
            return []
        times = self._times(motions[0].start, motions[-1].end, rng)
        return [
            replace(motion, T_start_end=self._said(motion, rng))
            if any(begin <= motion.start < end for begin, end in times)
            else motion
            for motion in motions
        ]

    def _times(self, start: int, end: int, rng: np.random.Generator) -> list[tuple[int, int]]:
        """From when to when [ns] it fails."""
        times: list[tuple[int, int]] = []
        begin = start
        while True:
            begin += round(self.every * rng.uniform(2.0 / 3.0, 4.0 / 3.0) * SECOND)
            if begin >= end:
                return times
            times.append((begin, begin + round(rng.uniform(self.shortest, self.longest) * SECOND)))

    def _said(self, motion: RelativeMotion, rng: np.random.Generator) -> Array:
        """(4, 4) what a step that fails says."""
        kind = rng.random()
        wrong = rng.normal(size=6) * np.repeat([self.angular_velocity, self.velocity], 3)
        seconds = (motion.end - motion.start) / SECOND
        if kind < self.nothing:
            return np.eye(4)
        if kind < self.nothing + self.nearly:
            error = gtsam.Pose3.Expmap(0.25 * wrong * seconds)
            return np.asarray(motion.T_start_end @ error.matrix())
        return np.asarray(gtsam.Pose3.Expmap(wrong * seconds).matrix())
