"""Other losses for covariances, called as f-Cal is: (mean, covariance, target) -> scalar."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from calibslam_detector.calibration.residuals import CalibrationError, cholesky, standardised

LOG_2_PI = math.log(2.0 * math.pi)


class GaussianNLL(nn.Module):
    """Negative log-likelihood -log N(target; mean, covariance), summed over components, averaged over rows."""

    def forward(self, mean: Tensor, covariance: Tensor, target: Tensor) -> Tensor:
        """The loss; arguments as `standardised` takes them."""
        z = standardised(mean, covariance, target)
        if covariance.dim() == 2:
            log_determinant = covariance.log().sum(dim=1)
        else:
            log_determinant = 2.0 * cholesky(covariance).diagonal(dim1=1, dim2=2).log().sum(dim=1)
        return 0.5 * (z.square().sum(dim=1) + log_determinant + z.shape[1] * LOG_2_PI).mean()


class CalibrationLoss(nn.Module):
    """The calibration loss of Feng et al. ("Can we trust you?", IROS workshop 2019): |variance - squared error|.

    Averaged over all components; entry by entry for matrices. Each sample is compared with its own error alone, and
    the absolute value asks for the median of the squared error, 0.455 variances of a normal: alone it makes
    overconfident, so it is added to the likelihood.
    """

    def forward(self, mean: Tensor, covariance: Tensor, target: Tensor) -> Tensor:
        """The loss, in squared units of the target; arguments as `standardised` takes them."""
        standardised(mean, covariance, target)  # refuses what cannot be used
        # The mean is left to the other loss.
        error = (target - mean).detach()
        squares = error.square() if covariance.dim() == 2 else error[:, :, None] * error[:, None, :]
        return (covariance - squares).abs().mean()


class Blend(nn.Module):
    """(1 - weight) risk + weight calibration (eq. 4.2.6).

    Args:
        risk, calibration: losses of (mean, covariance, target).
        weight: lambda, between 0 and 1.
    """

    def __init__(self, risk: nn.Module, calibration: nn.Module, weight: float) -> None:
        super().__init__()
        if not 0.0 <= weight <= 1.0:
            raise CalibrationError(f"the weight of the calibration must be between 0 and 1, not {weight}")
        self.risk, self.calibration, self.weight = risk, calibration, weight

    def forward(self, mean: Tensor, covariance: Tensor, target: Tensor) -> Tensor:
        """The loss; arguments as `standardised` takes them.

        Raises:
            CalibrationError: also where the loss itself is not finite.
        """
        batch = (mean, covariance, target)
        loss: Tensor = (1.0 - self.weight) * self.risk(*batch) + self.weight * self.calibration(*batch)
        if not bool(torch.isfinite(loss)):
            raise CalibrationError(f"the loss is {float(loss.detach())}: are all residuals of the batch the same?")
        return loss
