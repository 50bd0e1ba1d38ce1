"""Failures of odometry: which of its steps are no measurements, and how the body moved then.

Visual odometry fails now and then, for a step or for a second: too little in view, too much blur. Then it says
anything, or that nothing moved at all. A limit on what a body can do does not find that: one that real motion never
exceeds lets most of it through, and in a row of wrong steps one agrees with another by chance. So what a body does and
how much this odometry usually errs are both taken into account, step by step.

The velocity v of the body is a random walk. A step measures it with noise of the variance R that is usual for this
odometry, or it fails, and tells nothing: then it says v plus an error of a variance B besides. Failing goes on, as a
Markov chain of two states. Given v ~ N(m, P) before, and q P's growth, a step z has failed with the probability p,

    p / (1 - p) = prior * N(z - m; P + q + R + B) / N(z - m; P + q + R),

and v is afterwards the mixture of what it would be in either case, of which mean and variance are kept (the generalised
pseudo-Bayesian filter of first order; Ackerson and Fu 1970). The motion of the step is that mixture as well: as measured
if it did not fail, going on as before if it did, and in doubt both, with what they differ by as uncertainty.

R is read off the steps themselves: half the median squared difference of consecutive ones, which failures do not
move as long as they are fewer than the others. Rotation and translation have variances of their own, each for one axis.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import Settings, setting


@dataclass(frozen=True)
class FailureSettings(Settings):
    """When a step of odometry is believed."""

    max_speed: float = setting(
        100.0, "speed that a body can have: a faster motion is a failure of odometry", unit="m/s", low=0.1
    )
    agility: float = setting(
        1.0, "how much a body's velocity changes in one second: standard deviation", unit="m/s and rad/s", low=1e-3
    )
    failure_error: float = setting(
        1.0, "how wrong velocities are when odometry fails: standard deviation", unit="m/s and rad/s", low=1e-3
    )
    failure_begins: float = setting(0.02, "share of good steps after which odometry fails", low=0.0, high=0.5)
    failure_ends: float = setting(0.15, "share of failed steps after which it is good again", low=0.01, high=1.0)


@dataclass(frozen=True)
class BelievedStep:
    """What is believed of one step.

    Attributes:
        velocity: (6,) [rad/s, m/s].
        variance: (2,) of it for each axis of rotation and of translation, beyond the noise of a good step.
        failed: probability that odometry failed.
    """

    velocity: Array
    variance: Array
    failed: float


class FailureFilter:
    """Goes through the steps of one odometry."""

    REMEMBERED = 30  # steps of which the usual noise is read off
    LEAST = 10  # before there are so many, it is taken to be
    FIRST_NOISE = 0.3  # [rad/s, m/s]
    LEAST_NOISE = 0.05  # [rad/s, m/s]
    OPEN = 1e6  # variance that says: not measured
    SURE = 0.01  # probability of a failure below which a step is taken as it is
    # Visual odometry that finds nothing often says that nothing moved. Of a body that does move that is no measurement,
    # unless it goes on so long that it must have stopped.
    STILL, MOVING, STOPPED = 1e-9, 0.02, 1.0  # [rad/s, m/s], [rad/s, m/s], [s]
    MEDIAN = 2.366 / 3.0  # of chi-squared with three degrees of freedom, per degree

    def __init__(self, settings: FailureSettings, is_visual: bool = True) -> None:
        """Of nothing yet; `is_visual`: whether no motion at all is said of a body that moves."""
        self._settings = settings
        self._is_visual = is_visual
        self._changes: deque[Array] = deque(maxlen=self.REMEMBERED)
        self._noise = np.full(2, self.FIRST_NOISE**2)
        self._failed = self._still = 0.0
        self._last: Array | None = None  # as measured
        self._velocity, self._variance = np.zeros(6), np.full(2, settings.agility**2)

    def unseen(self, seconds: float) -> None:
        """So long nothing was measured."""
        self._variance = self._variance + self._settings.agility**2 * seconds

    def believe(self, velocity: Array, seconds: float, covariance: Array | None) -> BelievedStep:
        """What to believe of the next step.

        Args:
            velocity: (6,) as measured [rad/s, m/s].
            seconds: its duration.
            covariance: (6, 6) of its motion, if stated: the noise of a good step is at least this.
        """
        s = self._settings
        self.unseen(seconds)
        before, P = self._velocity, self._variance
        if self._says_nothing(velocity, seconds, covariance) or np.linalg.norm(velocity[3:]) > s.max_speed:
            self._failed = 1.0
            return BelievedStep(before, P, 1.0)
        is_first = self._last is None
        self._learn_noise(velocity)
        R = self._noise
        if covariance is not None:
            stated = np.array([covariance[:3, :3].trace(), covariance[3:, 3:].trace()]) / (3.0 * seconds**2)
            R = np.clip(stated, R, self.OPEN)
        if is_first:
            self._velocity, self._variance = velocity, R
            return BelievedStep(velocity, np.zeros(2), 0.0)
        good, bad = P + R, P + R + s.failure_error**2
        innovation = velocity - before
        squared = _mean_squares(innovation)
        evidence = 1.5 * np.sum(squared * (1.0 / good - 1.0 / bad) - np.log(bad / good))
        prior = self._failed * (1.0 - s.failure_ends) + (1.0 - self._failed) * s.failure_begins
        p = self._failed = _probability(evidence, prior)
        # The mixture of an update with gain K and of none.
        K = P / good
        self._velocity = before + np.repeat((1.0 - p) * K, 3) * innovation
        self._variance = (1.0 - p) * (1.0 - K) * P + p * P + p * (1.0 - p) * K**2 * squared
        if p < self.SURE:
            return BelievedStep(velocity, np.zeros(2), p)
        return BelievedStep((1.0 - p) * velocity + p * before, p * P + p * (1.0 - p) * squared, p)

    def _says_nothing(self, velocity: Array, seconds: float, covariance: Array | None) -> bool:
        """Whether it says that a moving body does not move."""
        if not self._is_visual or covariance is not None or np.abs(velocity).max() > self.STILL:
            self._still = 0.0
            return False
        self._still += seconds
        return self._still < self.STOPPED and bool(np.abs(self._velocity).max() > self.MOVING)

    def _learn_noise(self, velocity: Array) -> None:
        last, self._last = self._last, velocity
        if last is None or np.abs(velocity).max() <= self.STILL:
            return
        self._changes.append(_mean_squares(velocity - last))
        if len(self._changes) >= self.LEAST:
            usual = np.median(np.array(self._changes), axis=0) / self.MEDIAN / 2.0
            self._noise = np.maximum(usual, self.LEAST_NOISE**2)


def _mean_squares(velocity: Array) -> Array:
    """(2,) of rotation and translation, per axis."""
    return np.array([velocity[:3] @ velocity[:3], velocity[3:] @ velocity[3:]]) / 3.0


def _probability(evidence: float, prior: float) -> float:
    """Of a failure, from the logarithm of the ratio of likelihoods and the probability before."""
    if not 0.0 < prior < 1.0:
        return prior
    odds = np.log(prior / (1.0 - prior)) + evidence
    return float(1.0 / (1.0 + np.exp(-np.clip(odds, -500.0, 500.0))))
