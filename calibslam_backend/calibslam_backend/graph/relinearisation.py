"""Which factors are to be linearised anew: those of what has moved since they were, a few keyframes at a time.

An update costs what it touches. So old keyframes take turns, the newest and the boxes of young quadrics are looked at
with every update, and of all of them only those are linearised anew whose variables have moved, or whose worth has
changed.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibslam_backend.graph.measured import Landmark
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import Settings, setting


@dataclass(frozen=True)
class RelinearisationSettings(Settings):
    relinearised: int = setting(60, "earlier keyframes, with every second new one, that may be relinearised", low=1)
    relinearise_pose: float = setting(0.02, "change of a pose that asks for one", unit="rad and m", low=0.0)
    relinearise_quadric: float = setting(0.03, "change of a quadric that asks for one", unit="m and log m", low=0.0)
    young: int = setting(20, "keyframes during which a quadric is relinearised at once", low=0)


class Relinearisation:
    """Where factors were linearised; `Landmark.linearised` has what is particular to boxes."""

    WORTH_CHANGED = 0.1  # share by which a box's worth has to change

    def __init__(self, settings: RelinearisationSettings) -> None:
        self._settings = settings
        self._poses = np.zeros((0, 4, 4))  # of each keyframe where its factors were linearised
        self._next = 0

    def add_pose(self, T_map_camera: Array) -> None:
        """The factors of a new keyframe are linearised at this pose (4, 4)."""
        self._poses = np.append(self._poses, T_map_camera[None], axis=0)

    def turn(self, end: int) -> range:
        """The keyframes before `end` that are looked at now; with each call the next ones."""
        start = self._next if self._next < end else 0
        self._next = start + self._settings.relinearised
        return range(start, min(self._next, end))

    def due(
        self,
        turn: range,
        poses: Array,
        quadrics: tuple[Sequence[int], Array],
        landmarks: Mapping[int, Landmark],
        worth: float,
    ) -> list[Hashable]:
        """The names of factors that are to be linearised anew, which they are then taken to be.

        Args:
            turn: the keyframes whose factors are looked at.
            poses: (N, 4, 4) of all keyframes now.
            quadrics: ids and (M, 9) vectors now.
            landmarks: by id of quadric.
            worth: of a box now.
        """
        s = self._settings
        moved = np.abs(poses - self._poses).max(axis=(1, 2)) > s.relinearise_pose
        names: dict[Hashable, None] = {}  # each once, in a fixed order
        for k in turn:
            if moved[k]:
                names["motion", k] = names["motion", k + 1] = None
        for j, vector in zip(*quadrics, strict=True):
            landmark = landmarks[j]
            young = len(poses) - landmark.born <= s.young
            for k in landmark.boxes if young else [k for k in turn if k in landmark.boxes]:
                where, then = landmark.linearised[k]
                if (
                    moved[k]
                    or abs(worth - then) > self.WORTH_CHANGED * worth
                    or np.abs(vector - where).max() > s.relinearise_quadric
                ):
                    landmark.linearised[k] = vector, worth
                    names["box", k, j] = None
        for k in turn:
            if moved[k]:
                self._poses[k] = poses[k]
        return list(names)

    def all_done(
        self,
        poses: Array,
        quadrics: tuple[Sequence[int], Array],
        landmarks: Mapping[int, Landmark],
        worth: float,
    ) -> None:
        """All factors were linearised at these poses (N, 4, 4) and quadrics, see `due`."""
        self._poses = poses.copy()
        for j, vector in zip(*quadrics, strict=True):
            landmarks[j].linearised = dict.fromkeys(landmarks[j].boxes, (vector, worth))
