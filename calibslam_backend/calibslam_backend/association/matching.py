"""Which landmark a track belongs to.

A landmark predicts a box, with the uncertainty of the pose, of the quadric and of the measurement. The squared
Mahalanobis distance of a measured box to it is chi-squared with four degrees of freedom if they belong together.
All open tracks of a keyframe are assigned at once, and a track is bound to a landmark only after several
keyframes agree: one coincidence costs nothing, one wrong binding costs the map.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import gammaincinv

from calibslam_backend.association.tracking import overlap
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.ellipsoid import mean_radius
from calibslam_backend.geometry.visible_box import box_of_visible_part
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import Settings, setting

GIVEN, ESTIMATED = "given", "estimated"
SIZE_RATIO = 3.0  # mean radii of one object, estimated twice, differ by less than this factor
LEAST_OVERLAP = 1.0 / 3.0  # median, of boxes and those of a quadric that explains them
ONE_PLACE = 0.5  # distance of two centres, in mean radii of the smaller, within which there is room for one object only


@dataclass(frozen=True)
class AssociationSettings(Settings):
    association: str = setting(
        ESTIMATED, "identities of boxes: estimated, or given by their object_id", choices=(ESTIMATED, GIVEN)
    )
    gate: float = setting(0.999, "probability that a box of the landmark passes the gate", low=0.5, high=0.9999)
    min_overlap: float = setting(0.2, "intersection over union of predicted and measured box", low=0.0, high=1.0)
    votes: int = setting(3, "keyframes that must agree before a track is bound to a landmark", low=1)
    model_error: float = setting(
        0.2, "error of the ellipsoid as a model of the object, as a share of its box", low=0.0, high=1.0
    )
    ambiguity: float = setting(
        3.0, "log of the odds over the second best quadric below which a decision waits", low=0.0, high=100.0
    )
    revised: int = setting(20, "earlier keyframes, with each new one, whose boxes are judged anew", low=0)
    wrong_class: float = setting(0.02, "share of boxes that carry a wrong class", low=1e-6, high=0.5)
    merge_distance: float = setting(
        0.7,
        "distance of two centres below which they are one object, as a share of the sum of their radii",
        low=0.0,
    )


@functools.cache
def gate_of(probability: float) -> float:
    """Squared Mahalanobis distance within which a box of four edges lies with this probability."""
    return 2.0 * float(gammaincinv(2.0, probability))  # scipy.stats.chi2.ppf(probability, 4), which loads for 0.5 s


@dataclass(frozen=True)
class Prediction:
    """The box (4,) [px] that a landmark of this class predicts, and its covariance (4, 4) without the measurement's."""

    corners: Array
    covariance: Array
    class_id: str


def predicted_corners(T_map_camera: Array, quadric: Array, K: Array, box: BoxMeasurement) -> Array | None:
    """The corners alone (4,) [px] of `predict`."""
    visible, corners, _ = box_of_visible_part(T_map_camera, quadric, K, box.bounds, box.clip)
    return np.asarray(corners) if visible else None


def median_overlap(poses: Array, boxes: Sequence[BoxMeasurement], quadric: Array, K: Array) -> float:
    """Median intersection over union of N measured boxes and those of a quadric (9,), seen from poses (N, 4, 4).

    Zero counts where the quadric is not in front of the camera, or its box is empty.
    """
    overlaps = np.zeros(len(boxes))
    for n, (T, box) in enumerate(zip(poses, boxes, strict=True)):
        corners = predicted_corners(np.ascontiguousarray(T), quadric, K, box)
        if corners is not None and (corners[2:] > corners[:2]).all():
            overlaps[n] = overlap(corners[None], box.corners[None])[0, 0]
    return float(np.median(overlaps))


def predict(
    T_map_camera: Array,
    quadric: Array,
    covariance: Array,
    K: Array,
    box: BoxMeasurement,
    model_error: float,
) -> tuple[Array, Array] | None:
    """Predicted corners (4,) and their covariance (4, 4) [px^2]; None if the quadric is not in front.

    Args:
        T_map_camera: (4, 4).
        quadric: (9,) centre and logarithmic shape.
        covariance: (15, 15) of pose and quadric together.
        K: (3, 3) camera matrix [px].
        box: the measurement it is for: its image borders and cut edges.
        model_error: see `AssociationSettings`.
    """
    visible, corners, J = box_of_visible_part(T_map_camera, quadric, K, box.bounds, box.clip)
    if not visible:
        return None
    size = corners[2:] - corners[:2]
    own = np.diag(np.tile(model_error * size, 2) ** 2)
    return corners, J @ covariance @ J.T + own


def class_costs(classes: Sequence[Counter[str]], class_id: str, wrong_class: float) -> Array:
    """(M,) -2 log of the probability that a box of M quadrics, whose boxes have these classes, carries `class_id`.

    Up to a constant: the boxes' own frequencies, mixed with a share of wrong classes.
    """
    number = np.array([each[class_id] for each in classes], float)
    total = np.array([each.total() for each in classes], float)
    share = number / np.maximum(total, 1.0)
    return np.asarray(-2.0 * np.log((1.0 - wrong_class) * share + wrong_class))


