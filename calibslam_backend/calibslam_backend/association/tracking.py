"""Boxes of the same object in consecutive images.

Over a few images boxes of one object overlap, once the camera's rotation is undone; that is enough to link them
into tracks. Which landmark a track belongs to is decided elsewhere, with more evidence.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from calibslam_msgs_py.measurements import SECOND, Array
from calibslam_msgs_py.settings import Settings, setting


@dataclass(frozen=True)
class TrackingSettings(Settings):
    track_overlap: float = setting(0.3, "intersection over union of a track's last box and its next", low=0.0, high=1.0)
    max_gap: float = setting(0.5, "time after which an unseen track ends", unit="s", low=0.0)
    duplicate_overlap: float = setting(
        0.75, "two boxes of one image that overlap more are one object", low=0.0, high=1.0
    )


@dataclass
class Track:
    """One object over consecutive images: `corners` (4,) at `stamp` [ns], how often it had which class, and the class
    it had most often."""

    id: int
    stamp: int
    corners: Array
    class_id: str
    classes: Counter[str] = field(default_factory=Counter)

    def add(self, stamp: int, corners: Array, class_id: str) -> None:
        """The box of the next image."""
        self.stamp, self.corners = stamp, corners
        self.classes[class_id] += 1
        if self.classes[class_id] > self.classes[self.class_id]:
            self.class_id = class_id


@numba.njit(cache=True)
def overlap(a, b):  # type: ignore[no-untyped-def]
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4) [px]."""
    result = np.zeros((len(a), len(b)))
    for n in range(len(a)):
        for m in range(len(b)):
            width = min(a[n, 2], b[m, 2]) - max(a[n, 0], b[m, 0])
            height = min(a[n, 3], b[m, 3]) - max(a[n, 1], b[m, 1])
            if width > 0.0 and height > 0.0:
                shared = width * height
                areas = (a[n, 2] - a[n, 0]) * (a[n, 3] - a[n, 1]) + (b[m, 2] - b[m, 0]) * (b[m, 3] - b[m, 1])
                result[n, m] = shared / (areas - shared)
    return result


def unique(corners: Array, scores: Array, max_overlap: float) -> NDArray[np.int_]:
    """Indices of the boxes (N, 4) that remain when of each overlapping pair the one of lower score goes."""
    kept: list[int] = []
    overlaps = overlap(corners, corners)
    for i in np.argsort(-scores, kind="stable"):
        if all(overlaps[i, j] <= max_overlap for j in kept):
            kept.append(int(i))
    return np.array(sorted(kept), dtype=int)


def rotated(corners: Array, R_now_before: Array, K: Array) -> Array:
    """Where boxes (N, 4) [px] appear after the camera has turned; infinitely far objects, corners' centre and size."""
    H = K @ R_now_before @ np.linalg.inv(K)
    centres = 0.5 * (corners[:, :2] + corners[:, 2:])
    p = centres @ H[:, :2].T + H[:, 2]
    shift = p[:, :2] / np.maximum(p[:, 2:], 0.1) - centres
    return corners + np.tile(shift, 2)


class Tracker:
    """Links boxes to tracks, image by image."""

    # A box of another class than its track is possible, but must overlap that much more.
    CLASS_CHANGE = 0.2

    def __init__(self, settings: TrackingSettings, K: Array) -> None:
        self._settings = settings
        self._K = K
        self._next_id = 0
        self.tracks: list[Track] = []

    def update(self, stamp: int, corners: Array, class_ids: tuple[str, ...], R_now_before: Array) -> list[Track]:
        """The track of each box (N, 4) [px], in their order.

        Args:
            stamp: of the image [ns].
            corners: of the boxes, undistorted.
            class_ids: N.
            R_now_before: (3, 3) rotation of the camera from the previous image to this one.
        """
        oldest = stamp - int(self._settings.max_gap * SECOND)
        self.tracks = [track for track in self.tracks if track.stamp >= oldest]
        moved = np.reshape([track.corners for track in self.tracks], (-1, 4))
        if self.tracks:
            moved = rotated(moved, R_now_before, self._K)
            for track, box in zip(self.tracks, moved, strict=True):
                track.corners = box
        found: list[Track | None] = [None] * len(corners)
        if self.tracks and len(corners):
            score = overlap(moved, corners)
            other = np.array([[track.class_id != c for c in class_ids] for track in self.tracks])
            score = score - self.CLASS_CHANGE * other
            for t, b in zip(*linear_sum_assignment(-np.maximum(score, 0.0)), strict=True):
                if score[t, b] > self._settings.track_overlap:
                    found[b] = self.tracks[t]
        measured = zip(corners, class_ids, strict=True)
        linked = [track or self._begin(stamp, *box) for track, box in zip(found, measured, strict=True)]
        for track, box, class_id in zip(linked, corners, class_ids, strict=True):
            track.add(stamp, box, class_id)
        return linked

    def _begin(self, stamp: int, corners: Array, class_id: str) -> Track:
        track = Track(self._next_id, stamp, corners, class_id)
        self._next_id += 1
        self.tracks.append(track)
        return track
