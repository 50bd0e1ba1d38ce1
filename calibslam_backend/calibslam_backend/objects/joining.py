"""One object in several tracks, each too short to tell what it is.

A detector that finds an object only now and then, or looks at few images, leaves tracks of one or two boxes. Which of
them show one object is found as lines are found in points: any two make a quadric, the others that it explains support
it, and what has most boxes behind it is taken, if those determine a quadric as a single track would have to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibslam_backend.association.matching import SIZE_RATIO, median_overlap
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.objects.initialisation import InitialisationSettings, initialise
from calibslam_msgs_py.measurements import Array

SUPPORT = 0.5  # median overlap of a track's boxes with those of a quadric that explains them
MOST = 300  # glimpses that are looked at, those of most boxes: all pairs of a crowd are too many
NEAREST = 0.1  # distance [m] from the camera below which rays do not meet


@dataclass(frozen=True)
class Glimpse:
    """The boxes of one track, N in the order of time: their keyframes, `poses` (N, 4, 4) T_map_camera, and `boxes`."""

    keyframes: tuple[int, ...]
    poses: Array
    boxes: list[BoxMeasurement]


@dataclass(frozen=True)
class Joined:
    """Glimpses, by index, of one object, and its quadric (9,)."""

    glimpses: list[int]
    vector: Array


def join(glimpses: Sequence[Glimpse], K: Array, robust_scale: float, settings: InitialisationSettings) -> list[Joined]:
    """The objects that are told by two or more of these glimpses together; no glimpse is of two.

    Args:
        glimpses: of one class.
        K: (3, 3) camera matrix [px].
        robust_scale: as in `box_factor`.
        settings: what is demanded of all boxes of an object together.
    """
    if len(glimpses) < 2:
        return []
    if len(glimpses) > MOST:
        most = sorted(range(len(glimpses)), key=lambda n: -len(glimpses[n].boxes))[:MOST]
        some = join([glimpses[n] for n in most], K, robust_scale, settings)
        return [Joined(sorted(most[n] for n in each.glimpses), each.vector) for each in some]
    meeting = rays_meet(glimpses, K)
    if not meeting.any():
        return []
    of_pairs = replace(settings, min_boxes=2)

    def quadric(group: Sequence[int], demanded: InitialisationSettings) -> Array | None:
        poses = np.concatenate([glimpses[n].poses for n in group])
        boxes = [box for n in group for box in glimpses[n].boxes]
        found = initialise(poses, boxes, K, robust_scale, demanded)
        return None if found is None else found.vector

    def number(group: Sequence[int]) -> int:
        return sum(len(glimpses[n].boxes) for n in group)

    groups: dict[tuple[int, ...], None] = {}  # each once, in a fixed order
    for a, b in np.argwhere(np.triu(meeting)).tolist():
        vector = quadric((a, b), of_pairs)
        if vector is not None:
            also = np.flatnonzero(meeting[a] & meeting[b]).tolist()
            supporters = _supporters(vector, [a, b, *also], glimpses, K)
            if {a, b} <= set(supporters) and number(supporters) >= settings.min_boxes:
                groups[tuple(supporters)] = None
    joined: list[Joined] = []
    taken: set[int] = set()
    for group in sorted(groups, key=number, reverse=True):
        if taken.isdisjoint(group) and (vector := quadric(group, settings)) is not None:
            joined.append(Joined(list(group), vector))
            taken.update(group)
    return joined


def _supporters(vector: Array, candidates: list[int], glimpses: Sequence[Glimpse], K: Array) -> list[int]:
    """Those of the candidates, the first ones first, that a quadric explains, in the order of their indices; an object
    has one box in an image."""
    group: list[int] = []
    keyframes: set[int] = set()
    for n in candidates:
        glimpse = glimpses[n]
        alone = keyframes.isdisjoint(glimpse.keyframes)
        if alone and median_overlap(glimpse.poses, glimpse.boxes, vector, K) >= SUPPORT:
            group.append(n)
            keyframes.update(glimpse.keyframes)
    return sorted(group)


def rays_meet(glimpses: Sequence[Glimpse], K: Array) -> NDArray[np.bool_]:
    """Pairs (N, N) of glimpses that may be of one object: no image shows both, and the rays through their middle boxes
    pass each other, in front of both cameras, nearer than the boxes are large there, which are of like size.

    Looks at all pairs, so that few are left that must be fitted.
    """
    middle = [len(glimpse.boxes) // 2 for glimpse in glimpses]
    corners = np.stack([glimpse.boxes[n].corners for glimpse, n in zip(glimpses, middle, strict=True)])
    poses = np.stack([glimpse.poses[n] for glimpse, n in zip(glimpses, middle, strict=True)])
    centres = (corners[:, :2] + corners[:, 2:]) / 2.0
    rays = np.concatenate([centres, np.ones((len(centres), 1))], axis=1) @ np.linalg.inv(K).T
    rays = np.einsum("nij,nj->ni", poses[:, :3, :3], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    angular = np.sqrt(np.prod(corners[:, 2:] - corners[:, :2], axis=1) / (K[0, 0] * K[1, 1])) / 2.0
    # The points of two lines p + s r that are nearest to each other.
    apart = poses[:, None, :3, 3] - poses[None, :, :3, 3]
    cosine = rays @ rays.T
    own, other = np.einsum("nmi,ni->nm", apart, rays), np.einsum("nmi,mi->nm", apart, rays)
    distance = (cosine * other - own) / np.maximum(1.0 - cosine**2, 1e-9)  # along the first of the pair
    gap = np.linalg.norm(apart + distance[..., None] * rays[:, None] - distance.T[..., None] * rays[None], axis=2)
    size = distance * angular[:, None]
    alike = np.maximum(size, size.T) < SIZE_RATIO * np.minimum(size, size.T)
    apart_in_time = [[set(a.keyframes).isdisjoint(b.keyframes) for b in glimpses] for a in glimpses]
    near = (distance > NEAREST) & (distance.T > NEAREST) & (gap < size + size.T) & alike
    return np.asarray(near & np.array(apart_in_time))
