"""Where the camera is, from nothing but which objects it sees: after a loop, a lost odometry, in a known map.

A box and a quadric of its class give the quadric's place in the camera: the ray through the box, at the distance
where the object has the size of the box. One such pair and the rotation of odometry, or three pairs without it, give a
pose; the pose that explains most boxes is refined and counts if it explains several, and more than the pose that
odometry predicts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numba
import numpy as np
from numpy.typing import NDArray

from calibslam_backend.association.localisation import fit
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.ellipsoid import mean_radius
from calibslam_backend.geometry.shape import shapes
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import Settings, setting

FOUND, BEGIN = "found", "begin"


@dataclass(frozen=True)
class RelocalisationSettings(Settings):
    start_in_map: str = setting(
        FOUND,
        "first pose in a loaded map: found by its objects, or where that map was begun",
        choices=(FOUND, BEGIN),
    )
    relocalisation_boxes: int = setting(4, "boxes a new pose must explain", low=3)
    relocalisation_gain: int = setting(2, "boxes it must explain more than odometry's pose", low=1)
    relocalisation_overlap: float = setting(
        0.35, "intersection over union of a box that is explained", low=0.05, high=0.95
    )


@dataclass(frozen=True)
class Relocalised:
    """A pose T_map_camera (4, 4) and the pairs (box, quadric), by index, that it explains."""

    T_map_camera: Array
    pairs: list[tuple[int, int]]


REFINED = 4  # best hypotheses that are refined
FOUND_SHARE = 0.6  # of the boxes that a pose must explain of which nothing is known
TRIPLES = 300  # hypotheses of three pairs at most
LENGTH_ERROR = 0.3  # by which distances between objects, guessed from their sizes, may be wrong
PROMISING = 3  # pairs that a hypothesis must explain to be refined


def relocalise(
    predicted: Array | None,
    boxes: Sequence[BoxMeasurement],
    quadrics: Array,
    compatible: NDArray[np.bool_],
    K: Array,
    image: tuple[int, int],
    robust_scale: float,
    settings: RelocalisationSettings,
    is_plausible: Callable[[Array], bool] = lambda T: True,
) -> Relocalised | None:
    """A better pose than the predicted one, or None.

    Args:
        predicted: (4, 4) T_map_camera by odometry; None: nothing is known of it.
        boxes: N of one image.
        quadrics: (M, 9) vectors.
        compatible: (N, M) whether a box may be of a quadric, by their classes.
        K: (3, 3) camera matrix [px].
        image: width and height [px].
        robust_scale: as in the factor graph.
        settings: what a pose must explain.
        is_plausible: whether a pose (4, 4) may be the camera's by what else is known; asked of few.
    """
    if len(boxes) < settings.relocalisation_boxes or np.count_nonzero(compatible) < settings.relocalisation_boxes:
        return None
    corners = np.stack([box.corners for box in boxes])
    surfaces, sizes = shapes(quadrics), mean_radius(quadrics)
    size, centres = np.array(image, dtype=np.float64), np.ascontiguousarray(quadrics[:, :3])

    def overlaps(T: Array) -> Array:
        # One memory layout for all: numba compiles anew for each.
        return np.asarray(overlaps_at(np.ascontiguousarray(T), centres, surfaces, K, size, corners, compatible))

    def explained(T: Array) -> list[tuple[int, int]]:
        return _one_to_one(overlaps(T), settings.relocalisation_overlap)

    def best_of(hypotheses: list[Array]) -> list[Array]:
        if not hypotheses:
            return []
        scores = scores_at(np.stack(hypotheses), centres, surfaces, K, size, corners, compatible)
        return [hypotheses[n] for n in np.argsort(-scores, kind="stable")[:REFINED]]

    needed = max(settings.relocalisation_boxes, math.ceil(FOUND_SHARE * len(boxes)))
    if predicted is not None:
        needed = max(settings.relocalisation_boxes, len(explained(predicted)) + settings.relocalisation_gain)
    if len(boxes) < needed:
        return None
    points = _points(corners, sizes, K)
    best: Relocalised | None = None
    near = [] if predicted is None else _by_one(predicted, points, quadrics, compatible)
    for hypotheses in (near, _by_three(points, quadrics, compatible)):
        for T in best_of(hypotheses):
            pairs = explained(T)
            for _ in range(2):  # better poses explain more boxes, which make better poses
                if len(pairs) < PROMISING:
                    break
                T = fit(T, [quadrics[j] for _, j in pairs], [boxes[i] for i, _ in pairs], K, robust_scale)
                pairs = explained(T)
            if len(pairs) >= needed and (best is None or len(pairs) > len(best.pairs)) and is_plausible(T):
                best = Relocalised(T, pairs)
        if best is not None:
            return best
    return None


def _points(corners: Array, sizes: Array, K: Array) -> Array:
    """(N, M, 3) centre of quadric m in the camera, if box n is of it."""
    extent = np.sqrt((corners[:, 2] - corners[:, 0]) * (corners[:, 3] - corners[:, 1]))
    depths = np.sqrt(K[0, 0] * K[1, 1]) * 2.0 * sizes[None, :] / extent[:, None]
    centres = np.stack([corners[:, 0] + corners[:, 2], corners[:, 1] + corners[:, 3]], axis=1) / 2.0
    rays = np.concatenate([centres, np.ones((len(centres), 1))], axis=1) @ np.linalg.inv(K).T
    return np.asarray(depths[:, :, None] * rays[:, None, :])


def _by_one(predicted: Array, points: Array, quadrics: Array, compatible: NDArray[np.bool_]) -> list[Array]:
    """Poses with the predicted rotation, one per compatible pair."""
    poses = []
    for n, m in np.argwhere(compatible):
        T = predicted.copy()
        T[:3, 3] = quadrics[m, :3] - T[:3, :3] @ points[n, m]
        poses.append(T)
    return poses


def _by_three(points: Array, quadrics: Array, compatible: NDArray[np.bool_]) -> list[Array]:
    """Poses from three pairs whose distances agree. Sampled with a fixed seed: the same input gives the same poses."""
    pairs = np.argwhere(compatible)
    if len(pairs) < 3:
        return []
    if len(pairs) <= 20:
        triples = pairs[np.array(list(combinations(range(len(pairs)), 3)))]
    else:
        triples = pairs[np.random.default_rng(0).integers(len(pairs), size=(20 * TRIPLES, 3))]
    n, m = triples[:, :, 0], triples[:, :, 1]
    different = [(ids != np.roll(ids, 1, axis=1)).all(axis=1) for ids in (n, m)]
    here, there = points[n, m], quadrics[m, :3]
    lengths = [np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2) for p in (here, there)]
    agree = (np.abs(lengths[0] - lengths[1]) <= LENGTH_ERROR * lengths[1]).all(axis=1)
    chosen = np.flatnonzero(different[0] & different[1] & agree)[:TRIPLES]
    return list(_rigid(here[chosen], there[chosen]))


def _rigid(here: Array, there: Array) -> Array:
    """(N, 4, 4) T with there = T here for N sets of points (N, M, 3), least squares (Umeyama 1991, without scale)."""
    a, b = here.mean(axis=1), there.mean(axis=1)
    U, _, Vt = np.linalg.svd((there - b[:, None]).transpose(0, 2, 1) @ (here - a[:, None]))
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    T = np.tile(np.eye(4), (len(here), 1, 1))
    T[:, :3, :3] = U @ Vt
    T[:, :3, 3] = b - np.einsum("nij,nj->ni", T[:, :3, :3], a)
    return T


def _one_to_one(overlaps: Array, least: float) -> list[tuple[int, int]]:
    """Pairs (row, column) of at least this overlap, best first, each row and column once."""
    remaining = overlaps.copy()
    pairs = []
    while remaining.size and remaining.max() >= least:
        n, m = np.unravel_index(int(remaining.argmax()), remaining.shape)
        pairs.append((int(n), int(m)))
        remaining[n, :] = 0.0
        remaining[:, m] = 0.0
    return pairs


@numba.njit(cache=True)
def overlaps_at(T, centres, surfaces, K, size, corners, compatible):  # type: ignore[no-untyped-def]
    """Intersection over union (N, M) of boxes (N, 4) with those that M quadrics have in the image, seen from T (4, 4).

    Zero for pairs that are not compatible (N, M).
    """
    result = np.zeros((len(corners), len(centres)))
    c, N = np.empty(3), np.empty((3, 3))
    for m in range(len(centres)):
        if not compatible[:, m].any():
            continue
        # c = R^T (centre - t) and N = R^T surface R - c c^T, its upper half: loops, since products of small matrices
        # spend their time on memory.
        for a in range(3):
            c[a] = 0.0
            for i in range(3):
                c[a] += T[i, a] * (centres[m, i] - T[i, 3])
        if c[2] <= 0.0:
            continue
        for a in range(3):
            for b in range(a, 3):
                N[a, b] = -c[a] * c[b]
                for i in range(3):
                    for j in range(3):
                        N[a, b] += T[i, a] * surfaces[m, i, j] * T[j, b]
        if N[2, 2] >= 0.0:
            continue
        x, y = N[0, 2] / N[2, 2], N[1, 2] / N[2, 2]
        dx = np.sqrt(max(x * x - N[0, 0] / N[2, 2], 0.0)) * K[0, 0]
        dy = np.sqrt(max(y * y - N[1, 1] / N[2, 2], 0.0)) * K[1, 1]
        x, y = x * K[0, 0] + K[0, 2], y * K[1, 1] + K[1, 2]
        left, right = max(x - dx, 0.0), min(x + dx, size[0])
        top, bottom = max(y - dy, 0.0), min(y + dy, size[1])
        if left >= right or top >= bottom:
            continue
        for n in range(len(corners)):
            if not compatible[n, m]:
                continue
            width = min(right, corners[n, 2]) - max(left, corners[n, 0])
            height = min(bottom, corners[n, 3]) - max(top, corners[n, 1])
            if width > 0.0 and height > 0.0:
                shared = width * height
                own = (corners[n, 2] - corners[n, 0]) * (corners[n, 3] - corners[n, 1])
                result[n, m] = shared / (own + (right - left) * (bottom - top) - shared)
    return result


@numba.njit(cache=True)
def scores_at(poses, centres, surfaces, K, size, corners, compatible):  # type: ignore[no-untyped-def]
    """(H,) how well H poses (H, 4, 4) explain the boxes: sum of the best overlap of each, see `overlaps_at`."""
    scores = np.zeros(len(poses))
    for h in range(len(poses)):
        overlaps = overlaps_at(poses[h], centres, surfaces, K, size, corners, compatible)
        for n in range(len(corners)):
            scores[h] += overlaps[n].max()
    return scores
