"""Which quadric a box is of: tracks as evidence, quadrics begun, bound, found again and united.

A track is open until it is bound to a quadric, which happens when several keyframes agree on one (`vote`,
`relocalise`) or when its own boxes determine a new one (`start_quadrics`).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from calibslam_backend.association import (
    GIVEN,
    Prediction,
    Votes,
    assign,
    distances,
    predict,
    predicted_corners,
    same_object,
)
from calibslam_backend.box_measurement import BoxMeasurement, prepare
from calibslam_backend.estimator_settings import EstimatorSettings
from calibslam_backend.graph import ObjectGraph, UpdateReport
from calibslam_backend.initialisation import initialise
from calibslam_backend.localisation import localise
from calibslam_backend.noise import NoiseModel
from calibslam_backend.relocalisation import relocalise
from calibslam_backend.tracking import overlap
from calibslam_msgs_py.measurements import Array, Boxes, Camera


@dataclass
class Candidate:
    """What is known of a track: its boxes in keyframes, its classes, the quadric it is bound to."""

    boxes: list[tuple[int, BoxMeasurement]] = field(default_factory=list)
    classes: Counter[str] = field(default_factory=Counter)
    landmark: int | None = None
    misfits: int = 0


class DataAssociation:
    """Tracks and the quadrics they are bound to; gives the graph its quadrics and boxes.

    Attributes:
        classes: for each quadric, how often its boxes had which class.
        counts: what happened, by name; shared with the estimator.
    """

    # A bound track whose boxes miss their quadric so often in a row has slipped to another object.
    MAX_MISFITS = 3
    LEAST_FIT = 0.1  # overlap of a box with its quadric's that is no misfit
    YOUNG = 30  # keyframes during which a quadric may turn out to be one that was known before

    def __init__(self, graph: ObjectGraph, camera: Camera, settings: EstimatorSettings, counts: Counter[str]) -> None:
        self.camera, self.settings, self.counts = camera, settings, counts
        self.classes: dict[int, Counter[str]] = {}
        self._graph = graph
        self._noise = NoiseModel(settings)
        self._votes = Votes(settings.votes)
        self._candidates: dict[int, Candidate] = {}
        self._next_quadric = 0
        self._same: list[tuple[int, int]] = []  # quadrics found to be others; united after the update

    def see(self, tracks: list[int], class_ids: tuple[str, ...]) -> None:
        """The tracks of an image and the classes of their boxes."""
        for track, class_id in zip(tracks, class_ids, strict=True):
            self._candidates.setdefault(track, Candidate()).classes[class_id] += 1

    def know(self, j: int, vector: Array, covariance: Array, classes: Counter[str]) -> None:
        """A quadric of a loaded map."""
        self._graph.add_known_quadric(j, vector, covariance)
        self.classes[j] = classes
        self._next_quadric = max(self._next_quadric, j + 1)

    def class_of_quadric(self, j: int) -> str:
        """The class most of its boxes carry."""
        return self.classes[j].most_common(1)[0][0]

    def keep_open(self, k: int, tracks: list[int], measurements: list[BoxMeasurement]) -> None:
        """Boxes of tracks that are still open are kept with them."""
        for track, box in zip(tracks, measurements, strict=True):
            candidate = self._candidates[track]
            if candidate.landmark is None:
                candidate.boxes.append((k, box))

    def quadric_of_track(self, track: int) -> int | None:
        """The quadric a track is bound to."""
        return self._candidates[track].landmark

    def measurements(self, boxes: Boxes, tracks: list[int]) -> list[BoxMeasurement]:
        covariances = np.empty((len(boxes), 4, 4))
        for i, track in enumerate(tracks):
            landmark = self._candidates[track].landmark
            key = ~track if landmark is None else landmark
            self._noise.observe(key, boxes.corners[i])
            covariances[i] = self._noise.covariance(key, boxes.covariances[i])
        return prepare(boxes, covariances, self.camera)

    def localise(
        self, tracks: list[int], measurements: list[BoxMeasurement], predicted: Array, covariance: Array
    ) -> Array:
        """First estimate of the pose, from odometry and the boxes of bound tracks."""
        bound = [(self._candidates[t].landmark, box) for t, box in zip(tracks, measurements, strict=True)]
        known = [(self._graph.quadric(j), box) for j, box in bound if j is not None]
        s = self.settings
        quadrics, boxes = [vector for vector, _ in known], [box for _, box in known]
        return localise(predicted, covariance, quadrics, boxes, self.camera.K, s.robust_scale, s.robust_odometry)

    def give_to_bound(self, k: int, tracks: list[int], measurements: list[BoxMeasurement]) -> int:
        """Boxes of bound tracks become factors; returns how many."""
        used = 0
        T = self._graph.pose(k)
        for track, box in zip(tracks, measurements, strict=True):
            candidate = self._candidates[track]
            if candidate.landmark is None:
                continue
            corners = predicted_corners(T, self._graph.quadric(candidate.landmark), self.camera.K, box)
            fits = corners is not None and overlap(corners[None], box.corners[None])[0, 0] >= self.LEAST_FIT
            seen = any(n == k for n, _ in self._graph.landmarks[candidate.landmark].boxes[-2:])
            if fits and not seen:
                self._graph.add_box(k, candidate.landmark, box)
                self.classes[candidate.landmark] += candidate.classes
                candidate.classes.clear()
                candidate.misfits = 0
                used += 1
                continue
            self.counts["rejected_misfit"] += 1
            candidate.misfits += 1
            if candidate.misfits >= self.MAX_MISFITS and self.settings.association != GIVEN:
                self.counts["unbound"] += 1
                self._candidates[track] = Candidate(classes=candidate.classes)
        return used

    def vote(self, k: int, tracks: list[int], measurements: list[BoxMeasurement], step: Array) -> None:
        """Open tracks vote for the landmarks that explain their boxes."""
        if self.settings.association == GIVEN:
            return
        taken = {self._candidates[t].landmark for t in tracks}
        rows = [i for i, t in enumerate(tracks) if self._candidates[t].landmark is None]
        if not rows:
            return
        T = self._graph.pose(k)
        near = [
            j
            for j, landmark in self._graph.landmarks.items()
            if j not in taken and landmark.factors and self._in_question(T, j, [measurements[i] for i in rows])
        ]
        predictions = []
        for j, covariance in zip(near, self._graph.joint_covariances(k - 1, near), strict=True):
            covariance[:6, :6] += step
            box = measurements[rows[0]]
            prediction = predict(T, self._graph.quadric(j), covariance, self.camera.K, box, self.settings.model_error)
            if prediction is not None:
                predictions.append(Prediction(j, *prediction, self.class_of_quadric(j)))
        classes = [self._candidates[tracks[i]].classes.most_common(1)[0][0] for i in rows]
        cost = distances(predictions, [measurements[i] for i in rows], classes, self.settings)
        for p, r in assign(cost):
            track = tracks[rows[r]]
            self._vote_for(track, predictions[p].landmark)

    def _vote_for(self, track: int, landmark: int) -> None:
        decided = self._votes.add(track, landmark)
        if decided is not None and not self._seen_apart(self._candidates[track], decided):
            self._bind(track, decided)

    def relocalise(self, k: int, tracks: list[int], measurements: list[BoxMeasurement]) -> None:
        """Where the boxes show known objects from another pose than the predicted one, vote for those."""
        if self.settings.association == GIVEN or not any(self._recent(t, k) for t in tracks):
            return
        known = [j for j, landmark in self._graph.landmarks.items() if landmark.factors]
        if not known:
            return
        # A young quadric is what is in question: it may be an old one, seen from where the camera is not.
        old = np.array([k - self._graph.landmarks[j].born > self.YOUNG for j in known])
        classes = np.array([self.class_of_quadric(j) for j in known])
        compatible = np.stack([old & (classes == self._class_of(track)) for track in tracks])
        found = relocalise(
            self._graph.pose(k),
            measurements,
            np.stack([self._graph.quadric(j) for j in known]),
            compatible,
            self.camera.K,
            (self.camera.width, self.camera.height),
            self.settings.robust_scale,
            self.settings,
        )
        if found is None:
            return
        self.counts["relocalised"] += 1
        for n, m in found.pairs:
            bound = self._candidates[tracks[n]].landmark
            if bound is None:
                self._vote_for(tracks[n], known[m])
            elif bound != known[m] and self._votes.add(~bound, known[m]) == known[m]:
                self._same.append((bound, known[m]))

    def start_quadrics(self, tracks: list[int]) -> list[int]:
        added = []
        for track in tracks:
            candidate = self._candidates[track]
            if candidate.landmark is not None or len(candidate.boxes) < self.settings.min_boxes:
                continue
            poses = np.stack([self._graph.pose(k) for k, _ in candidate.boxes])
            boxes = [box for _, box in candidate.boxes]
            first = initialise(poses, boxes, self.camera.K, self.settings.robust_scale, self.settings)
            if first is None:
                continue
            known = self._known(first.vector, candidate)
            if known is not None:
                self._bind(track, known)
                continue
            j = self._next_quadric
            self._next_quadric += 1
            self._graph.add_quadric(j, first.vector)
            self._bind(track, j)
            added.append(j)
        return added

    def _known(self, vector: Array, candidate: Candidate) -> int | None:
        """The quadric that this one is, if the map has it."""
        if self.settings.association == GIVEN:
            return None
        best: int | None = None
        nearest = np.inf
        for j in self._graph.landmarks:
            other = self._graph.quadric(j)
            distance = math.dist(other[:3], vector[:3])
            if (
                distance < nearest
                and same_object(vector, other, self.settings.merge_distance)
                and self.classes[j].keys() & candidate.classes.keys()
                and not self._seen_apart(candidate, j)
            ):
                best, nearest = j, distance
        return best

    def merge(self) -> list[int]:
        """Quadrics that have become one object; the younger goes."""
        if self.settings.association == GIVEN:
            return []
        gone = []
        for j, known in self._same:
            if j in self._graph.landmarks and known in self._graph.landmarks:
                self._unite(j, known)
                gone.append(j)
        self._same.clear()
        for j in sorted(self._graph.landmarks, reverse=True):
            target = self._older_twin(j)
            if target is not None:
                self._unite(j, target)
                gone.append(j)
        return gone

    def _older_twin(self, j: int) -> int | None:
        """An older quadric that is the same object: of its place, size and class, and never seen beside it."""
        vector, boxes = self._graph.quadric(j), self._graph.landmarks[j].boxes
        for i in sorted(self._graph.landmarks):
            if i >= j:
                break
            if (
                same_object(vector, self._graph.quadric(i), self.settings.merge_distance)
                and self.class_of_quadric(i) == self.class_of_quadric(j)
                and not _apart(boxes, self._graph.landmarks[i].boxes)
            ):
                return i
        return None

    def note(self, report: UpdateReport) -> None:
        """Book what the graph took out: its tracks are open again."""
        self.counts["quadrics_removed"] += len(report.removed)
        self.counts["repairs"] += bool(report.repaired)
        for candidate in self._candidates.values():
            if candidate.landmark is not None and candidate.landmark not in self._graph.landmarks:
                candidate.landmark = None

    def _bind(self, track: int, landmark: int) -> None:
        """The track's boxes are of this quadric: those it has and those to come."""
        candidate = self._candidates[track]
        for k, box in candidate.boxes:
            self._graph.add_box(k, landmark, box)
        self.classes.setdefault(landmark, Counter()).update(candidate.classes)
        self._candidates[track] = Candidate(landmark=landmark)
        self._votes.forget(track)
        self.counts["bound"] += 1

    def _unite(self, j: int, target: int) -> None:
        """Quadric j is the same object as another, which gets its boxes."""
        boxes = list(self._graph.landmarks[j].boxes)
        self._graph.remove_quadric(j)
        seen = {k for k, _ in self._graph.landmarks[target].boxes}
        for k, box in boxes:
            if k not in seen:
                self._graph.add_box(k, target, box)
        self.classes[target] += self.classes.pop(j)
        for candidate in self._candidates.values():
            if candidate.landmark == j:
                candidate.landmark = target
        self.counts["merged"] += 1

    def _class_of(self, track: int) -> str:
        """The class most boxes of a track, or of the quadric it is bound to, carry."""
        candidate = self._candidates[track]
        if candidate.landmark is not None:
            return self.class_of_quadric(candidate.landmark)
        return candidate.classes.most_common(1)[0][0]

    def _recent(self, track: int, k: int) -> bool:
        """Whether a track is open, or bound to a young quadric."""
        landmark = self._candidates[track].landmark
        return landmark is None or k - self._graph.landmarks[landmark].born <= self.YOUNG

    def _in_question(self, T_map_camera: Array, j: int, boxes: list[BoxMeasurement]) -> bool:
        """Whether one of these boxes may be of a quadric: worth the cost of its joint covariance with the pose."""
        predicted = predicted_corners(T_map_camera, self._graph.quadric(j), self.camera.K, boxes[0])
        measured = np.stack([box.corners for box in boxes])
        return predicted is not None and bool(overlap(predicted[None], measured).max() >= self.settings.min_overlap)

    def _seen_apart(self, candidate: Candidate, landmark: int) -> bool:
        """Whether an image shows both the track and the landmark, as two boxes."""
        return _apart(candidate.boxes, self._graph.landmarks[landmark].boxes)


def _apart(a: list[tuple[int, BoxMeasurement]], b: list[tuple[int, BoxMeasurement]]) -> bool:
    """Whether two lists of boxes share more than a tenth of the keyframes of the shorter: then they are two objects."""
    frames_a, frames_b = {k for k, _ in a}, {k for k, _ in b}
    shared = len(frames_a & frames_b)
    return shared > 0.1 * min(len(frames_a), len(frames_b))
