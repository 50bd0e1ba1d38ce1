"""Which detection is of which labelled object."""

from __future__ import annotations

import numpy as np

from calibslam_msgs_py.measurements import Array

MIN_OVERLAP = 0.5  # intersection over union, as COCO's AP50
BORDER = 1.0  # [px] an edge nearer to the image border lies on it


def overlaps(a: Array, b: Array) -> Array:
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4)."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    intersection = np.prod(np.clip(high - low, 0.0, None), axis=2)
    areas = [np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (a, b)]
    union = areas[0][:, None] + areas[1][None] - intersection
    return np.asarray(intersection / np.maximum(union, 1e-12))


def match(
    boxes: Array, labels: np.ndarray, true_boxes: Array, true_labels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of detections and of true boxes that belong together, each at most once.

    A detection, the best first, takes the free true box of its class that it overlaps most, by `MIN_OVERLAP` or more.

    Args:
        boxes: (N, 4) best first; labels: (N,).
        true_boxes: (M, 4); true_labels: (M,).
    """
    candidates = overlaps(boxes, true_boxes) * (labels[:, None] == true_labels[None, :])
    pairs = []
    for i, row in enumerate(candidates):
        if row.size and row.max() >= MIN_OVERLAP:
            j = int(row.argmax())
            pairs.append((i, j))
            candidates[:, j] = 0.0
    found = np.array(pairs, np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def free_of_border(true_boxes: Array, width: float, height: float) -> np.ndarray:
    """(N, 4) whether the edge of a true box lies inside the image.

    An edge on the border is where the image cuts the object; a detector's box is cut there, too, and has no error.
    """
    return np.concatenate([true_boxes[:, :2] > BORDER, true_boxes[:, 2:] < np.array([width, height]) - BORDER], axis=1)
