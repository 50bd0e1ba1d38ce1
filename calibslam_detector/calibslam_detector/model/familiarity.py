"""Whether an image is like those that covariances were learnt from.

Covariances are only calibrated for images like these. How an image looks to the network is the mean of its finest
feature map over all places; its Mahalanobis distance from those known (Lee et al., NeurIPS 2018, without classes)
says how strange it is.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

USUAL = 0.95  # share of known images that are no stranger than 1
HELD_OUT = 0.25  # share of the images, the last ones, that are not fitted to, but measured with: neighbours are alike
SHRINKAGE = 0.01  # share of the mean variance added to all, as images are few


def descriptor(features: Tensor) -> Tensor:
    """(B, C) of feature maps (B, C, H, W)."""
    return features.mean(dim=(2, 3))


class Familiarity(nn.Module):
    """Strangeness of images; 0 for all as long as nothing is known.

    Args:
        channels: of the feature map.
    """

    mean: Tensor
    whitening: Tensor
    usual: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("whitening", torch.zeros(channels, channels))
        self.register_buffer("usual", torch.ones(()))

    @torch.no_grad()
    def fit(self, descriptors: Tensor) -> None:
        """Know these images (N, C), N > 2: the share USUAL of others like them will have a strangeness below 1."""
        last = len(descriptors) - max(round(HELD_OUT * len(descriptors)), 1)
        known, held_out = descriptors[:last].double(), descriptors[last:]
        mean = known.mean(dim=0)
        covariance = (
            torch.cov(known.T) + torch.eye(len(mean), device=known.device) * SHRINKAGE * known.var(dim=0).mean()
        )
        L = torch.linalg.cholesky(covariance)
        self.mean.copy_(mean)
        self.whitening.copy_(torch.linalg.inv(L))
        self.usual.fill_(1.0)
        distances = self(held_out.to(self.mean.device))
        self.usual.fill_(max(float(torch.quantile(distances, USUAL)), math.ulp(1.0)))

    def forward(self, descriptors: Tensor) -> Tensor:
        """Strangeness (B,) of images (B, C)."""
        return torch.linalg.vector_norm((descriptors - self.mean) @ self.whitening.T, dim=1) / self.usual
