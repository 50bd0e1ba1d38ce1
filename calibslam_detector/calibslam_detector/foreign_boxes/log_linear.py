"""Covariances that `fit_calibrator` fits: log-linear in what a box message tells."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibslam_detector.foreign_boxes.features import FEATURES, edge_features
from calibslam_msgs_py.measurements import Array, Boxes
from calibslam_msgs_py.settings import Settings, setting


@dataclass(frozen=True)
class LogLinearCalibrator(Settings):
    """Diagonal covariances: log sigma of an edge = intercept + sum of coefficient times feature, see
    `features.FEATURES`.

    Boxes that have a covariance keep it. Features are bounded, extents to those it was fitted to: so is sigma.
    """

    intercept: float = setting(1.7, "log sigma where all features are zero", unit="log px", low=-10.0, high=10.0)
    extent: float = setting(0.0, "per logarithm of the extent across the edge", low=-5.0, high=5.0)
    other_extent: float = setting(0.0, "per logarithm of the extent along the edge", low=-5.0, high=5.0)
    score: float = setting(0.0, "per score", low=-30.0, high=30.0)
    covered: float = setting(0.0, "per share of the box that another one covers", low=-30.0, high=30.0)
    at_border: float = setting(0.0, "if another edge lies on the image's border", low=-30.0, high=30.0)
    place: float = setting(0.0, "per distance from the image's middle", low=-30.0, high=30.0)
    least_extent: float = setting(1.0, "smallest extent that was seen", unit="px", low=1e-3)
    most_extent: float = setting(1e4, "largest extent that was seen", unit="px", low=1e-3)

    def sigmas(self, boxes: Boxes) -> Array:
        """(N, 4) standard deviations [px] of the edges."""
        coefficients = np.array([getattr(self, name) for name in FEATURES])
        features = edge_features(boxes, self.least_extent, self.most_extent)
        return np.asarray(np.exp(self.intercept + features @ coefficients))

    def __call__(self, boxes: Boxes) -> Boxes:
        known = boxes.has_covariance[:, None, None]
        covariances = np.eye(4) * self.sigmas(boxes)[:, None, :] ** 2
        return replace(boxes, covariances=np.where(known, boxes.covariances, covariances))
