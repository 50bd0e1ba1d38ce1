"""Which quadric a box is of: tracks as evidence, quadrics begun, bound, found again and united.

A track is open until it is bound to a quadric, which happens when several keyframes agree on one (`vote`,
`relocalise`) or when its own boxes determine a new one (`start_quadrics`).
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable, Set
from dataclasses import dataclass, field, replace

import numpy as np

from calibslam_backend.association import (
    GIVEN,
    Prediction,
    Votes,
    assign,
    at_one_place,
    distances,
    predict,
    predicted_corners,
    same_object,
    unambiguous,
)
from calibslam_backend.box_measurement import BoxMeasurement, prepare, stacked
from calibslam_backend.estimator_settings import EstimatorSettings
from calibslam_backend.graph import ObjectGraph, UpdateReport
from calibslam_backend.initialisation import initialise
from calibslam_backend.innovation import innovations
from calibslam_backend.localisation import localise
from calibslam_backend.noise import NoiseModel, spread
from calibslam_backend.relocalisation import Relocalised, relocalise
from calibslam_backend.revision import Revision
from calibslam_backend.tracking import overlap
from calibslam_msgs_py.measurements import Array, Boxes, Camera


@dataclass
class Frame:
    """The boxes of a keyframe.

    Attributes:
        boxes: what was measured.
        tracks: that they belong to.
        classes: that they carry.
        names: their true identities, "" where unknown.
        quadrics: that they are given to; None: none so far.
    """

    boxes: list[BoxMeasurement]
    tracks: list[int]
    classes: tuple[str, ...]
    names: tuple[str, ...]
    quadrics: list[int | None]

    @functools.cached_property
    def arrays(self) -> list[Array]:
        """(N, ...) corners, covariances, bounds and clip of the boxes."""
        corners, whiteners, bounds, clip = stacked(self.boxes)
        return [corners, np.linalg.inv(whiteners.transpose(0, 2, 1) @ whiteners), bounds, clip]


@dataclass
class Candidate:
    """What is known of a track: its boxes (keyframe, row), its classes in all images, the quadric it is bound to."""

    seen: list[tuple[int, int]] = field(default_factory=list)
    classes: Counter[str] = field(default_factory=Counter)
    quadric: int | None = None
    misfits: int = 0


class DataAssociation:
    """Tracks and the quadrics they are bound to; gives the graph its quadrics and boxes.

    Attributes:
        frames: the boxes of every keyframe and what became of them.
        classes: for each quadric, how many of its boxes have which class.
        counts: what happened, by name; shared with the estimator.
    """

    # A bound track whose boxes miss their quadric so often in a row has slipped to another object.
    MAX_MISFITS = 3
    LEAST_FIT = 0.1  # overlap of a box with its quadric's that is no misfit
    YOUNG = 30  # keyframes during which a quadric may turn out to be one that was known before
    UNSETTLED = 10  # newest keyframes, whose boxes are not judged anew yet
    LEAST_BOXES = 3  # fewer do not determine a quadric

    def __init__(self, graph: ObjectGraph, camera: Camera, settings: EstimatorSettings, counts: Counter[str]) -> None:
        self.camera, self.settings, self.counts = camera, settings, counts
        self.frames: list[Frame] = []
        self.classes: dict[int, Counter[str]] = {}
        self._graph = graph
        self._noise = NoiseModel(settings)
        self._votes = Votes(settings.votes)
        self._candidates: dict[int, Candidate] = {}
        self._next_quadric = 0
        self._same: list[tuple[int, int]] = []  # quadrics found to be others; united after the update
        self._known: set[int] = set()  # quadrics of a loaded map
        self._revised = 0  # the next keyframe to be revised

    def see(self, tracks: list[int], class_ids: tuple[str, ...]) -> None:
        """The tracks of an image and the classes of their boxes."""
        for track, class_id in zip(tracks, class_ids, strict=True):
            self._candidates.setdefault(track, Candidate()).classes[class_id] += 1

    def know(self, j: int, vector: Array, covariance: Array, classes: Counter[str]) -> None:
        """A quadric of a loaded map."""
        self._graph.add_known_quadric(j, vector, covariance)
        self._known.add(j)
        self.classes[j] = classes
        self._next_quadric = max(self._next_quadric, j + 1)

    def class_of_quadric(self, j: int) -> str:
        """The class most of its boxes carry."""
        return self.classes[j].most_common(1)[0][0]

    def frame(self, boxes: Boxes, tracks: list[int]) -> Frame:
        """The boxes of an image made ready, with the covariances the noise model gives them."""
        covariances = np.empty((len(boxes), 4, 4))
        for i, track in enumerate(tracks):
            quadric = self._candidates[track].quadric
            key = ~track if quadric is None else quadric
            self._noise.observe(key, boxes.corners[i])
            covariances[i] = self._noise.covariance(key, boxes.covariances[i])
        measurements = prepare(boxes, covariances, self.camera)
        return Frame(measurements, tracks, boxes.class_ids, boxes.object_ids, [None] * len(boxes))

    def localise(self, frame: Frame, predicted: Array, covariance: Array) -> Array:
        """First estimate of the pose, from odometry and the boxes of bound tracks."""
        bound = [(self._candidates[t].quadric, box) for t, box in zip(frame.tracks, frame.boxes, strict=True)]
        known = [(self._graph.quadric(j), box) for j, box in bound if j is not None]
        s = self.settings
        quadrics, boxes = [vector for vector, _ in known], [box for _, box in known]
        return localise(predicted, covariance, quadrics, boxes, self.camera.K, s.robust_scale, s.robust_odometry)

    def innovations(self, frame: Frame, predicted: Array, covariance: Array) -> Array:
        """Normalised innovations squared of the boxes of bound tracks; arguments as in `localise`."""
        bound = [(self._candidates[t].quadric, box) for t, box in zip(frame.tracks, frame.boxes, strict=True)]
        known = [(j, box) for j, box in bound if j is not None and self._graph.is_solved(j)]
        ids = sorted({j for j, _ in known})
        joint = dict(zip(ids, self._graph.joint_covariances(len(self.frames) - 1, ids), strict=True))
        for each in joint.values():
            each[:6, :6] += covariance
        vectors, boxes = [self._graph.quadric(j) for j, _ in known], [box for _, box in known]
        return innovations(predicted, vectors, [joint[j] for j, _ in known], boxes, self.camera.K)

    def add(self, frame: Frame) -> int:
        """The boxes of the newest keyframe; those of bound tracks go to their quadrics. Returns how many."""
        k = len(self.frames)
        self.frames.append(frame)
        used = 0
        T = self._graph.pose(k)
        for n, (track, box) in enumerate(zip(frame.tracks, frame.boxes, strict=True)):
            candidate = self._candidates[track]
            candidate.seen.append((k, n))
            if candidate.quadric is None:
                continue
            corners = predicted_corners(T, self._graph.quadric(candidate.quadric), self.camera.K, box)
            fits = corners is not None and overlap(corners[None], box.corners[None])[0, 0] >= self.LEAST_FIT
            if fits and self._give(k, n, candidate.quadric):
                candidate.misfits = 0
                used += 1
                continue
            self.counts["rejected_misfit"] += 1
            candidate.misfits += 1
            if candidate.misfits >= self.MAX_MISFITS and self.settings.association != GIVEN:
                self.counts["unbound"] += 1
                candidate.quadric, candidate.misfits = None, 0
        return used

    def vote(self, k: int, step: Array) -> None:
        """Open tracks vote for the quadrics that explain their boxes."""
        if self.settings.association == GIVEN:
            return
        frame = self.frames[k]
        taken = {self._candidates[t].quadric for t in frame.tracks}
        rows = [n for n, t in enumerate(frame.tracks) if self._candidates[t].quadric is None]
        if not rows:
            return
        T = self._graph.pose(k)
        open_boxes = [frame.boxes[n] for n in rows]
        near = [
            j
            for j in self._graph.landmarks
            if j not in taken and self._graph.is_solved(j) and self._in_question(T, j, open_boxes)
        ]
        predictions = []
        for j, covariance in zip(near, self._graph.joint_covariances(k - 1, near), strict=True):
            covariance[:6, :6] += step
            vector = self._graph.quadric(j)
            prediction = predict(T, vector, covariance, self.camera.K, open_boxes[0], self.settings.model_error)
            if prediction is not None:
                predictions.append(Prediction(j, *prediction, self.class_of_quadric(j)))
        classes = [self._candidates[frame.tracks[n]].classes.most_common(1)[0][0] for n in rows]
        cost = distances(predictions, open_boxes, classes, self.settings)
        for p, r in unambiguous(cost, assign(cost), self.settings.ambiguity):
            self._vote_for(frame.tracks[rows[r]], predictions[p].landmark)

    def find(self, frame: Frame) -> Relocalised | None:
        """Where in a loaded map a camera with these boxes is."""
        return self._relocalised(frame, None, list(self._graph.landmarks))

    def bind_found(self, frame: Frame, found: Relocalised) -> None:
        """The boxes of the keyframe where the camera was found belong to the quadrics that it was found by."""
        for n, j in found.pairs:
            self._bind(frame.tracks[n], j)

    def _vote_for(self, track: int, landmark: int) -> None:
        decided = self._votes.add(track, landmark)
        if decided is not None and not self._seen_apart(self._candidates[track], decided):
            self._bind(track, decided)

    def relocalise(self, k: int) -> None:
        """Where the boxes show known objects from another pose than the predicted one, vote for those."""
        tracks = self.frames[k].tracks
        if self.settings.association == GIVEN or not any(self._recent(t, k) for t in tracks):
            return
        # A young quadric is what is in question: it may be an old one, seen from where the camera is not.
        old = [
            j
            for j, landmark in self._graph.landmarks.items()
            if self._graph.is_solved(j) and k - landmark.born > self.YOUNG
        ]
        found = self._relocalised(self.frames[k], self._graph.pose(k), old)
        if found is None:
            return
        self.counts["relocalised"] += 1
        for n, j in found.pairs:
            bound = self._candidates[tracks[n]].quadric
            if bound is None:
                self._vote_for(tracks[n], j)
            elif bound != j and self._votes.add(~bound, j) == j:
                self._same.append((bound, j))

    def _relocalised(self, frame: Frame, predicted: Array | None, known: list[int]) -> Relocalised | None:
        """A better pose than the predicted one by these quadrics; its pairs are (row, id of the quadric)."""
        if not known:
            return None
        classes = np.array([self.class_of_quadric(j) for j in known])
        found = relocalise(
            predicted,
            frame.boxes,
            np.stack([self._graph.quadric(j) for j in known]),
            np.reshape([classes == self._class_of(track) for track in frame.tracks], (-1, len(known))),
            self.camera.K,
            (self.camera.width, self.camera.height),
            self.settings.robust_scale,
            self.settings,
        )
        return found and replace(found, pairs=[(n, known[m]) for n, m in found.pairs])

    def start_quadrics(self, tracks: Iterable[int]) -> list[int]:
        """Begin a quadric for each open track whose boxes determine one; returns the new ones."""
        added = []
        for track in tracks:
            candidate = self._candidates[track]
            rows = self._open_rows(candidate)
            if candidate.quadric is not None or len(rows) < self.settings.min_boxes:
                continue
            poses = np.stack([self._graph.pose(k) for k, _ in rows])
            boxes = [self.frames[k].boxes[n] for k, n in rows]
            first = initialise(poses, boxes, self.camera.K, self.settings.robust_scale, self.settings)
            if first is None:
                continue
            known = self._same_as(first.vector, candidate)
            if known is not None:
                self._bind(track, known)
                continue
            j = self._next_quadric
            self._next_quadric += 1
            self._graph.add_quadric(j, first.vector)
            self._bind(track, j)
            added.append(j)
        return added

    def start_leftovers(self) -> list[int]:
        """`start_quadrics` for every open track: with better poses, some determine a quadric that did not before."""
        return self.start_quadrics([t for t, candidate in self._candidates.items() if candidate.quadric is None])

    def _same_as(self, vector: Array, candidate: Candidate) -> int | None:
        """The quadric that this one is, if the map has it."""
        if self.settings.association == GIVEN:
            return None
        ids = list(self._graph.landmarks)
        if not ids:
            return None
        vectors = np.stack([self._graph.quadric(j) for j in ids])
        same = same_object(vector, vectors, self.settings.merge_distance)
        for n in np.argsort(np.linalg.norm(vectors[:, :3] - vector[:3], axis=1)):
            j = ids[n]
            if same[n] and self.classes[j].keys() & candidate.classes.keys() and not self._seen_apart(candidate, j):
                return j
        return None

    def revise(self, number: int | None = None) -> int:
        """Judge anew whose the boxes of earlier keyframes are; returns how many changed hands.

        Args:
            number: of keyframes, taken in turn; None: all.
        """
        if self.settings.association == GIVEN:
            return 0
        ids = list(self._graph.landmarks)
        if not ids:
            return 0
        revision = Revision(
            np.stack([self._graph.quadric(j) for j in ids]),
            ids,
            [self.classes[j] for j in ids],
            self.camera.K,
            (self.camera.width, self.camera.height),
            self.settings,
        )
        turn = range(len(self.frames)) if number is None else self._next_settled(number)
        given: dict[int, Counter[int]] = {}
        changed = sum(self._revise_frame(k, revision, given) for k in turn)
        for j in [j for j in ids if j not in self._known and len(self._graph.landmarks[j].boxes) < self.LEAST_BOXES]:
            self._graph.remove_quadric(j)
            self._forget(j)
            self.counts["quadrics_revised_away"] += 1
        self.counts["revised"] += changed
        return changed

    def _next_settled(self, number: int) -> list[int]:
        """The earlier keyframes whose turn it is."""
        settled = len(self.frames) - self.UNSETTLED
        turn = [k % settled for k in range(self._revised, self._revised + min(number, settled))]
        if turn:
            self._revised = (turn[-1] + 1) % settled
        return turn

    def _revise_frame(self, k: int, revision: Revision, given: dict[int, Counter[int]]) -> int:
        """Returns how many boxes changed hands; `given` keeps `_given_to` of tracks while none does."""
        frame = self.frames[k]
        if not frame.boxes:
            return 0
        for track in frame.tracks:
            if track not in given:
                given[track] = self._given_to(self._candidates[track])
        by_track = [given[track] for track in frame.tracks]
        revised = revision.judge(self._graph.pose(k), frame.arrays, frame.classes, by_track)
        changed = [n for n, (old, new) in enumerate(zip(frame.quadrics, revised, strict=True)) if old != new]
        for n in changed:
            self._take(k, n)
        for n in changed:
            if (j := revised[n]) is not None:
                self._give(k, n, j)
        for n in changed:
            self._rebind(frame.tracks[n])
        if changed:
            given.clear()
        return len(changed)

    def _rebind(self, track: int) -> None:
        """A track belongs to the quadric that most of its boxes are given to."""
        candidate = self._candidates[track]
        given = self._given_to(candidate)
        if given:
            j, number = given.most_common(1)[0]
            if number >= self.settings.votes and 2 * number > len(candidate.seen):
                candidate.quadric = j

    def merge(self) -> None:
        """Unite quadrics that have become one object; the younger goes."""
        if self.settings.association == GIVEN:
            return
        for j, known in self._same:
            if j in self._graph.landmarks and known in self._graph.landmarks:
                self._unite(j, known)
        self._same.clear()
        ids = sorted(self._graph.landmarks)
        if not ids:
            return
        vectors = np.stack([self._graph.quadric(j) for j in ids])
        pairs = vectors[:, None], vectors[None]
        # An older quadric of its place, size and class, never seen beside it, is the same object; even one seen beside
        # it, if both have settled at one place.
        inside = at_one_place(*pairs) & np.array([[self._is_settled(j)] for j in ids])
        gone = set()
        for m, n in np.argwhere(np.tril(same_object(*pairs, self.settings.merge_distance) | inside, -1))[::-1]:
            j, older = ids[m], ids[n]
            if j in gone or self.class_of_quadric(older) != self.class_of_quadric(j):
                continue
            if inside[m, n] or not _apart(*(self._graph.landmarks[i].boxes.keys() for i in (j, older))):
                self._unite(j, older)
                gone.add(j)

    def _is_settled(self, j: int) -> bool:
        """Whether a quadric is no longer young."""
        return len(self.frames) - self._graph.landmarks[j].born > self.YOUNG

    def spread_over_all(self) -> None:
        """Covariances of boxes from the spread of all boxes of their quadric, not of those so far (eq. 4.3.1)."""
        for j, landmark in self._graph.landmarks.items():
            if not landmark.boxes:
                continue
            sigma = spread(np.stack([box.corners for box in landmark.boxes.values()])) * self.settings.covariance_scale
            for k, box in list(landmark.boxes.items()):
                self._graph.remove_box(k, j)
                self._graph.add_box(k, j, replace(box, whitener=np.eye(4) / sigma))

    def note(self, report: UpdateReport) -> None:
        """Book what the graph took out: its boxes and tracks are open again."""
        self.counts["repairs"] += bool(report.repaired)
        for j in [j for j in self.classes if j not in self._graph.landmarks]:
            self.counts["quadrics_removed"] += 1
            self._forget(j)

    def _forget(self, j: int) -> None:
        """A quadric is no more."""
        del self.classes[j]
        for frame in self.frames:
            frame.quadrics = [None if quadric == j else quadric for quadric in frame.quadrics]
        for candidate in self._candidates.values():
            if candidate.quadric == j:
                candidate.quadric = None

    def _give(self, k: int, n: int, j: int) -> bool:
        """Box n of keyframe k is of quadric j; False if that has another box there."""
        frame = self.frames[k]
        if k in self._graph.landmarks[j].boxes:
            return False
        frame.quadrics[n] = j
        self._graph.add_box(k, j, frame.boxes[n])
        self.classes[j][frame.classes[n]] += 1
        return True

    def _take(self, k: int, n: int) -> None:
        """Box n of keyframe k is open again."""
        frame = self.frames[k]
        j = frame.quadrics[n]
        if j is not None:
            frame.quadrics[n] = None
            self._graph.remove_box(k, j)
            self.classes[j][frame.classes[n]] -= 1

    def _bind(self, track: int, j: int) -> None:
        """The track's boxes are of this quadric: those that are open and those to come."""
        candidate = self._candidates[track]
        self.classes.setdefault(j, Counter())
        for k, n in self._open_rows(candidate):
            self._give(k, n, j)
        candidate.quadric, candidate.misfits = j, 0
        self._votes.forget(track)
        self.counts["bound"] += 1

    def _unite(self, j: int, target: int) -> None:
        """Quadric j is the same object as another, which gets its boxes."""
        for k in list(self._graph.landmarks[j].boxes):
            n = self.frames[k].quadrics.index(j)
            self._take(k, n)
            self._give(k, n, target)
        for candidate in self._candidates.values():
            if candidate.quadric == j:
                candidate.quadric = target
        self._graph.remove_quadric(j)
        del self.classes[j]
        self.counts["merged"] += 1

    def _given_to(self, candidate: Candidate) -> Counter[int]:
        """How many boxes of a track are given to which quadrics."""
        return Counter(j for k, n in candidate.seen if (j := self.frames[k].quadrics[n]) is not None)

    def _open_rows(self, candidate: Candidate) -> list[tuple[int, int]]:
        """Boxes of a track, (keyframe, row), that are given to no quadric."""
        return [(k, n) for k, n in candidate.seen if self.frames[k].quadrics[n] is None]

    def _class_of(self, track: int) -> str:
        """The class most boxes of a track, or of the quadric it is bound to, carry."""
        candidate = self._candidates[track]
        if candidate.quadric is not None:
            return self.class_of_quadric(candidate.quadric)
        return candidate.classes.most_common(1)[0][0]

    def _recent(self, track: int, k: int) -> bool:
        """Whether a track is open, or bound to a young quadric."""
        landmark = self._candidates[track].quadric
        return landmark is None or k - self._graph.landmarks[landmark].born <= self.YOUNG

    def _in_question(self, T_map_camera: Array, j: int, boxes: list[BoxMeasurement]) -> bool:
        """Whether one of these boxes may be of a quadric: worth the cost of its joint covariance with the pose."""
        predicted = predicted_corners(T_map_camera, self._graph.quadric(j), self.camera.K, boxes[0])
        measured = np.stack([box.corners for box in boxes])
        return predicted is not None and bool(overlap(predicted[None], measured).max() >= self.settings.min_overlap)

    def _seen_apart(self, candidate: Candidate, landmark: int) -> bool:
        """Whether an image shows both the track and the landmark, as two boxes."""
        return _apart({k for k, _ in self._open_rows(candidate)}, self._graph.landmarks[landmark].boxes.keys())


def _apart(a: Set[int], b: Set[int]) -> bool:
    """Whether two objects share more than a tenth of the keyframes of the shorter: then they are two."""
    return len(a & b) > 0.1 * min(len(a), len(b))
