"""How alike the errors of an object's boxes in consecutive keyframes are, and what a box is worth then.

A covariance says how wrong one box may be, and a factor graph takes all boxes for independent. Those of a real detector
are not: what it misjudges in one image (a shadow, a handle, another object in front) it misjudges in the next, and an
ellipsoid fails to be the object from one side and the next alike. Then a row of boxes says less than their number, and
a graph that does not know it is overconfident, and follows its boxes more than it should.

If errors fade geometrically from keyframe to keyframe (an autoregressive process of first order) with correlation c,
the mean of n of them is as certain as that of n (1 - c) / (1 + c) independent ones (Bayley and Hammersley 1946, for
large n). So each box counts with that share of its log-likelihood. The correlation is estimated from the residuals of
the graph itself, those of doubted boxes reduced as they are there.
"""

from __future__ import annotations

import numpy as np

from calibslam_msgs_py.measurements import Array


class BoxCorrelation:
    """A running estimate from pairs of residuals.

    Attributes:
        worth: the share of a box's log-likelihood that counts, at most 1.
    """

    MEMORY = 3000.0  # pairs; earlier ones, of an estimate that was worse, fade
    DOUBT = 100.0  # pairs of boxes that show no correlation, to begin with

    def __init__(self, is_estimated: bool = True) -> None:
        """Of nothing yet; if it is not to be estimated, errors are taken for independent."""
        self._is_estimated = is_estimated
        self._products = 0.0
        self._squares = 0.0
        self.worth = 1.0

    def learn(self, before: Array, now: Array) -> None:
        """Residuals (N, 4) and (N, 4) of the same objects' boxes in consecutive keyframes, in standard deviations.

        Those that are not finite, of a state that is about to be repaired, teach nothing.
        """
        finite = np.isfinite(before).all(axis=1) & np.isfinite(now).all(axis=1)
        before, now = before[finite], now[finite]
        fading = np.exp(-len(now) / self.MEMORY)
        self._products = fading * self._products + float(np.sum(before * now))
        self._squares = fading * self._squares + 0.5 * float(np.sum(before**2) + np.sum(now**2))
        if self._is_estimated:
            correlation = max(self.correlation, 0.0)
            self.worth = (1.0 - correlation) / (1.0 + correlation)

    @property
    def correlation(self) -> float:
        """Of neighbours."""
        edges = 4.0
        return float(self._products / (self._squares + self.DOUBT * edges))