def distances(
    predictions: Sequence[Prediction | None],
    boxes: Sequence[BoxMeasurement],
    classes: Sequence[str],
    settings: AssociationSettings,
) -> Array:
    """Negative log-likelihood (landmarks, boxes) of a pair; infinite outside the gate, or of what predicts no box.

    Also where a box of some new object is likelier: a prediction that is vague enough lets anything through the gate.
    """
    gate = gate_of(settings.gate)
    result = np.full((len(predictions), len(boxes)), np.inf)
    for b, box in enumerate(boxes):
        limit = new_object_cost(box.bounds, settings.wrong_class)
        for p, prediction in enumerate(predictions):
            if prediction is None or overlap(prediction.corners[None], box.corners[None])[0, 0] < settings.min_overlap:
                continue
            S = prediction.covariance + box.covariance
            difference = box.corners - prediction.corners
            squared = difference @ np.linalg.solve(S, difference)
            if squared < gate:
                class_odds = 0.0 if prediction.class_id == classes[b] else -np.log(settings.wrong_class)
                cost = 0.5 * (squared + np.linalg.slogdet(S)[1]) + class_odds
                if cost < limit:
                    result[p, b] = cost
    return result


def new_object_cost(bounds: Array, wrong_class: float) -> float:
    """Cost, as in `distances`, of a box of an object that is not in the map.

    It may be any box of the image, bounds (4,) [px], and its class is no likelier than a wrong one.
    """
    width, height = bounds[2:] - bounds[:2]
    return float(np.log(width**2 / 2.0 * height**2 / 2.0) - 2.0 * np.log(2.0 * np.pi) - np.log(wrong_class))


def assign(cost: Array) -> list[tuple[int, int]]:
    """The pairs (row, column) of the cheapest one-to-one assignment; infinite costs are never taken."""
    if not np.isfinite(cost).any():
        return []
    forbidden = np.abs(cost[np.isfinite(cost)]).sum() * 2.0 + 1e6
    pairs = zip(*linear_sum_assignment(np.where(np.isfinite(cost), cost, forbidden)), strict=True)
    return [(int(r), int(c)) for r, c in pairs if np.isfinite(cost[r, c])]


def unambiguous(cost: Array, pairs: list[tuple[int, int]], ambiguity: float) -> list[tuple[int, int]]:
    """Of assigned pairs (row, column) those whose column no other row would suit nearly as well."""
    others = [np.delete(cost[:, column], row) for row, column in pairs]
    return [
        (row, column)
        for (row, column), rest in zip(pairs, others, strict=True)
        if not len(rest) or rest.min() - cost[row, column] >= ambiguity
    ]


class Votes:
    """For each open track, how often which landmark was its best match."""

    def __init__(self, needed: int) -> None:
        self._needed = needed
        self._votes: dict[int, Counter[int]] = {}

    def add(self, track: int, landmark: int) -> int | None:
        """A vote; returns the landmark once it is decided: enough votes, and twice those of all others."""
        votes = self._votes.setdefault(track, Counter())
        votes[landmark] += 1
        others = votes.total() - votes[landmark]
        return landmark if votes[landmark] >= max(self._needed, 2 * others) else None

    def forget(self, track: int) -> None:
        """The track is decided."""
        self._votes.pop(track, None)


def same_object(a: Array, b: Array, merge_distance: float) -> NDArray[np.bool_]:
    """Whether quadrics a (..., 9) and b (..., 9) are so near and so alike in size that they are one object."""
    distances = np.linalg.norm(a[..., :3] - b[..., :3], axis=-1)
    size, other = mean_radius(a), mean_radius(b)
    alike = np.maximum(size, other) < SIZE_RATIO * np.minimum(size, other)
    return np.asarray(alike & (distances < merge_distance * (size + other)))


def explains(quadric: Array, poses: Array, boxes: Sequence[BoxMeasurement], K: Array) -> bool:
    """Whether a quadric explains N boxes that are thought to be of another one near it; arguments as `median_overlap`.

    Neighbours of a row of chairs are near each other and alike, too; but seen from where the boxes were, one of them is
    not where the other is. Without boxes nothing speaks against it.
    """
    return not boxes or median_overlap(poses, boxes, quadric, K) >= LEAST_OVERLAP


def at_one_place(a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether the centres of quadrics a (..., 9) and b (..., 9) are so near that they cannot be two things.

    Two objects of a class do not stand in each other: a detector that draws two boxes there has seen one twice.
    """
    distances = np.linalg.norm(a[..., :3] - b[..., :3], axis=-1)
    return np.asarray(distances < ONE_PLACE * np.minimum(mean_radius(a), mean_radius(b)))
