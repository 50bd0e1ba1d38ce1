"""How alike the errors of an object's boxes in successive keyframes are, and what a box is worth then.

A covariance says how wrong one box may be, and a factor graph takes all boxes for independent. Those of a real detector
are not: what it misjudges in one image (a shadow, a handle, another object in front) it misjudges in the next, and an
ellipsoid fails to be the object from one side and the next alike. Then a row of boxes says less than their number, and
a graph that does not know it is overconfident, and follows its boxes more than it should.

An error is taken to be a slow part, which has a share a of the variance and keeps a share m of itself from keyframe to
keyframe, and a part that is new each time. Errors n keyframes apart correlate by a m^n, and at u = 2 - 2 cos(frequency)
their spectrum, in units of the variance, is

    s(u) = (1 - a) + a (1 - m^2) / ((1 - m)^2 + m u).

White errors of the level s(u) would be as good at that frequency. Which one matters? Odometry's errors add up, so the
slower a motion is, the less odometry knows of it, as Q / u; boxes know it as s(u) / I, with Q the covariance of one
motion and I the information of one keyframe's boxes. The best estimate follows odometry above and boxes below the
frequency where both know equally much (Wiener's filter), and it is there that their weights matter most:

    u s(u) = Q I.

So each box counts with the share w = 1 / s(u) of its log-likelihood, at most fully. Where odometry is good that is near
1 / s(0), what the mean over a long time is worth ((1 - m) / (1 + m) for a = 1; Bayley and Hammersley 1946); where it is
so bad that boxes must tell each motion, an error that stays the same does no harm to that, and they count fully.

What is slower than that is stated too small by a graph with these weights: boxes of the level s(u) instead of 1 / w
leave a random walk that they tie down with sqrt(w s(u)) times the variance (it is the geometric mean of the variances
of a step and of what ties it, in the steady state and for small Q I). A motion over n keyframes is of the frequency
pi / n, and what has added up since the beginning of frequency 0.

All three are estimated while the graph grows: a and m from its residuals, those of doubted boxes reduced as they are
there, and Q I, a mean over the six directions of motion and over keyframes.
"""

from __future__ import annotations

import numpy as np

from calibslam_msgs_py.measurements import Array

LAGS = (1, 2)  # keyframes between boxes that are compared
LONGEST_MEMORY = 0.9  # m: what stays longer is a matter of the object, and the map has it
FASTEST = 4.0  # u of what changes its sign with each keyframe


def slow_part(first: float, second: float) -> tuple[float, float]:
    """Share a and memory m of the slow part, from correlations one and two keyframes apart.

    Correlations that fade faster than a single process (a = 1) are taken for one.

    Args:
        first: above 0, below 1.
        second: any.
    """
    memory = float(np.clip(second / first, first, max(first, LONGEST_MEMORY)))
    return first / memory, memory


def spectrum(share: float, memory: float, u: float) -> float:
    """s(u) of errors with this slow part, in units of their variance, u = 2 - 2 cos(frequency)."""
    return (1.0 - share) + share * (1.0 - memory**2) / ((1.0 - memory) ** 2 + memory * u)


def crossover(share: float, memory: float, ratio: float) -> float:
    """u at which boxes, `ratio` times as informative as odometry from keyframe to keyframe, know as much as it does."""
    # u s(u) = ratio, times the denominator of s.
    a = (1.0 - share) * memory
    b = (1.0 - share) * (1.0 - memory) ** 2 + share * (1.0 - memory**2) - ratio * memory
    c = -ratio * (1.0 - memory) ** 2
    # The positive root of a u^2 + b u + c, c < 0; written so that a may be 0.
    below = b + np.sqrt(b * b - 4.0 * a * c)
    return min(-2.0 * c / below, FASTEST) if below > 0.0 else FASTEST


class BoxCorrelation:
    """A running estimate from pairs of residuals, and from what boxes and odometry say of motions.

    Attributes:
        worth: the share w of a box's log-likelihood that counts, at most 1.
    """

    MEMORY = 3000.0  # pairs; earlier ones, of an estimate that was worse, fade
    DOUBT = 100.0  # pairs of boxes that show no correlation, to begin with
    KEYFRAMES = 100.0  # over which the share of boxes in what is known of motions is averaged
    BEFORE = 10.0  # keyframes in which boxes say nothing of motions, to begin with
    ALL = 1.0 - 1e-9  # the largest share: motions are known by boxes alone

    def __init__(self, is_estimated: bool = True) -> None:
        """Of nothing yet; if it is not to be estimated, errors are taken for independent."""
        self._is_estimated = is_estimated
        self._products = dict.fromkeys(LAGS, 0.0)
        self._squares = dict.fromkeys(LAGS, 0.0)
        self._told, self._keyframes = 0.0, self.BEFORE
        self._slow = 0.0, 0.0
        self.worth = 1.0

    def learn(self, before: Array, now: Array, lag: int = 1) -> None:
        """Residuals (N, 4) and (N, 4) of the same objects' boxes in keyframes `lag` apart, in standard deviations.

        Those that are not finite, of a state that is about to be repaired, teach nothing.
        """
        finite = np.isfinite(before).all(axis=1) & np.isfinite(now).all(axis=1)
        before, now = before[finite], now[finite]
        fading = np.exp(-len(now) / self.MEMORY)
        self._products[lag] = fading * self._products[lag] + float(np.sum(before * now))
        self._squares[lag] = fading * self._squares[lag] + 0.5 * float(np.sum(before**2) + np.sum(now**2))
        self._weigh()

    def learn_motion(self, information: Array, covariance: Array) -> None:
        """What boxes say of a keyframe's pose and how well odometry knows the motion to it, in the same coordinates.

        How much more boxes know differs from direction to direction; the geometric mean is that of the volumes.

        Args:
            information: (6, 6) of the boxes, if their quadrics are known.
            covariance: (6, 6) of the motion.
        """
        if not np.isfinite(information).all():
            return
        sign, logarithm = np.linalg.slogdet(information @ covariance)
        ratio = float(np.exp(logarithm / len(covariance))) if sign > 0.0 else 0.0  # 0: a direction that no box tells
        fading = np.exp(-1.0 / self.KEYFRAMES)
        # Of the share that boxes have, which is between 0 and 1, and not of a ratio that may be anything.
        self._told = fading * self._told + ratio / (1.0 + ratio)
        self._keyframes = fading * self._keyframes + 1.0
        self._weigh()

    def understated(self, keyframes: float = np.inf) -> float:
        """Factor by which a graph with these weights states the covariance of a motion over so many keyframes too
        small, at least 1; by default that of a pose, or of a quadric."""
        u = 2.0 - 2.0 * np.cos(np.pi / keyframes)
        return max(float(np.sqrt(self.worth * spectrum(*self._slow, u))), 1.0)

    def _weigh(self) -> None:
        is_alike = self._is_estimated and self.correlation > 0.0
        self._slow = slow_part(self.correlation, self._correlation(2)) if is_alike else (0.0, 0.0)
        self.worth = min(1.0 / spectrum(*self._slow, crossover(*self._slow, self.ratio)), 1.0)

    @property
    def correlation(self) -> float:
        """Of neighbours."""
        return self._correlation(1)

    @property
    def ratio(self) -> float:
        """How much more boxes know of a motion from keyframe to keyframe than odometry."""
        told = min(self._told / self._keyframes, self.ALL)
        return told / (1.0 - told)

    def _correlation(self, lag: int) -> float:
        edges = 4.0
        return float(self._products[lag] / (self._squares[lag] + self.DOUBT * edges))
