"""Objects that the map does not have yet: a quadric for an open track, or a group, whose boxes determine one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from calibslam_backend.association.assignments import Assignments
from calibslam_backend.association.matching import GIVEN, explains, same_object
from calibslam_backend.estimator_settings import EstimatorSettings
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.objects.initialisation import initialise_by_newest
from calibslam_backend.objects.joining import Glimpse, join
from calibslam_msgs_py.measurements import Array, Camera


class NewQuadrics:
    """Begins quadrics; `bind` gives them their tracks, `counts` is shared with the estimator."""

    # Keyframes within which tracks are joined while the map grows: until a loop is closed, poses that are farther apart
    # may not agree, and rows of like objects meet themselves.
    RECENT = 30

    def __init__(
        self,
        assignments: Assignments,
        camera: Camera,
        settings: EstimatorSettings,
        bind: Callable[[int, int], None],
        counts: Counter[str],
    ) -> None:
        self._assignments, self._graph = assignments, assignments.graph
        self._camera, self._settings = camera, settings
        self._bind, self._counts = bind, counts

    def start(self, tracks: Iterable[int]) -> None:
        """Begin a quadric for each open track whose boxes determine one."""
        for track in tracks:
            candidate = self._assignments.tracks[track]
            rows = self._assignments.open_rows(candidate)
            if candidate.quadric is not None or len(rows) < self._settings.min_boxes:
                continue
            poses, boxes = self._seen(rows)
            first = initialise_by_newest(poses, boxes, self._camera.K, self._settings.robust_scale, self._settings)
            if first is not None:
                self._begin([track], first.vector, poses, boxes)

    def join_ended(self, k: int) -> None:
        """Join the tracks that have ended before keyframe k with others that ended shortly before."""
        if self._settings.association == GIVEN or not k:
            return
        books = self._assignments
        in_view = set(books.frames[k].tracks)
        frames = books.frames[max(k - self.RECENT, 0) : k]
        ended = {t: books.tracks[t] for frame in frames for t in frame.tracks if t not in in_view}
        open_ones = [t for t, candidate in ended.items() if candidate.quadric is None]
        just_ended = {books.tracks[t].class_id for t in books.frames[k - 1].tracks if t in open_ones}
        self._join([t for t in open_ones if books.tracks[t].class_id in just_ended])

    def start_leftovers(self) -> None:
        """For all open tracks: with better poses, some determine a quadric that did not before."""
        tracks = [t for t, candidate in self._assignments.tracks.items() if candidate.quadric is None]
        self.start(tracks)
        if self._settings.association != GIVEN:
            self._join(tracks)

    def _join(self, tracks: Iterable[int]) -> None:
        """Begin quadrics for those of these open tracks, of one class each, that determine some together."""
        books, s = self._assignments, self._settings
        glimpses: dict[str, dict[int, Glimpse]] = {}
        for track in tracks:
            candidate = books.tracks[track]
            if rows := books.open_rows(candidate):
                keyframes = tuple(k for k, _ in rows)
                glimpses.setdefault(candidate.class_id, {})[track] = Glimpse(keyframes, *self._seen(rows))
        for of_class in glimpses.values():
            ids, seen = list(of_class), list(of_class.values())
            for joined in join(seen, self._camera.K, s.robust_scale, s):
                poses = np.concatenate([seen[n].poses for n in joined.glimpses])
                boxes = [box for n in joined.glimpses for box in seen[n].boxes]
                self._begin([ids[n] for n in joined.glimpses], joined.vector, poses, boxes)
                self._counts["joined"] += 1

    def _begin(self, tracks: Sequence[int], vector: Array, poses: Array, boxes: list[BoxMeasurement]) -> None:
        """A quadric (9,) of these tracks, whose boxes were seen from poses (N, 4, 4), unless the map has it."""
        known = self._same_as(tracks, vector, poses, boxes)
        j = self._assignments.begin(vector) if known is None else known
        for track in tracks:
            self._bind(track, j)

    def _same_as(self, tracks: Sequence[int], vector: Array, poses: Array, boxes: list[BoxMeasurement]) -> int | None:
        """The quadric that this one is, if the map has it; arguments as in `_begin`."""
        if self._settings.association == GIVEN:
            return None
        ids, vectors = self._graph.quadrics()
        if not ids:
            return None
        candidates = [self._assignments.tracks[track] for track in tracks]
        carried = {class_id for candidate in candidates for class_id in candidate.classes}
        same = same_object(vector, vectors, self._settings.merge_distance)
        for n in np.argsort(np.linalg.norm(vectors[:, :3] - vector[:3], axis=1)):
            j = ids[n]
            if (
                same[n]
                and self._assignments.classes[j].keys() & carried
                and not any(self._assignments.seen_apart(candidate, j) for candidate in candidates)
                and explains(vectors[n], poses, boxes, self._camera.K)
            ):
                return j
        return None

    def _seen(self, rows: list[tuple[int, int]]) -> tuple[Array, list[BoxMeasurement]]:
        """Poses (N, 4, 4) and boxes of rows (keyframe, number)."""
        poses = np.stack([self._graph.pose(k) for k, _ in rows])
        return poses, [self._assignments.frames[k].boxes[n] for k, n in rows]
