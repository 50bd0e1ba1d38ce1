"""Failures of odometry: which of its steps are no measurements, and how the body moved then.

Visual odometry fails now and then, for a step or for a second: too little in view, too much blur. Then it says
anything, or that nothing moved at all. A limit on what a body can do does not find that: one that real motion never
exceeds lets most of it through, and in a row of wrong steps one agrees with another by chance. So what a body does and
how much this odometry usually errs are both taken into account, step by step.

The velocity v of the body is a random walk. A step measures it with noise of the variance R that is usual for this
odometry, or it fails, and tells nothing: then it says v with an error that is broader, of the variance R + B. Failing
goes on, as a Markov chain of two states. Given v ~ N(m, P) before, grown by what it may have changed since, a step z
has failed with the probability p,

    p / (1 - p) = prior / (1 - prior) * N(z; m, P + R + B) / N(z; m, P + R),

and v is afterwards the mixture of what it would be in either case, of which mean and variance are kept (the generalised
pseudo-Bayesian filter of first order; Ackerson and Fu 1970). The motion of the step is that mixture as well: as
measured if it did not fail, going on as before if it did, in doubt both, with what they differ by as uncertainty.

R is read off the steps themselves: half the median squared difference of consecutive ones, which failures do not
move as long as they are fewer than the others, one for rotation and one for translation; or it is what the step states,
if that is more. B is `failure_error` squared and nine times R, so failures are broader than any noise.
"""

from __future__ import annotations

import math
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
        1.0,
        "how much the body's velocity changes in one second: standard deviation; raise it for racing drones",
        unit="m/s and rad/s",
        low=1e-3,
    )
    failure_error: float = setting(
        1.0, "how wrong velocities are when odometry fails: standard deviation", unit="m/s and rad/s", low=1e-3
    )
    failure_begins: float = setting(
        0.02, "probability that odometry fails in a step that follows a good one", low=0.0, high=0.5
    )
    failure_ends: float = setting(
        0.15, "probability that it is good again in a step that follows a failed one", low=0.01, high=1.0
    )


@dataclass(frozen=True)
class BelievedStep:
    """What is believed of one step.

    Attributes:
        velocity: (6,) [rad/s, m/s].
        variance: (6,) of it, beyond the noise of a good step.
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
    LEAST_NOISE, LARGEST_NOISE = 0.05, 1e3  # [rad/s, m/s]; more is stated of what is not measured
    NEW_MOTION = 5  # steps in a row that agree with each other are no failures, whatever the body did before
    SURE = 0.01  # probability of a failure below which a step is taken as it is
    # Visual odometry that finds nothing often says that nothing moved. Of a body that does move that is no measurement,
    # unless it goes on so long that it must have stopped.
    STILL, MOVING, STOPPED = 1e-9, 0.02, 1.0  # [rad/s, m/s], [rad/s, m/s], [s]
    BROADER = 3.0  # times the usual noise, besides `failure_error`
    MEDIAN = 2.366 / 3.0  # of chi-squared with three degrees of freedom, per degree

    def __init__(self, settings: FailureSettings, is_visual: bool = True) -> None:
        """Of nothing yet; `is_visual`: whether no motion at all is said of a body that moves."""
        self._settings = settings
        self._is_visual = is_visual
        self._changes: deque[Array] = deque(maxlen=self.REMEMBERED)
        self._noise = np.full(6, self.FIRST_NOISE**2)
        self._failed = self._still = 0.0
        self._agreeing = 0
        self._last: Array | None = None  # as measured
        self._velocity, self._variance = np.zeros(6), np.full(6, settings.agility**2)

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
        if self._says_nothing(velocity, seconds, covariance) or math.hypot(*velocity[3:]) > s.max_speed:
            self._failed = 1.0
            return BelievedStep(before, P, 1.0)
        last, self._last = self._last, velocity
        if last is not None:
            self._learn_noise(velocity, last)
        R = self._noise
        if covariance is not None:
            R = np.maximum(R, np.minimum(np.diag(covariance), (self.LARGEST_NOISE * seconds) ** 2) / seconds**2)
        if last is None or self._is_new_motion(velocity - last, R, seconds):
            self._velocity, self._variance, self._failed = velocity, R, 0.0
            return BelievedStep(velocity, np.zeros(6), 0.0)
        innovation = velocity - before
        prior = self._failed * (1.0 - s.failure_ends) + (1.0 - self._failed) * s.failure_begins
        p = self._failed = _probability(self._evidence(innovation, P + R, R), prior)
        # The mixture of an update with gain K and of none.
        K = P / (P + R)
        self._velocity = before + (1.0 - p) * K * innovation
        self._variance = (1.0 - p) * (1.0 - K) * P + p * P + p * (1.0 - p) * (K * innovation) ** 2
        if p < self.SURE:
            return BelievedStep(velocity, np.zeros(6), p)
        return BelievedStep((1.0 - p) * velocity + p * before, p * P + p * (1.0 - p) * innovation**2, p)

    def _says_nothing(self, velocity: Array, seconds: float, covariance: Array | None) -> bool:
        """Whether it says that a moving body does not move."""
        if not self._is_visual or covariance is not None or np.abs(velocity).max() > self.STILL:
            self._still = 0.0
            return False
        self._still += seconds
        return self._still < self.STOPPED and bool(np.abs(self._velocity).max() > self.MOVING)

    def _is_new_motion(self, change: Array, R: Array, seconds: float) -> bool:
        """Whether steps that failed all say the same; `change` (6,) from the last one to this."""
        alike = self._evidence(change, 2.0 * R + self._settings.agility**2 * seconds, R) < 0.0
        self._agreeing = self._agreeing + 1 if self._failed > 0.5 and alike else 0
        return self._agreeing >= self.NEW_MOTION

    def _evidence(self, difference: Array, variance: Array, R: Array) -> float:
        """Logarithm of how much likelier a difference (6,) of velocities is if the step failed than if it did not and
        the difference has this variance (6,)."""
        failed = variance + self._settings.failure_error**2 + self.BROADER**2 * R
        return 0.5 * float(np.sum(difference**2 * (1.0 / variance - 1.0 / failed) - np.log(failed / variance)))

    def _learn_noise(self, velocity: Array, last: Array) -> None:
        if np.abs(velocity).max() <= self.STILL:
            return
        change = velocity - last
        self._changes.append(np.array([change[:3] @ change[:3], change[3:] @ change[3:]]) / 3.0)
        if len(self._changes) >= self.LEAST:
            usual = np.median(np.array(self._changes), axis=0) / self.MEDIAN / 2.0
            self._noise = np.repeat(np.maximum(usual, self.LEAST_NOISE**2), 3)


def _probability(evidence: float, prior: float) -> float:
    """Of a failure, from the logarithm of the ratio of likelihoods and the probability before."""
    if not 0.0 < prior < 1.0:
        return prior
    odds = np.log(prior / (1.0 - prior)) + evidence
    return float(1.0 / (1.0 + np.exp(-np.clip(odds, -500.0, 500.0))))
