"""The part of the network that says how wrong a box may be."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from calibslam_detector.model.box_covariance import COUPLINGS, OUTPUTS, VARIANCES
from calibslam_detector.model.region_cues import CUES

# Of a delta; an order wider on each side than what f-Cal's published code allows (1e-3 to 10).
VARIANCE_BOUNDS = (1e-4, 1e2)
# A box cut at one side has coupling 1 (weights 10 and 5): all of its error is the other edge's.
MAX_COUPLING = 1.2
# Boxes to learn from are few: of a region's features a summary goes on, and classes share all but what they begin with.
SUMMARY = 16
HIDDEN = 128
DROPOUT = 0.2


class CovarianceHead(nn.Module):
    """Features and cues of a region -> variances and couplings of its box deltas.

    Args:
        features: length of the region's feature vector.
        classes: number of classes, the background among them.
    """

    def __init__(self, features: int, classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.summary = nn.Sequential(nn.LayerNorm(features), nn.Linear(features, SUMMARY))
        self.hidden = nn.Sequential(
            nn.Linear(SUMMARY + CUES + classes, HIDDEN),
            nn.ReLU(),
            nn.Dropout(DROPOUT),
            nn.Linear(HIDDEN, HIDDEN),
            nn.ReLU(),
            nn.Dropout(DROPOUT),
        )
        self.output = nn.Linear(HIDDEN, OUTPUTS)
        # Begins with one and the same variance for every box, and without coupling.
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, features: Tensor, cues: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Variances (N, 4) and couplings (N, 2) of regions: features (N, F), cues (N, CUES), labels (N,)."""
        kind = nn.functional.one_hot(labels, self.classes).to(cues.dtype)
        outputs = self.output(self.hidden(torch.cat([self.summary(features), cues, kind], dim=1)))
        low, high = (math.log(bound) for bound in VARIANCE_BOUNDS)
        log_variances = low + (high - low) * torch.sigmoid(outputs[:, VARIANCES])
        return torch.exp(log_variances), MAX_COUPLING * torch.tanh(outputs[:, COUPLINGS])
