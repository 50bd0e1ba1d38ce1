"""Gross errors of a detector, of which its covariance says nothing: a box that is not the object's box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibslam_msgs_py.measurements import Boxes

KINDS = ("size", "place", "class", "identity")


def add_gross_errors(boxes: Boxes, share: float, classes: tuple[str, ...], rng: np.random.Generator) -> Boxes:
    """Boxes of which a share is grossly wrong.

    A box gets another size (0.4 to 2.2 times in each direction), another place (by half its size to its whole
    size), another class out of `classes`, or class and identity of another object in the image, each as often
    as the others.
    """
    corners = boxes.corners.copy()
    class_ids, object_ids = list(boxes.class_ids), list(boxes.object_ids)
    for i in np.flatnonzero(rng.random(len(boxes)) < share):
        kind = KINDS[rng.integers(len(KINDS))]
        centre, half = (corners[i, :2] + corners[i, 2:]) / 2.0, (corners[i, 2:] - corners[i, :2]) / 2.0
        if kind == "size":
            half = half * np.exp(rng.uniform(np.log(0.4), np.log(2.2), 2))
        elif kind == "place":
            centre = centre + half * rng.uniform(1.0, 2.0, 2) * rng.choice([-1.0, 1.0], 2)
        elif kind == "class":
            class_ids[i] = classes[rng.integers(len(classes))]
        else:
            other = int(rng.integers(len(boxes)))
            class_ids[i], object_ids[i] = boxes.class_ids[other], boxes.object_ids[other]
        corners[i] = [*(centre - half), *(centre + half)]
    return replace(boxes, corners=corners, class_ids=tuple(class_ids), object_ids=tuple(object_ids))
