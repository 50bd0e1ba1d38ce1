"""Mends what association got wrong, once more is known: boxes change hands, quadrics are united or dropped."""

from __future__ import annotations

from collections import Counter

import numpy as np

from calibslam_backend.association.assignments import Assignments
from calibslam_backend.association.matching import GIVEN, at_one_place, explains, same_object
from calibslam_backend.association.revision import Revision
from calibslam_backend.estimator_settings import EstimatorSettings
from calibslam_msgs_py.measurements import Array, Camera


class Upkeep:
    """Looks after the assignments; `counts` is shared with the estimator."""

    UNSETTLED = 10  # newest keyframes, whose boxes are not judged anew yet
    LEAST_BOXES = 3  # fewer do not determine a quadric
    NUMBERS = 9  # that a quadric is made of

    def __init__(
        self, assignments: Assignments, camera: Camera, settings: EstimatorSettings, counts: Counter[str]
    ) -> None:
        self._assignments, self._graph = assignments, assignments.graph
        self._camera, self._settings, self._counts = camera, settings, counts
        self._next_frame = 0  # to be revised
        self._next_quadric = 0  # to be asked whether it is needed

    # -- whose the boxes are ------------------------------------------------------------------------------------

    def revise(self, number: int | None = None) -> int:
        """Judge anew whose the boxes of earlier keyframes are, drop quadrics that are left without boxes or need.

        Args:
            number: of keyframes, taken in turn; None: all, and all quadrics.

        Returns:
            How many boxes changed hands.
        """
        if self._settings.association == GIVEN:
            return 0
        ids, vectors = self._graph.quadrics()
        if not ids:
            return 0
        revision = Revision(
            vectors,
            ids,
            [self._assignments.classes[j] for j in ids],
            self._camera.K,
            (self._camera.width, self._camera.height),
            self._settings,
        )
        frames = self._assignments.frames
        turn = range(len(frames)) if number is None else self._turn(number)
        changed = sum(self._revise_frame(k, revision) for k in turn)
        self._drop_without_boxes()
        self._drop_superfluous(None if number is None else 1)
        self._counts["revised"] += changed
        return changed

    def _turn(self, number: int) -> list[int]:
        """The earlier keyframes whose turn it is."""
        settled = len(self._assignments.frames) - self.UNSETTLED
        turn = [k % settled for k in range(self._next_frame, self._next_frame + min(number, settled))]
        if turn:
            self._next_frame = (turn[-1] + 1) % settled
        return turn

    def _revise_frame(self, k: int, revision: Revision) -> int:
        """Returns how many boxes changed hands."""
        books, frame = self._assignments, self._assignments.frames[k]
        if not frame.boxes:
            return 0
        tracks = [books.tracks[track].evidence for track in frame.tracks]
        revised = revision.judge(self._graph.pose(k), frame.arrays, frame.classes, tracks, k)
        changed = [n for n, (old, new) in enumerate(zip(frame.quadrics, revised, strict=True)) if old != new]
        for n in changed:
            books.take(k, n)
        for n in changed:
            if (j := revised[n]) is not None:
                books.give(k, n, j)
        for n in changed:
            books.rebind(frame.tracks[n], self._settings.votes)
        return len(changed)

    # -- which quadrics there are -------------------------------------------------------------------------------

    def merge(self) -> None:
        """Unite quadrics that have become one object; the younger goes."""
        if self._settings.association == GIVEN:
            return
        landmarks = self._graph.landmarks
        for j, known in self._assignments.same:
            if j in landmarks and known in landmarks and not self._assignments.seen_beside(j, known):
                self._unite(j, known)
        self._assignments.same.clear()
        ids, vectors = self._graph.quadrics()
        if not ids:
            return
        pairs = vectors[:, None], vectors[None]
        # An older quadric of its place, size and class, never seen beside it, that explains its boxes, is the same
        # object; even one seen beside it, if both have settled at one place.
        settled = np.array([self._assignments.age(j) >= self._assignments.YOUNG for j in ids])
        inside = at_one_place(*pairs) & settled[:, None]
        gone = set()
        for m, n in np.argwhere(np.tril(same_object(*pairs, self._settings.merge_distance) | inside, -1))[::-1]:
            j, older = ids[m], ids[n]
            if j in gone or len({self._assignments.class_of_quadric(i) for i in (j, older)}) > 1:
                continue
            if inside[m, n] or (not self._assignments.seen_beside(j, older) and self._explains(vectors[n], j)):
                self._unite(j, older)
                gone.add(j)

    def _explains(self, vector: Array, j: int) -> bool:
        """Whether a quadric (9,) explains the boxes of quadric j."""
        boxes = self._graph.landmarks[j].boxes
        poses = np.reshape([self._graph.pose(k) for k in boxes], (-1, 4, 4))
        return explains(vector, poses, list(boxes.values()), self._camera.K)

    def _unite(self, j: int, target: int) -> None:
        self._assignments.unite(j, target)
        self._counts["merged"] += 1

    def _own(self) -> list[int]:
        """Quadrics that no loaded map has brought, the youngest first."""
        return sorted(self._graph.landmarks.keys() - self._assignments.known, reverse=True)

    def _drop_without_boxes(self) -> None:
        for j in self._own():
            if len(self._graph.landmarks[j].boxes) < self.LEAST_BOXES:
                self._graph.remove_quadric(j)
                self._assignments.forget(j)
                self._counts["quadrics_revised_away"] += 1

    def _drop_superfluous(self, number: int | None) -> None:
        """Drop quadrics that others explain nearly as well: objects that were begun twice.

        Args:
            number: of quadrics that are looked at, in turn; None: all.
        """
        own = self._own()
        if number is not None and own:
            own = [own[(self._next_quadric + n) % len(own)] for n in range(min(number, len(own)))]
            self._next_quadric += number
        for j in own:
            if (others := self._others_for(j)) is not None:
                self._assignments.dissolve(j, others, self._settings.votes)
                self._counts["quadrics_superfluous"] += 1

    def _others_for(self, j: int) -> dict[int, int | None] | None:
        """For each keyframe the quadric, if any, that its box of quadric j may as well be of; None: j is needed.

        What the boxes would lose must be worth the numbers that a quadric is made of (BIC, Schwarz 1978).
        """
        books = self._assignments
        class_id = books.class_of_quadric(j)
        alike = {m for m in self._graph.landmarks if m != j and books.class_of_quadric(m) == class_id}
        keyframes = self._graph.landmarks[j].boxes
        others: dict[int, int | None] = {}
        lost = 0.0
        for k in reversed(keyframes):  # of an object in sight the newest have not been judged yet
            frame = books.frames[k]
            fits = books.tracks[frame.tracks[books.row(k, j)]].evidence.fits(k)
            if fits is None:
                return None
            free = {m: fit for m, fit in fits.items() if m in alike and m not in frame.quadrics}
            others[k] = min(free, key=free.__getitem__, default=None)
            lost += min(free.values(), default=0.0) - fits.get(j, 0.0)
        lost *= self._graph.correlation.worth
        return others if lost < self.NUMBERS * np.log(max(len(keyframes), 1)) else None
