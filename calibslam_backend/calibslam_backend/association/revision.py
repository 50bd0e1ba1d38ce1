"""Whose a box of an earlier keyframe is, judged anew with what is known now.

When a box was seen its quadric may not have been in the map, or the pose was still wrong: after a loop is closed, much
is clear that was not. Given poses and quadrics, the boxes of a keyframe are assigned all at once, each to a quadric
or to none. The cost of a pair is the squared Mahalanobis distance of the box to the one predicted, minus two log of
how likely the quadric's boxes carry that class, minus a bonus if the neighbours in its track fit there too; to be given
to no quadric costs as much as the gate. (The step of expectation to the step of maximisation that the graph is.)
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numba
import numpy as np

from calibslam_backend.association.matching import AssociationSettings, assign, class_costs, gate_of
from calibslam_backend.association.relocalisation import overlaps_at
from calibslam_backend.geometry.shape import shapes
from calibslam_backend.geometry.visible_box import box_of_visible_part
from calibslam_msgs_py.measurements import Array

SPAN = 4  # keyframes after which a neighbour in a track counts 1/e
REACH = 3 * SPAN  # farther ones do not count
FADING = [math.exp(-distance / SPAN) for distance in range(REACH + 1)]
COHERENCE = 10.0  # bonus of a pair if the track goes to that quadric for sure, half of it is lost if it surely does not


class Evidence:
    """What the boxes of a track say, each by itself, of whose they are.

    Neighbours in time are believed together, those far apart are not: a track may have slipped to another object.
    """

    def __init__(self) -> None:
        self._fits: dict[int, dict[int, float]] = {}

    def learn(self, k: int, fits: dict[int, float]) -> None:
        """How well the box of keyframe k fits which quadrics: its cost less that of no quadric, where negative."""
        self._fits[k] = fits

    def fits(self, k: int) -> dict[int, float] | None:
        """As learnt of the box of keyframe k; None: it was not judged so far."""
        return self._fits.get(k)

    def shares(self, k: int) -> dict[int, float]:
        """Probability that the object seen around keyframe k is which quadric; what is missing from 1: none."""
        sums: dict[int, float] = {}
        for other, fits in self._fits.items():
            if (distance := abs(k - other)) <= REACH:
                for j, fit in fits.items():
                    sums[j] = sums.get(j, 0.0) + FADING[distance] * fit
        least = min(sums.values(), default=0.0)
        odds = {j: math.exp(0.5 * (least - value)) for j, value in sums.items()}
        total = sum(odds.values()) + math.exp(0.5 * least)
        return {j: each / total for j, each in odds.items()}


class Revision:
    """The map as it is known now, by which boxes are judged."""

    def __init__(
        self,
        quadrics: Array,
        ids: Sequence[int],
        classes_of: Sequence[Counter[str]],
        K: Array,
        image: tuple[int, int],
        settings: AssociationSettings,
    ) -> None:
        """The map.

        Args:
            quadrics: (M, 9) vectors.
            ids: M.
            classes_of: M, how many boxes of the quadric have which class.
            K: (3, 3) camera matrix [px].
            image: width and height [px].
            settings: gate, model error, share of wrong classes.
        """
        self._quadrics, self._ids, self._classes_of = quadrics, ids, classes_of
        self._row = {j: m for m, j in enumerate(ids)}
        self._shapes = shapes(quadrics)
        self._K, self._image, self._settings = K, np.array(image, float), settings
        self._class_costs: dict[str, Array] = {}

    def judge(
        self,
        T_map_camera: Array,
        boxes: Sequence[Array],
        classes: Sequence[str],
        tracks: Sequence[Evidence],
        k: int,
    ) -> list[int | None]:
        """For each of N boxes of a keyframe the id of its quadric, or None.

        Args:
            T_map_camera: (4, 4) of the keyframe.
            boxes: corners (N, 4), covariances (N, 4, 4), bounds (N, 4) and clip (N, 4) of N boxes.
            classes: N, that they carry.
            tracks: N, the evidence of their tracks, which learns what these boxes say.
            k: number of the keyframe.
        """
        T, settings = np.ascontiguousarray(T_map_camera), self._settings
        cost = squared_distances(T, self._quadrics, self._shapes, self._K, self._image, *boxes, settings.model_error)
        cost += np.reshape([self._class_cost(class_id) for class_id in classes], cost.T.shape).T
        gate = gate_of(settings.gate)
        fits: list[dict[int, float]] = [{} for _ in tracks]
        for m, n in np.argwhere(cost < gate).tolist():
            fits[n][self._ids[m]] = float(cost[m, n]) - gate
        cost += 0.5 * COHERENCE
        for n, track in enumerate(tracks):
            track.learn(k, fits[n])
            for j, share in track.shares(k).items():
                if j in self._row:
                    cost[self._row[j], n] -= COHERENCE * share
        cost[cost >= gate] = np.inf
        result: list[int | None] = [None] * len(classes)
        for row, column in assign(cost - gate):
            result[column] = self._ids[row]
        return result

    def _class_cost(self, class_id: str) -> Array:
        """(M,) cost of a class with each quadric."""
        if class_id not in self._class_costs:
            self._class_costs[class_id] = class_costs(self._classes_of, class_id, self._settings.wrong_class)
        return self._class_costs[class_id]


@numba.njit(cache=True)
def squared_distances(T, quadrics, surfaces, K, size, corners, covariances, bounds, clip, model_error):  # type: ignore[no-untyped-def]
    """(M, N) squared Mahalanobis distance of N boxes to those of M quadrics, whose surfaces are their `shapes`.

    Infinite if they do not overlap.
    The covariance is that of the measurement and that of the ellipsoid as a model of the object.
    """
    result = np.full((len(quadrics), len(corners)), np.inf)
    S = np.empty((4, 4))
    compatible = np.ones((len(corners), len(quadrics)), np.bool_)
    overlaps = overlaps_at(T, quadrics[:, :3].copy(), surfaces, K, size, corners, compatible)
    for m in range(len(quadrics)):
        for n in range(len(corners)):
            if overlaps[n, m] == 0.0:
                continue
            visible, box, _ = box_of_visible_part(T, quadrics[m], K, bounds[n], clip[n])
            if not visible:
                continue
            S[:] = covariances[n]
            for edge in range(4):
                S[edge, edge] += (model_error * (box[edge % 2 + 2] - box[edge % 2])) ** 2
            difference = box - corners[n]
            result[m, n] = difference @ np.linalg.solve(S, difference)
    return result
