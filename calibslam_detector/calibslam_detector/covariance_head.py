"""The part of the network that says how wrong a box may be."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from calibslam_detector.box_covariance import COUPLINGS, OUTPUTS, VARIANCES

# Of a delta; an order wider on each side than what f-Cal's published code allows (1e-3 to 10).
VARIANCE_BOUNDS = (1e-4, 1e2)
# A box cut at one side has coupling 1 (weights 10 and 5): all of its error is the other edge's.
MAX_COUPLING = 1.2
HIDDEN = 256
GEOMETRY = 7


def geometry(boxes: Tensor, scores: Tensor, size: tuple[int, int]) -> Tensor:
    """What pooled features do not tell, (N, GEOMETRY): how large the box is, how near each border, how sure.

    Args:
        boxes: (N, 4) [px].
        scores: (N,).
        size: height and width of the image [px].
    """
    height, width = size
    extents = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1.0)
    borders = torch.stack([boxes[:, 0], boxes[:, 1], width - boxes[:, 2], height - boxes[:, 3]], dim=1)
    return torch.cat(
        [
            torch.log(extents / math.sqrt(height * width)),
            torch.exp(-borders.clamp(min=0.0) / (0.05 * extents.repeat(1, 2))),
            torch.logit(scores.clamp(1e-3, 1.0 - 1e-3))[:, None] / 4.0,
        ],
        dim=1,
    )


class CovarianceHead(nn.Module):
    """Features of a region -> variances and couplings of its box deltas, for each class.

    Args:
        features: length of the region's feature vector.
        classes: number of classes, the background among them.
    """

    def __init__(self, features: int, classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.norm = nn.LayerNorm(features)
        self.hidden = nn.Linear(features + GEOMETRY, HIDDEN)
        self.output = nn.Linear(HIDDEN, OUTPUTS * classes)
        # Begins with one and the same variance for every box, and without coupling.
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, features: Tensor, geometries: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Variances (N, 4) and couplings (N, 2) of regions: features (N, F), geometries (N, GEOMETRY), labels (N,)."""
        hidden = torch.relu(self.hidden(torch.cat([self.norm(features), geometries], dim=1)))
        outputs = self.output(hidden).view(-1, self.classes, OUTPUTS)
        chosen = outputs[torch.arange(len(labels), device=labels.device), labels]
        low, high = (math.log(bound) for bound in VARIANCE_BOUNDS)
        log_variances = low + (high - low) * torch.sigmoid(chosen[:, VARIANCES])
        return torch.exp(log_variances), MAX_COUPLING * torch.tanh(chosen[:, COUPLINGS])
