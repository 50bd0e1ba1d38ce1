"""The f-Cal loss (algorithm 4.2.2; Bhatt et al., "f-Cal", ICRA 2022), as a loss of anybody's training loop."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from calibslam_detector.calibration.residuals import CalibrationError, standardised

DIVERGENCES = ("kl", "wasserstein")


def kl(variance: Tensor, squared_bias: Tensor, K: float) -> Tensor:
    """KL(fit || N(K, 2K)) of a normal with this variance, whose mean is off by sqrt(squared_bias)."""
    return 0.5 * (torch.log(2.0 * K / variance) + (variance + squared_bias) / (2.0 * K) - 1.0)


def wasserstein(variance: Tensor, squared_bias: Tensor, K: float) -> Tensor:
    """W_2^2(fit, N(K, 2K)), the squared Wasserstein-2 distance of normals, in squared units of a sum."""
    return squared_bias + (variance.sqrt() - math.sqrt(2.0 * K)) ** 2


class FCal(nn.Module):
    """Sums of K squared standardised residuals must look like chi-squared with K degrees of freedom.

    H sums are drawn from the batch, a normal is fitted to them, and its distance from N(K, 2K), the normal limit of
    that distribution, is the loss. The components of one row are summed together, K/d rows make a sum: so a wrong
    correlation widens the sums and is seen.

    Sums that share residuals are not independent, and the fit to them must know it: rows are drawn with
    replacement, and the fit's mean is cleared of the variance it has from batch to batch. So true covariances are
    where the expected loss is least, to order 1/N (docs/calibration.md); that of one batch may be negative. Batches
    must be new, or drawn from many more than K residuals. `published=True` is the published code instead: rows
    without replacement, whose sums have the variance 2K (1 - K/N), and the fit as it is.

    Args:
        K: degrees of freedom of a sum, a multiple of d; the normal limit needs some 50.
        H: sums that are drawn.
        divergence: "kl" or "wasserstein".
        published: without the correction.
        generator: of the draws, on the device of the residuals; None: torch's own.
    """

    def __init__(
        self,
        K: int = 100,
        H: int = 200,
        divergence: str = "kl",
        *,
        published: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if divergence not in DIVERGENCES:
            raise CalibrationError(f"divergence must be one of {', '.join(DIVERGENCES)}, not {divergence!r}")
        if K < 1 or H < 2:
            raise CalibrationError(f"f-Cal needs K >= 1 and H >= 2; got K = {K}, H = {H}")
        self.K, self.H, self.published, self.generator = K, H, published, generator
        self.divergence = kl if divergence == "kl" else wasserstein

    def forward(self, mean: Tensor, covariance: Tensor, target: Tensor) -> Tensor:
        """The loss of a batch, a scalar.

        Args:
            mean, target: (N, d) with N > K/d; better N > 4 K/d.
            covariance: variances (N, d) or matrices (N, d, d).

        Raises:
            CalibrationError: too few residuals, or what `standardised` refuses.
        """
        z = standardised(mean, covariance, target)
        n, d = z.shape
        rows = self.K // d
        if rows * d != self.K:
            raise CalibrationError(f"K = {self.K} is no multiple of the {d} components of a residual")
        if n <= rows:
            raise CalibrationError(f"sums of K = {self.K} squares need more than {rows} residuals of {d}; got {n}")
        q = self._sums(z.square().sum(dim=1), rows)
        variance, squared_bias = q.var(), (q.mean() - self.K) ** 2
        if not self.published:
            # Draws from n residuals have (n - 1)/n of the variance of draws from all there are.
            variance = variance * n / (n - 1)
            # What is left of Var(mean of q): of the batch, and of the draws from it.
            squared_bias = squared_bias - variance * (rows / n + (1.0 - 1.0 / n) / self.H)
        return self.divergence(variance, squared_bias, float(self.K))

    def _sums(self, squares: Tensor, rows: int) -> Tensor:
        """H sums of `rows` of the squares (N,)."""
        n, device = len(squares), squares.device
        if self.published:
            # Without replacement: the places of the largest of n random numbers.
            chosen = torch.rand(self.H, n, generator=self.generator, device=device).topk(rows, dim=1).indices
        else:
            chosen = torch.randint(n, (self.H, rows), generator=self.generator, device=device)
        return squares[chosen].sum(dim=1)
