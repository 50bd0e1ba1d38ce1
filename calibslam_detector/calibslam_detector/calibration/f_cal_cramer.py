"""f-Cal without the normal fit: sums of squares against chi-squared itself, by the distance of Cramer and von Mises."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from calibslam_detector.calibration.residuals import CalibrationError, standardised

SMALLEST = 1e-12  # sums are taken as at least that: the density of one squared normal is infinite at 0


def cramer_von_mises(p: Tensor) -> Tensor:
    """Distance of the distribution that p was drawn from to the uniform one, int_0^1 (G(t) - t)^2 dt.

    With G the distribution of p it is E[p^2] - E[max(p, p')] + 1/3 (the integral of G^2 is E[1 - max(p, p')]). The
    second expectation is over pairs of different samples, so the estimate is without bias whatever G is, and may be
    negative; its square root bounds the mean of |G(t) - t| over all levels t, which is the calibration error.

    Args:
        p: (n, ...) independent along the first axis, n > 1; distances are those of the other axes.

    Returns:
        (...), between -1/6 and 1/3.
    """
    n = len(p)
    ranks = torch.arange(n, dtype=p.dtype, device=p.device).view(-1, *[1] * (p.dim() - 1))
    # The k-th smallest is the larger one of k - 1 pairs.
    larger = (ranks * p.sort(dim=0).values).sum(dim=0) * (2.0 / (n * (n - 1)))
    return p.square().mean(dim=0) - larger + 1.0 / 3.0


def chi_squared_probability(q: Tensor, K: int) -> Tensor:
    """Distribution function of chi-squared with K degrees of freedom, with a gradient that is finite everywhere."""
    half = torch.full((), 0.5 * K, dtype=q.dtype, device=q.device)
    return torch.special.gammainc(half, 0.5 * q.clamp(min=SMALLEST))


class FCalCramer(nn.Module):
    """Sums of squared standardised residuals must be distributed as chi-squared, for several numbers K of squares.

    f-Cal fits a normal to sums so large that they are nearly normal; two moments are all that it sees, and an outlier
    counts with the fourth power of its z. Here the sums' empirical distribution is compared with chi-squared itself,
    which works for any K: K = 1 are the components, of which each has its distance, K = d the rows (joint coverage),
    and large K the common scale. Outliers count by their rank.

    Sums of more than one row are made of a random partition of the batch, so no two share a residual; several
    partitions make the estimate less noisy. Each distance is without bias in a batch of independent rows, as drawn
    with or without replacement: f-Cal's finite-population flaw has no counterpart here.

    Where no sigmas make all distances vanish, as with outliers that cannot be foreseen, weights say which matter. A
    weight of 1/K is that of the evidence: the classic statistics, n times the distance of n sums, all have the same
    distribution where covariances are true, and a batch has n in proportion to 1/K.

    Args:
        degrees: K of each distance: 1, or a multiple of d.
        partitions: of the batch, for each K above d.
        weights: of each distance; None: 1.
        generator: of the partitions, on the CPU; None: torch's own.
    """

    def __init__(
        self,
        degrees: Sequence[int] = (1, 100),
        partitions: int = 4,
        *,
        weights: Sequence[float] | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if not degrees or min(degrees) < 1 or partitions < 1:
            raise CalibrationError(f"K and partitions must be positive; got K = {degrees}, partitions = {partitions}")
        self.weights = (1.0,) * len(degrees) if weights is None else tuple(weights)
        if len(self.weights) != len(degrees) or min(self.weights) < 0.0:
            raise CalibrationError(f"each K needs a weight of at least 0; got K = {degrees}, weights = {self.weights}")
        self.degrees, self.partitions, self.generator = tuple(degrees), partitions, generator

    def forward(self, mean: Tensor, covariance: Tensor, target: Tensor) -> Tensor:
        """Weighted sum of the distances of a batch, a scalar.

        Args:
            mean, target: (N, d), enough for two sums.
            covariance: variances (N, d) or matrices (N, d, d).

        Raises:
            CalibrationError: too few residuals, or what `standardised` refuses.
        """
        squares = standardised(mean, covariance, target).square()
        distances = [w * self._distance(squares, K) for K, w in zip(self.degrees, self.weights, strict=True)]
        return torch.stack(distances).sum()

    def _distance(self, squares: Tensor, K: int) -> Tensor:
        """Distance of sums of K of the squares (N, d)."""
        n, d = squares.shape
        if K == 1:
            sums = squares
        elif K % d:
            raise CalibrationError(f"K = {K} is no multiple of the {d} components of a residual")
        else:
            rows = K // d
            count = n // rows
            # One partition of single rows is as good as several.
            orders = [
                torch.randperm(n, generator=self.generator)[: count * rows]
                for _ in range(self.partitions if rows > 1 else 1)
            ]
            chosen = torch.stack(orders, dim=1).to(squares.device)
            sums = squares.sum(dim=1)[chosen].view(count, rows, len(orders)).sum(dim=1)
        if len(sums) < 2:
            raise CalibrationError(f"two sums of K = {K} squares need {2 * K // d} residuals of {d}; got {n}")
        return cramer_von_mises(chi_squared_probability(sums, K)).mean()
