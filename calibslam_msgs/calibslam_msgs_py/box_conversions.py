"""BoundingBoxArray <-> Boxes, and which boxes can be used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from calibslam_msgs_py.covariance import is_covariance, symmetric
from calibslam_msgs_py.geometry_conversions import (
    UNKNOWN,
    doubles_of,
    header_to_msg,
    stamp_from_msg,
    unknown_covariance,
)
from calibslam_msgs_py.measurements import Array, Boxes, InvalidMeasurement
from calibslam_msgs_py.message_types import MessageTypes

# Of the image's size, that a box of a good detector goes beyond it, and of boxes that go farther.
FAR_BEYOND, MANY_BEYOND = 0.05, 0.05
ENOUGH_BOXES = 100  # to tell whether they are many
LARGEST_COORDINATE = 1e6  # [px] of a corner, many times any image: what is larger is garbage


def boxes_from_msg(msg: Any) -> Boxes:
    """Boxes of a BoundingBoxArray, unfiltered: see `valid_boxes`.

    Raises:
        InvalidMeasurement: the image has no size, or a field has the wrong length.
    """
    if msg.width < 1 or msg.height < 1:
        raise InvalidMeasurement("image_size", f"boxes of an image of {msg.width} x {msg.height} pixels")
    corners = _doubles_of_all([box.corners for box in msg.boxes], 4, "corners of a box")
    covariances = _doubles_of_all([box.covariance for box in msg.boxes], 16, "covariance of a box")
    # NaN in a message is a defect and not "unknown": it becomes infinite, which no check lets pass.
    unknown = covariances[:, :1] == UNKNOWN
    covariances = np.where(unknown, np.nan, np.where(np.isnan(covariances), np.inf, covariances))
    return Boxes(
        stamp=stamp_from_msg(msg.header.stamp),
        width=int(msg.width),
        height=int(msg.height),
        corners=corners,
        covariances=covariances.reshape(-1, 4, 4),
        class_ids=tuple(str(box.class_id) for box in msg.boxes),
        scores=np.array([box.score for box in msg.boxes], dtype=np.float64),
        object_ids=tuple(str(box.object_id) for box in msg.boxes),
        frame_id=str(msg.header.frame_id),
    )


def _doubles_of_all(arrays: list[Any], n: int, what: str) -> Array:
    """(N, n) of N array fields."""
    if all(len(values) == n for values in arrays):
        return np.array(arrays, dtype=np.float64).reshape(-1, n)
    return np.stack([doubles_of(values, n, what) for values in arrays])


def valid_boxes(boxes: Boxes) -> tuple[Boxes, dict[str, int]]:
    """The usable boxes, cut at the image border, and how many were dropped for which reason.

    Reasons: `nan` (corner or score not finite, or a corner farther than `LARGEST_COORDINATE` away), `empty` (xmin >=
    xmax or ymin >= ymax), `outside` (no part of the box in the image), `covariance` (known, but not finite, symmetric
    and positive definite). A box counts once, under the first that applies.
    """
    xmin, ymin, xmax, ymax = boxes.corners.T
    finite = (np.abs(boxes.corners) <= LARGEST_COORDINATE).all(axis=1) & np.isfinite(boxes.scores)
    wrong = boxes.has_covariance
    if wrong.any():
        wrong[wrong] = ~is_covariance(boxes.covariances[wrong])
    outside = (xmax <= 0.0) | (ymax <= 0.0) | (xmin >= boxes.width) | (ymin >= boxes.height)
    defects = {
        "nan": ~finite,
        "empty": (xmin >= xmax) | (ymin >= ymax),
        "outside": outside,
        "covariance": wrong,
    }
    keep = np.ones(len(boxes), dtype=bool)
    rejected = {}
    for reason, defect in defects.items():
        if count := int((keep & defect).sum()):
            rejected[reason] = count
        keep &= ~defect
    if not keep.all():
        boxes = boxes.select(np.flatnonzero(keep))
    # Some detectors draw what they believe to be beyond the image.
    inside = np.clip(boxes.corners, 0.0, [boxes.width, boxes.height] * 2)
    return (boxes if (inside == boxes.corners).all() else replace(boxes, corners=inside)), rejected


class BeyondImage:
    """Counts boxes that go far beyond the image, as those drawn in images of another size do."""

    def __init__(self) -> None:
        self._boxes = self._beyond = 0
        self._told = False

    def see(self, boxes: Boxes) -> None:
        """The boxes of an image, before they are cut."""
        size = np.array([boxes.width, boxes.height])
        far = (boxes.corners[:, :2] < -FAR_BEYOND * size) | (boxes.corners[:, 2:] > (1.0 + FAR_BEYOND) * size)
        self._boxes += len(boxes)
        self._beyond += int(far.any(axis=1).sum())

    @property
    def problem(self) -> str:
        """What to say if there are many; "" otherwise."""
        if self._boxes < ENOUGH_BOXES or self._beyond <= MANY_BEYOND * self._boxes:
            return ""
        return (
            f"{self._beyond} of {self._boxes} boxes go beyond the image by more than {FAR_BEYOND:.0%} of it: do boxes "
            "and camera_info belong to one image size?"
        )

    def news(self, boxes: Boxes) -> str:
        """`see`, and `problem` the first time there is one."""
        self.see(boxes)
        problem = "" if self._told else self.problem
        self._told = self._told or bool(problem)
        return problem


def boxes_to_msg(boxes: Boxes, types: MessageTypes) -> Any:
    """A BoundingBoxArray."""
    box = types("calibslam_msgs/msg/BoundingBox")
    known = boxes.has_covariance
    return types("calibslam_msgs/msg/BoundingBoxArray")(
        header=header_to_msg(boxes.stamp, boxes.frame_id, types),
        width=int(boxes.width),
        height=int(boxes.height),
        boxes=[
            box(
                corners=np.array(boxes.corners[i], dtype=np.float64),
                covariance=symmetric(boxes.covariances[i]).ravel() if known[i] else unknown_covariance(4),
                class_id=str(boxes.class_ids[i]),
                score=float(boxes.scores[i]),
                object_id=str(boxes.object_ids[i]),
            )
            for i in range(len(boxes))
        ],
    )
