"""Which quadric of the map a track is of.

A track is open until it is bound to a quadric, which happens when several keyframes agree on one (`vote`,
`relocalise`) or when its own boxes determine a new one (`new_quadrics`). What turns out to be wrong is mended in
`upkeep`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from calibslam_backend.association.assignments import Assignments, Frame
from calibslam_backend.association.innovation import innovations
from calibslam_backend.association.localisation import localise
from calibslam_backend.association.matching import (
    GIVEN,
    AssociationSettings,
    Prediction,
    Votes,
    assign,
    distances,
    predict,
    predicted_corners,
    unambiguous,
)
from calibslam_backend.association.relocalisation import Relocalised, relocalise
from calibslam_backend.association.tracking import overlap
from calibslam_backend.estimator_settings import EstimatorSettings
from calibslam_backend.geometry.box_measurement import BoxMeasurement, cut_alike, prepare, undistorted
from calibslam_backend.graph.measured import Motion
from calibslam_backend.graph.noise import QUADRICSLAM, box_covariance, spread
from calibslam_backend.graph.object_graph import ObjectGraph, UpdateReport
from calibslam_msgs_py.measurements import Array, Boxes, Camera


class DataAssociation:
    """Decides for the boxes of the newest keyframe; gives the graph its quadrics and boxes.

    Attributes:
        counts: what happened, by name; shared with the estimator.
    """

    # A bound track whose boxes miss their quadric so often in a row has slipped to another object.
    MAX_MISFITS = 3
    LEAST_FIT = 0.1  # overlap of a box with its quadric's that is no misfit
    # Standard deviations that a camera can be from where it is thought to be. They are too small on real data, by a
    # factor of about four; rows of like objects, seen from the other side of the room, are 70 and more away.
    FARTHEST = 20.0

    def __init__(
        self, assignments: Assignments, camera: Camera, settings: EstimatorSettings, counts: Counter[str]
    ) -> None:
        self.camera, self.settings, self.counts = camera, settings, counts
        self._assignments = assignments
        self._graph: ObjectGraph = assignments.graph
        self._anywhere = replace(settings, min_overlap=0.0)  # boxes need not lie where they are expected
        self._votes = Votes(settings.votes)
        # (bound quadric, the one that it was found to be) -> tracks of which it was found.
        self._taken_for: dict[tuple[int, int], set[int]] = {}

    def frame(self, boxes: Boxes, tracks: list[int]) -> Frame:
        """The boxes of an image made ready, with the covariances the noise model gives them."""
        covariances = np.empty((len(boxes), 4, 4))
        for i, so_far in enumerate(self._so_far(boxes, tracks)):
            covariances[i] = box_covariance(self.settings, boxes.covariances[i], so_far)
        measurements = prepare(boxes, covariances, self.camera)
        return Frame(measurements, tracks, boxes.class_ids, boxes.object_ids, [None] * len(boxes))

    def _so_far(self, boxes: Boxes, tracks: list[int]) -> list[list[Array]]:
        """For each box those (4,) of its object that were seen, itself included; none where no noise model asks."""
        if self.settings.noise_model != QUADRICSLAM:  # there may be thousands
            return [[] for _ in tracks]
        now = undistorted(boxes.corners, self.camera)
        before = [[box.corners for box in self._assignments.boxes_of_object(track)] for track in tracks]
        return [[*seen, corners] for seen, corners in zip(before, now, strict=True)]

    # -- a keyframe ---------------------------------------------------------------------------------------------

    def localise(self, frame: Frame, predicted: Array, covariance: Array) -> Array:
        """First estimate of the pose, from odometry and the boxes of bound tracks."""
        known = [(self._graph.quadric(j), box) for j, box in self._assignments.bound(frame)]
        s = self.settings
        quadrics, boxes = [vector for vector, _ in known], [box for _, box in known]
        scales = s.robust_scale, s.robust_odometry
        return localise(predicted, covariance, quadrics, boxes, self.camera.K, *scales, self._graph.correlation.worth)

    def innovations(self, frame: Frame, predicted: Array, motion: Motion) -> Array:
        """Normalised innovations squared of the boxes of bound tracks, after a motion to a predicted pose (4, 4)."""
        known = [(j, box) for j, box in self._assignments.bound(frame) if self._graph.is_solved(j)]
        ids = sorted({j for j, _ in known})
        joint = self._covariances_after(len(self._assignments.frames) - 1, ids, motion)
        vectors, boxes = [self._graph.quadric(j) for j, _ in known], [box for _, box in known]
        return innovations(predicted, vectors, [joint[j] for j, _ in known], boxes, self.camera.K)

    def _covariances_after(self, k: int, quadrics: list[int], motion: Motion) -> dict[int, Array]:
        """For each of these quadrics (15, 15) of the pose to which a motion leads from keyframe k, and of it."""
        joint = self._graph.joint_covariances(k, quadrics)
        return {j: motion.carried(covariance) for j, covariance in joint.items()}

    def add(self, frame: Frame) -> int:
        """The boxes of the newest keyframe; those of bound tracks go to their quadrics. Returns how many."""
        k = len(self._assignments.frames)
        self._assignments.frames.append(frame)
        used = 0
        T = self._graph.pose(k)
        for n, (track, box) in enumerate(zip(frame.tracks, frame.boxes, strict=True)):
            candidate = self._assignments.tracks[track]
            candidate.seen.append((k, n))
            if candidate.quadric is None:
                continue
            corners = predicted_corners(T, self._graph.quadric(candidate.quadric), self.camera.K, box)
            # Identities that are given are no matter of where the camera is thought to be.
            fits = corners is not None and (
                self.settings.association == GIVEN or overlap(corners[None], box.corners[None])[0, 0] >= self.LEAST_FIT
            )
            if fits and self._assignments.give(k, n, candidate.quadric):
                candidate.misfits = 0
                used += 1
                continue
            self.counts["rejected_misfit"] += 1
            candidate.misfits += 1
            if candidate.misfits >= self.MAX_MISFITS and self.settings.association != GIVEN:
                self.counts["unbound"] += 1
                candidate.quadric, candidate.misfits = None, 0
        return used

    # -- quadrics that are known --------------------------------------------------------------------------------

    def vote(self, k: int, motion: Motion) -> None:
        """Open tracks of keyframe k, to which a motion led from the last one, vote for the quadrics that explain their
        boxes."""
        if self.settings.association == GIVEN:
            return
        tracks, frame = self._assignments.tracks, self._assignments.frames[k]
        taken = {tracks[t].quadric for t in frame.tracks}
        rows = [n for n, t in enumerate(frame.tracks) if tracks[t].quadric is None]
        if not rows:
            return
        T = self._graph.pose(k)
        open_boxes = [frame.boxes[n] for n in rows]
        free = [j for j in self._graph.landmarks if j not in taken and self._graph.is_solved(j)]
        covariances = self._covariances_after(k - 1, self._in_question(T, free, open_boxes), motion)
        classes = [tracks[frame.tracks[n]].class_id for n in rows]
        for r, j in self._matched(T, covariances, open_boxes, classes, self.settings):
            self._vote_for(frame.tracks[rows[r]], j)

    def give_open(self, k: int) -> int:
        """Open boxes of keyframe k go to the quadrics of their class that explain them, as far off as the pose may be.

        Where odometry has failed, boxes may lie beside the quadrics that they are of, and without them the pose stays
        where it is. Whoever judges boxes with poses as they are estimated gives them to nobody (see `revision`).

        Returns:
            How many.
        """
        if self.settings.association == GIVEN:
            return 0
        books, frame = self._assignments, self._assignments.frames[k]
        rows = [n for n, j in enumerate(frame.quadrics) if j is None]
        classes = [frame.classes[n] for n in rows]
        free = [
            j
            for j in self._graph.landmarks
            if self._graph.is_solved(j) and j not in frame.quadrics and books.class_of_quadric(j) in classes
        ]
        if not free:
            return 0
        covariances = self._graph.joint_covariances(k, free)
        boxes = [frame.boxes[n] for n in rows]
        found = self._matched(self._graph.pose(k), covariances, boxes, classes, self._anywhere)
        for r, j in found:
            books.give(k, rows[r], j)
            books.rebind(frame.tracks[rows[r]], self.settings.votes)
        self.counts["given_late"] += len(found)
        return len(found)

    def _matched(
        self,
        T_map_camera: Array,
        covariances: dict[int, Array],
        boxes: list[BoxMeasurement],
        classes: list[str],
        settings: AssociationSettings,
    ) -> list[tuple[int, int]]:
        """Of these boxes, with classes, and the quadrics of these covariances (15, 15) with the pose, those pairs
        (index of the box, id of the quadric) that leave no doubt."""
        ids = list(covariances)
        cost = np.full((len(ids), len(boxes)), np.inf)
        for columns in cut_alike(boxes):
            some, of_class = [boxes[n] for n in columns], [classes[n] for n in columns]
            predictions = [self._prediction(T_map_camera, j, covariances[j], some[0], settings) for j in ids]
            cost[:, columns] = distances(predictions, some, of_class, settings)
        return [(r, ids[m]) for m, r in unambiguous(cost, assign(cost), settings.ambiguity)]

    def _prediction(
        self, T_map_camera: Array, j: int, covariance: Array, box: BoxMeasurement, settings: AssociationSettings
    ) -> Prediction | None:
        """What quadric j, of this covariance (15, 15) with the pose, predicts for a box cut as this one."""
        found = predict(T_map_camera, self._graph.quadric(j), covariance, self.camera.K, box, settings.model_error)
        return found and Prediction(*found, self._assignments.class_of_quadric(j))

    def _in_question(self, T_map_camera: Array, quadrics: list[int], boxes: list[BoxMeasurement]) -> list[int]:
        """Those quadrics that one of these boxes may be of: worth the cost of a joint covariance with the pose."""
        alike = [(boxes[columns[0]], np.stack([boxes[n].corners for n in columns])) for columns in cut_alike(boxes)]

        def may_be(j: int, box: BoxMeasurement, measured: Array) -> bool:
            predicted = predicted_corners(T_map_camera, self._graph.quadric(j), self.camera.K, box)
            return predicted is not None and bool(overlap(predicted[None], measured).max() >= self.settings.min_overlap)

        return [j for j in quadrics if any(may_be(j, *group) for group in alike)]

    def _vote_for(self, track: int, landmark: int) -> None:
        decided = self._votes.add(track, landmark)
        if decided is not None and not self._assignments.seen_apart(self._assignments.tracks[track], decided):
            self.bind(track, decided)

    def bind(self, track: int, j: int) -> None:
        """The track is of this quadric."""
        self._assignments.bind(track, j)
        self._votes.forget(track)
        self.counts["bound"] += 1

    # -- quadrics found again -----------------------------------------------------------------------------------

    def find(self, frame: Frame) -> Relocalised | None:
        """Where in a loaded map a camera with these boxes is."""
        return self._relocalised(frame, None, list(self._graph.landmarks))

    def bind_found(self, frame: Frame, found: Relocalised) -> None:
        """The boxes of the keyframe where the camera was found belong to the quadrics that it was found by."""
        for n, j in found.pairs:
            self.bind(frame.tracks[n], j)

    def relocalise(self, k: int) -> None:
        """Where the boxes show known objects from another pose than the predicted one, vote for those."""
        frame = self._assignments.frames[k]
        if self.settings.association == GIVEN or not any(self._is_recent(t) for t in frame.tracks):
            return
        # A young quadric is what is in question: it may be an old one, seen from where the camera is not.
        old = [
            j
            for j in self._graph.landmarks
            if self._graph.is_solved(j) and self._assignments.age(j) > self._assignments.YOUNG
        ]
        found = self._relocalised(frame, k, old)
        if found is None:
            return
        self.counts["relocalised"] += 1
        moved: dict[int, int] = {}
        for n, j in found.pairs:
            track = frame.tracks[n]
            bound = self._assignments.tracks[track].quadric
            if bound is None:
                self._vote_for(track, j)
            elif bound != j:
                self._taken_for.setdefault((bound, j), set()).add(track)
                if self._votes.add(~bound, j) == j:
                    moved.update(self._mended(bound, j))
        self._assignments.move(moved)
        self.counts["moved"] += len(moved)

    def _mended(self, bound: int, j: int) -> dict[int, int]:
        """Tracks that are bound to one quadric and are of another: both are to be united, if images do not show both;
        otherwise it was these tracks that were bound wrongly, as to the next bottle of a row, and they go to the
        other."""
        if not self._assignments.seen_beside(bound, j):
            self._assignments.same.append((bound, j))
            return {}
        tracks = sorted(self._taken_for.pop((bound, j)))
        self._votes.forget(~bound)
        return {track: j for track in tracks if self._assignments.tracks[track].quadric == bound}

    def _is_recent(self, track: int) -> bool:
        """Whether a track is open, or bound to a young quadric."""
        quadric = self._assignments.tracks[track].quadric
        return quadric is None or self._assignments.age(quadric) <= self._assignments.YOUNG

    def _relocalised(self, frame: Frame, k: int | None, known: list[int]) -> Relocalised | None:
        """A better pose of keyframe k by these quadrics, or, if it is None, a pose of which nothing is known.

        Its pairs are (row, id of the quadric).
        """
        if not known:
            return None

        def is_plausible(T_map_camera: Array) -> bool:
            return k is None or self._graph.distance(k, T_map_camera) < self.FARTHEST

        classes = np.array([self._assignments.class_of_quadric(j) for j in known])
        wanted = [self._assignments.class_of_track(track) for track in frame.tracks]
        found = relocalise(
            None if k is None else self._graph.pose(k),
            frame.boxes,
            np.stack([self._graph.quadric(j) for j in known]),
            np.reshape([classes == class_id for class_id in wanted], (-1, len(known))),
            self.camera.K,
            (self.camera.width, self.camera.height),
            self.settings.robust_scale,
            self.settings,
            is_plausible,
        )
        return found and replace(found, pairs=[(n, known[m]) for n, m in found.pairs])

    # -- the graph ----------------------------------------------------------------------------------------------

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
        for j in [j for j in self._assignments.classes if j not in self._graph.landmarks]:
            self.counts["quadrics_removed"] += 1
            self._assignments.forget(j)
