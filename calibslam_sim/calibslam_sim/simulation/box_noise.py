"""How wrong a detector's boxes are: a covariance of four edges for each box, none of them the same.

The standard deviation of an edge grows with the box (a detector places edges in units of the box), with what
hides the object, where the image cuts it, and by a factor of each object's own edges: some outlines are hard
to see. Opposite edges err together or against each other, and moving images smear all four along the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibslam_msgs_py.measurements import Array


@dataclass(frozen=True)
class BoxConditions:
    """What the error of the boxes (F, N) of N objects in F images depends on.

    Attributes:
        extents: (F, N, 2) width and height [px].
        hidden: (F, N) share hidden by other objects.
        is_cut: (F, N) whether the image border cuts the object.
        image_motion: (F, N, 2) motion of the object's centre between images [px].
        edge_difficulty: (N, 4) factor of each edge.
        edge_correlation: (N,) correlation of opposite edges.
    """

    extents: Array
    hidden: Array
    is_cut: np.ndarray
    image_motion: Array
    edge_difficulty: Array
    edge_correlation: Array


@dataclass(frozen=True)
class BoxNoise:
    """Size of the errors, see `box_covariances`."""

    floor: float = 1.0  # [px]
    share_of_box: float = 0.03
    hidden_factor: float = 3.0
    cut_factor: float = 1.6
    motion_blur: float = 0.3  # share of the motion between two images: how long the shutter is open

    def covariances(self, conditions: BoxConditions) -> Array:
        """Covariances (F, N, 4, 4) [px^2] of xmin ymin xmax ymax.

        D R D + b b^T, with D the standard deviations, R the correlation of opposite edges and b the smear.
        """
        extents = np.concatenate([conditions.extents, conditions.extents], axis=-1)
        difficulty = conditions.edge_difficulty * (1.0 + self.hidden_factor * conditions.hidden)[..., None]
        difficulty = difficulty * np.where(conditions.is_cut, self.cut_factor, 1.0)[..., None]
        sigma = np.hypot(self.floor, self.share_of_box * extents * difficulty)
        correlation = np.zeros((len(conditions.edge_correlation), 4, 4)) + np.eye(4)
        for a, b in ((0, 2), (1, 3)):
            correlation[:, a, b] = correlation[:, b, a] = conditions.edge_correlation
        smear = self.motion_blur * np.concatenate([conditions.image_motion, conditions.image_motion], axis=-1)
        independent_of_motion = sigma[..., :, None] * correlation * sigma[..., None, :]
        return independent_of_motion + smear[..., :, None] * smear[..., None, :]
