"""How well a map of ellipsoids agrees with the true ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_msgs_py.measurements import Array, QuadricEstimate
from calibslam_sim.simulation.sampling import unit_cube

MAX_CENTRE_DISTANCE = 0.5  # [m] farther apart, an estimate is not of this object
IOU_POINTS = 20_000


@dataclass(frozen=True)
class MapObject:
    """What is compared: an object's class and its ellipsoid, in a frame that both sides share."""

    class_id: str
    ellipsoid: Ellipsoid


def map_objects(quadrics: Iterable[QuadricEstimate], T_world_map: Array | None = None) -> list[MapObject]:
    """The objects of a map, in the frame to which (4, 4) leads; None: in the map's own."""
    T = np.eye(4) if T_world_map is None else T_world_map
    return [MapObject(q.class_id, Ellipsoid(T @ q.T_map_object, q.radii)) for q in quadrics]


@dataclass(frozen=True)
class ObjectAccuracy:
    """Agreement of a map with the truth.

    Attributes:
        true: number of objects there are.
        estimated: number of objects in the map.
        matched: number of pairs of one class, each at most `MAX_CENTRE_DISTANCE` apart; what is left of the true ones
            is missed, what is left of the estimated ones is of no object.
        centre_m: mean distance of the centres of pairs [m]; NaN without any pair, as those below.
        radii: mean error of the semi-axes of pairs, compared by size, as a share of the true ones.
        iou: mean intersection over union of the volumes of pairs.
    """

    true: int
    estimated: int
    matched: int
    centre_m: float
    radii: float
    iou: float


def object_accuracy(estimated: Sequence[MapObject], true: Sequence[MapObject]) -> ObjectAccuracy:
    """Compare a map, already aligned with the world, to the objects of the world."""
    pairs = [(estimated[i].ellipsoid, true[j].ellipsoid) for i, j in matches(estimated, true)]
    centres = [float(np.linalg.norm(_centre(a) - _centre(b))) for a, b in pairs]
    radii = [float(np.mean(np.abs(np.sort(a.radii) / np.sort(b.radii) - 1.0))) for a, b in pairs]
    overlaps = [iou(a, b) for a, b in pairs]
    return ObjectAccuracy(len(true), len(estimated), len(pairs), _mean(centres), _mean(radii), _mean(overlaps))


def matches(estimated: Sequence[MapObject], true: Sequence[MapObject]) -> list[tuple[int, int]]:
    """Pairs (estimated, true) of least total distance of centres, of one class, none above `MAX_CENTRE_DISTANCE`.

    Of one class: a detector that takes a part of an object for another one puts both into the map, at one place.
    """
    if not estimated or not true:
        return []
    a = np.array([_centre(thing.ellipsoid) for thing in estimated])
    b = np.array([_centre(thing.ellipsoid) for thing in true])
    distances = np.linalg.norm(a[:, None] - b[None, :], axis=2)
    unlike = np.array([[x.class_id != y.class_id for y in true] for x in estimated])
    # Cut off, so that one far estimate does not push others away from their objects.
    costs = np.where(unlike, MAX_CENTRE_DISTANCE, np.minimum(distances, MAX_CENTRE_DISTANCE))
    rows, columns = linear_sum_assignment(costs)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if costs[i, j] < MAX_CENTRE_DISTANCE]


def iou(a: Ellipsoid, b: Ellipsoid) -> float:
    """Intersection over union of two volumes, from points spread over the box around both."""
    boxes = [_bounds(a), _bounds(b)]
    low = np.minimum(boxes[0][0], boxes[1][0])
    high = np.maximum(boxes[0][1], boxes[1][1])
    points = low + unit_cube(IOU_POINTS) * (high - low)
    in_a, in_b = _contains(a, points), _contains(b, points)
    union = np.count_nonzero(in_a | in_b)
    return float(np.count_nonzero(in_a & in_b) / union) if union else 0.0


def _centre(ellipsoid: Ellipsoid) -> Array:
    return np.asarray(ellipsoid.T_world_object[:3, 3])


def _bounds(ellipsoid: Ellipsoid) -> tuple[Array, Array]:
    axes = ellipsoid.T_world_object[:3, :3] * ellipsoid.radii
    reach = np.sqrt(np.sum(axes * axes, axis=1))
    return _centre(ellipsoid) - reach, _centre(ellipsoid) + reach


def _contains(ellipsoid: Ellipsoid, points: Array) -> np.ndarray:
    local = (points - _centre(ellipsoid)) @ ellipsoid.T_world_object[:3, :3] / ellipsoid.radii
    return np.asarray(np.sum(local * local, axis=1) <= 1.0)


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")
