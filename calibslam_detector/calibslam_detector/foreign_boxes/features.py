"""What a box message tells about how well its edges are measured, besides the box itself."""

from __future__ import annotations

import numpy as np

from calibslam_msgs_py.measurements import Array, Boxes

# Of each edge: logarithm of the box's extent across the edge (its width for xmin and xmax) and along it, relative to
# REFERENCE_EXTENT; the detector's score; the largest share of the box that another box covers; whether another
# edge of the box lies on the image's border; distance of the box from the image's middle, the corner being 1.
FEATURES = ("extent", "other_extent", "score", "covered", "at_border", "place")
REFERENCE_EXTENT = 100.0  # [px]
BORDER = 2.0  # distance to the image's border at which an edge is one of the image, not of the object [px]


def edge_features(boxes: Boxes, least_extent: float = 1e-3, most_extent: float = np.inf) -> Array:
    """(N, 4, 6) `FEATURES` of the edges xmin ymin xmax ymax of N boxes.

    Args:
        boxes: of one image; all of them, since they hide each other.
        least_extent, most_extent: an extent beyond these [px] counts like the limit.
    """
    corners, n = boxes.corners, len(boxes)
    size = np.array([boxes.width, boxes.height], float)
    extents = corners[:, 2:] - corners[:, :2]
    logarithms = np.log(np.clip(extents, least_extent, most_extent) / REFERENCE_EXTENT)
    touching = boxes.to_border <= BORDER
    others = touching.sum(axis=1, keepdims=True) - touching > 0
    middle = 0.5 * (corners[:, :2] + corners[:, 2:])
    place = np.minimum(np.linalg.norm(middle - size / 2, axis=1) / np.linalg.norm(size / 2), 1.0)
    result = np.empty((n, 4, len(FEATURES)))
    result[:, :, 0] = np.tile(logarithms, 2)
    result[:, :, 1] = np.tile(logarithms[:, ::-1], 2)
    result[:, :, 2] = boxes.scores[:, None]
    result[:, :, 3] = _covered(corners)[:, None]
    result[:, :, 4] = others
    result[:, :, 5] = place[:, None]
    return result


def _covered(corners: Array) -> Array:
    """(N,) largest share of each box (N, 4) [px] that another one covers."""
    if len(corners) < 2:
        return np.zeros(len(corners))
    low = np.maximum(corners[:, None, :2], corners[None, :, :2])
    high = np.minimum(corners[:, None, 2:], corners[None, :, 2:])
    shared = np.clip(high - low, 0.0, None).prod(axis=2)
    areas = np.diagonal(shared).copy()
    np.fill_diagonal(shared, 0.0)
    return np.asarray(shared.max(axis=1) / areas)
