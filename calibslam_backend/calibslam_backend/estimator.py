"""The estimator: boxes and odometry in, trajectory and quadrics out. Offline runs and the node share it.

For each image with boxes, once odometry reaches its time:
    link its boxes to tracks;
    where the camera has moved enough, make it a keyframe:
        predict its pose from odometry,
        give the boxes of bound tracks to their quadrics, gather votes for the others,
        start quadrics of tracks that determine one,
        update the graph, merge quadrics that turned out to be one object.
What comes out depends on the measurements only, not on when they arrive.
"""

from __future__ import annotations

import time
from bisect import insort
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from calibslam_backend.association import (
    GIVEN,
    AssociationSettings,
    Prediction,
    Votes,
    assign,
    distances,
    predict,
    same_object,
)
from calibslam_backend.box_measurement import BoxMeasurement, prepare, undistorted
from calibslam_backend.graph import GraphSettings, ObjectGraph
from calibslam_backend.initialisation import InitialisationSettings, initialise
from calibslam_backend.kernels import load_kernels
from calibslam_backend.localisation import localise
from calibslam_backend.noise import NoiseModel, NoiseSettings
from calibslam_backend.object_map import ObjectMap
from calibslam_backend.odometry import SECOND, MotionChain, MotionNoise
from calibslam_backend.quadric import Ellipsoid, covariance_of_pose_and_radii, covariance_of_vector
from calibslam_backend.relocalisation import RelocalisationSettings, relocalise
from calibslam_backend.tracking import Tracker, TrackingSettings, overlap, unique
from calibslam_msgs_py.measurements import (
    Array,
    Boxes,
    Camera,
    InvalidMeasurement,
    QuadricEstimate,
    RelativeMotion,
)
from calibslam_msgs_py.settings import Settings, setting


@dataclass(frozen=True)
class KeyframeSettings(Settings):
    keyframe_rotation: float = setting(0.15, "rotation that makes a keyframe", unit="rad", low=0.0)
    keyframe_translation: float = setting(0.15, "translation that makes a keyframe", unit="m", low=0.0)
    keyframe_interval: float = setting(1.0, "time that makes a keyframe", unit="s", low=0.0)


@dataclass(frozen=True)
class EstimatorSettings(
    NoiseSettings,
    AssociationSettings,
    KeyframeSettings,
    TrackingSettings,
    InitialisationSettings,
    RelocalisationSettings,
    GraphSettings,
    MotionNoise,
):
    """Everything that can be set of the back end."""


@dataclass(frozen=True)
class Keyframe:
    """What one keyframe brought.

    Attributes:
        index: its number, from 0.
        stamp: of its image [ns].
        T_map_camera: (4, 4) as known right after it.
        boxes: boxes that were given to quadrics.
        added, removed: ids of quadrics.
        repaired: what had to be repaired; "" if nothing.
        seconds: that it took.
    """

    index: int
    stamp: int
    T_map_camera: Array
    boxes: int
    added: list[int]
    removed: list[int]
    repaired: str
    seconds: float


@dataclass
class Candidate:
    """What is known of a track: its boxes in keyframes, its classes, the quadric it is bound to."""

    boxes: list[tuple[int, BoxMeasurement]] = field(default_factory=list)
    classes: Counter[str] = field(default_factory=Counter)
    landmark: int | None = None
    misfits: int = 0


class Estimator:
    """Incremental object SLAM of one camera."""

    # A bound track whose boxes miss their quadric so often in a row has slipped to another object.
    MAX_MISFITS = 3
    LEAST_FIT = 0.1  # overlap of a box with its quadric's that is no misfit
    YOUNG = 30  # keyframes during which a quadric may turn out to be one that was known before

    def __init__(self, camera: Camera, T_body_camera: Array, settings: EstimatorSettings) -> None:
        load_kernels()
        self.camera = camera
        self.settings = settings
        self._T_body_camera = T_body_camera
        self.reset()

    def reset(self) -> None:
        """Forget map and trajectory."""
        self.counts: Counter[str] = Counter()
        self.stamps: list[int] = []
        self._motions = MotionChain(self.settings, self._T_body_camera)
        self._tracker = Tracker(self.settings, self.camera.K)
        self._noise = NoiseModel(self.settings)
        self._votes = Votes(self.settings.votes)
        self._graph = ObjectGraph(self.camera.K, self.settings, self.settings)
        self._candidates: dict[int, Candidate] = {}
        self._given: dict[str, int] = {}
        self._classes: dict[int, Counter[str]] = {}  # of each quadric
        self._next_quadric = 0
        self._waiting: list[tuple[int, int, Boxes]] = []
        self._last_frame: int | None = None
        self._same: list[tuple[int, int]] = []  # quadrics found to be others; united after the update
        self.associations: list[tuple[int, str]] = []  # track and true identity of each box of a keyframe

    # -- measurements in ----------------------------------------------------------------------------------------

    def add(self, measurement: Boxes | RelativeMotion) -> list[Keyframe]:
        """`add_boxes` or `add_motion`."""
        if isinstance(measurement, Boxes):
            return self.add_boxes(measurement)
        return self.add_motion(measurement)

    def add_motion(self, motion: RelativeMotion) -> list[Keyframe]:
        """A motion of the body; returns the keyframes that became possible.

        Raises:
            InvalidMeasurement: see `MotionChain.add`; nothing is changed.
        """
        if not self._motions.add(motion):
            self.counts["odometry_gap"] += 1
        self.counts["motions"] += 1
        return self._process()

    def add_boxes(self, boxes: Boxes) -> list[Keyframe]:
        """The boxes of an image; returns the keyframes that became possible.

        Raises:
            InvalidMeasurement: "image_size", "late" or "duplicate"; nothing is changed.
        """
        if (boxes.width, boxes.height) != (self.camera.width, self.camera.height):
            raise InvalidMeasurement(
                "image_size",
                f"boxes of a {boxes.width}x{boxes.height} image, but the camera's is "
                f"{self.camera.width}x{self.camera.height}: do detector and camera_info belong together?",
            )
        if self._last_frame is not None and boxes.stamp <= self._last_frame:
            reason = "duplicate" if boxes.stamp == self._last_frame else "late"
            raise InvalidMeasurement(reason, f"boxes of {boxes.stamp} ns after those of {self._last_frame} ns")
        if any(stamp == boxes.stamp for stamp, _, _ in self._waiting):
            raise InvalidMeasurement("duplicate", f"boxes of {boxes.stamp} ns came twice")
        insort(self._waiting, (boxes.stamp, len(self._waiting), boxes), key=lambda entry: entry[0])
        self.counts["images"] += 1
        return self._process()

    @property
    def waiting(self) -> int:
        """Images for which odometry has not come yet."""
        return len(self._waiting)

    def finish(self, iterations: int = 10) -> None:
        """Relinearise until nothing moves any more: the best estimate of all that was seen."""
        if not self.stamps:
            return
        for _ in range(iterations):
            before = self._graph.poses()
            self._note(self._graph.update(everything=True))
            if np.abs(self._graph.poses() - before).max() < 1e-4:
                break

    # -- estimate out -------------------------------------------------------------------------------------------

    def pose(self, index: int) -> Array:
        """(4, 4) T_map_camera of a keyframe."""
        return self._graph.pose(index)

    def trajectory(self) -> Array:
        """(N, 4, 4) T_map_camera of all keyframes, at `stamps`."""
        return self._graph.poses()

    def odometry(self) -> tuple[Array, Array]:
        """The same keyframes by odometry alone: poses (N, 4, 4) and their covariances (N, 6, 6)."""
        return self._graph.odometry()

    def pose_covariance(self, index: int) -> Array:
        """(6, 6) [rotation, translation] of a keyframe in its camera frame."""
        return self._graph.pose_covariance(index)

    def object_map(self) -> ObjectMap:
        """Everything that is estimated, with covariances."""
        stamps = tuple(self.stamps)
        covariances = [self.pose_covariance(k) for k in range(len(stamps))]
        return ObjectMap(
            stamps,
            self.trajectory(),
            np.reshape(covariances, (-1, 6, 6)),
            tuple(self.quadrics()),
            self.camera.frame_id,
        )

    def quadrics(self) -> list[QuadricEstimate]:
        """The map."""
        result = []
        for j, covariance in self._graph.quadric_covariances().items():
            vector = self._graph.quadric(j)
            ellipsoid = Ellipsoid.from_vector(vector)
            result.append(
                QuadricEstimate(
                    j,
                    self._classes[j].most_common(1)[0][0],
                    ellipsoid.T_world_object,
                    ellipsoid.radii,
                    covariance_of_pose_and_radii(vector, covariance),
                    len(self._graph.landmarks[j].boxes),
                )
            )
        return result

    @property
    def objects(self) -> int:
        """Number of quadrics."""
        return len(self._graph.landmarks)

    @property
    def boxes_used(self) -> int:
        """Number of boxes that quadrics rest on."""
        return sum(len(landmark.boxes) for landmark in self._graph.landmarks.values())

    def quadric_of_track(self, track: int) -> int | None:
        """The quadric a track is bound to."""
        return self._candidates[track].landmark

    def body_pose(self) -> Array:
        """(4, 4) T_map_body of the newest keyframe."""
        return self.pose(len(self.stamps) - 1) @ np.linalg.inv(self._T_body_camera)

    def load(self, known: ObjectMap) -> None:
        """Forget everything and start in a known map, from the pose where that map was begun.

        Raises:
            ValueError: a quadric has no covariance.
        """
        for quadric in known.quadrics:
            if not np.isfinite(quadric.covariance).all():
                raise ValueError(f"quadric {quadric.id} of the map has no covariance")
        self.reset()
        for quadric in known.quadrics:
            vector = Ellipsoid(quadric.T_map_object, quadric.radii).vector()
            covariance = covariance_of_vector(quadric.T_map_object, quadric.radii, quadric.covariance)
            self._graph.add_known_quadric(quadric.id, vector, covariance)
            self._classes[quadric.id] = Counter({quadric.class_id: max(quadric.observations, 1)})
            self._next_quadric = max(self._next_quadric, quadric.id + 1)

    def optimise(self) -> None:
        """Move the whole graph to its batch optimum."""
        self._graph.optimise()

    # -- one image ----------------------------------------------------------------------------------------------

    def _process(self) -> list[Keyframe]:
        keyframes = []
        start, end = self._motions.start, self._motions.end
        while self._waiting and end is not None and start is not None and self._waiting[0][0] <= end:
            _, _, boxes = self._waiting.pop(0)
            if boxes.stamp < start:
                self.counts["rejected_before_odometry"] += 1
                continue
            keyframe = self._image(boxes)
            if keyframe is not None:
                keyframes.append(keyframe)
        return keyframes

    def _image(self, boxes: Boxes) -> Keyframe | None:
        began = time.perf_counter()
        turned = np.eye(3)
        if self._last_frame is not None:
            turned = self._motions.between(self._last_frame, boxes.stamp)[0][:3, :3].T
        self._last_frame = boxes.stamp
        boxes, tracks = self._tracks(boxes, turned)
        motion, covariance = np.eye(4), np.eye(6)
        if self.stamps:
            motion, covariance = self._motions.between(self.stamps[-1], boxes.stamp)
            if not self._moved(motion, boxes.stamp - self.stamps[-1]):
                return None
        return self._keyframe(boxes, tracks, motion, covariance, began)

    def _tracks(self, boxes: Boxes, R_now_before: Array) -> tuple[Boxes, list[int]]:
        """The boxes that belong to a track, and the number of that track."""
        if self.settings.association == GIVEN:
            known = np.array([i for i, name in enumerate(boxes.object_ids) if name], dtype=int)
            self.counts["rejected_no_identity"] += len(boxes) - len(known)
            boxes = select(boxes, known)
            tracks = [self._given.setdefault(name, len(self._given)) for name in boxes.object_ids]
        else:
            kept = unique(boxes.corners, boxes.scores, self.settings.duplicate_overlap)
            self.counts["rejected_double_box"] += len(boxes) - len(kept)
            boxes = select(boxes, kept)
            corners = undistorted(boxes.corners, self.camera)
            linked = self._tracker.update(boxes.stamp, corners, boxes.class_ids, R_now_before)
            tracks = [track.id for track in linked]
        for track, class_id in zip(tracks, boxes.class_ids, strict=True):
            candidate = self._candidates.setdefault(track, Candidate())
            candidate.classes[class_id] += 1
        return boxes, tracks

    def _moved(self, motion: Array, duration: int) -> bool:
        s = self.settings
        rotation = float(np.linalg.norm(Rotation.from_matrix(motion[:3, :3]).as_rotvec()))
        translation = float(np.linalg.norm(motion[:3, 3]))
        return (
            rotation / max(s.keyframe_rotation, 1e-9) + translation / max(s.keyframe_translation, 1e-9) >= 1.0
            or duration >= s.keyframe_interval * SECOND
        )

    def _keyframe(self, boxes: Boxes, tracks: list[int], motion: Array, covariance: Array, began: float) -> Keyframe:
        measurements = self._measurements(boxes, tracks)
        k = len(self.stamps)
        if k:
            guess = self._localise(tracks, measurements, self._graph.pose(k - 1) @ motion, covariance)
            self._graph.add_pose(motion, covariance, guess)
        else:
            self._graph.add_origin()
        self.stamps.append(boxes.stamp)
        self._motions.forget_before(boxes.stamp)
        used = self._give_to_bound(k, tracks, measurements)
        if k:
            self._vote(k, tracks, measurements, covariance)
            self._relocalise(k, tracks, measurements)
        for track, box in zip(tracks, measurements, strict=True):
            candidate = self._candidates[track]
            if candidate.landmark is None:
                candidate.boxes.append((k, box))
        added = self._start_quadrics(tracks)
        report = self._graph.update()
        self._note(report)
        removed = report.removed + self._merge()
        self.associations += list(zip(tracks, boxes.object_ids, strict=True))
        return Keyframe(
            k,
            boxes.stamp,
            self._graph.pose(k),
            used,
            added,
            removed,
            report.repaired,
            time.perf_counter() - began,
        )

    def _measurements(self, boxes: Boxes, tracks: list[int]) -> list[BoxMeasurement]:
        covariances = np.empty((len(boxes), 4, 4))
        for i, track in enumerate(tracks):
            landmark = self._candidates[track].landmark
            key = ~track if landmark is None else landmark
            self._noise.observe(key, boxes.corners[i])
            covariances[i] = self._noise.covariance(key, boxes.covariances[i])
        return prepare(boxes, covariances, self.camera)

    def _localise(
        self, tracks: list[int], measurements: list[BoxMeasurement], predicted: Array, covariance: Array
    ) -> Array:
        """First estimate of the pose, from odometry and the boxes of bound tracks."""
        bound = [(self._candidates[t].landmark, box) for t, box in zip(tracks, measurements, strict=True)]
        known = [(self._graph.quadric(j), box) for j, box in bound if j is not None]
        s = self.settings
        quadrics, boxes = [vector for vector, _ in known], [box for _, box in known]
        return localise(predicted, covariance, quadrics, boxes, self.camera.K, s.robust_scale, s.robust_odometry)

    def _give_to_bound(self, k: int, tracks: list[int], measurements: list[BoxMeasurement]) -> int:
        """Boxes of bound tracks become factors; returns how many."""
        used = 0
        T = self._graph.pose(k)
        for track, box in zip(tracks, measurements, strict=True):
            candidate = self._candidates[track]
            if candidate.landmark is None:
                continue
            prediction = predict(
                T, self._graph.quadric(candidate.landmark), np.zeros((15, 15)), self.camera.K, box, 0.0
            )
            fits = prediction is not None and (overlap(prediction[0][None], box.corners[None])[0, 0] >= self.LEAST_FIT)
            seen = any(n == k for n, _ in self._graph.landmarks[candidate.landmark].boxes[-2:])
            if fits and not seen:
                self._graph.add_box(k, candidate.landmark, box)
                self._classes[candidate.landmark] += candidate.classes
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

    def _vote(self, k: int, tracks: list[int], measurements: list[BoxMeasurement], step: Array) -> None:
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
            if j not in taken and landmark.factors and self._near(T, j, [measurements[i] for i in rows])
        ]
        predictions = []
        for j, covariance in zip(near, self._graph.joint_covariances(k - 1, near), strict=True):
            covariance[:6, :6] += step
            box = measurements[rows[0]]
            prediction = predict(T, self._graph.quadric(j), covariance, self.camera.K, box, self.settings.model_error)
            if prediction is not None:
                predictions.append(Prediction(j, *prediction, self._classes[j].most_common(1)[0][0]))
        classes = [self._candidates[tracks[i]].classes.most_common(1)[0][0] for i in rows]
        cost = distances(predictions, [measurements[i] for i in rows], classes, self.settings)
        for p, r in assign(cost):
            track = tracks[rows[r]]
            self._vote_for(track, predictions[p].landmark)

    def _vote_for(self, track: int, landmark: int) -> None:
        decided = self._votes.add(track, landmark)
        if decided is not None and not self._seen_apart(self._candidates[track], decided):
            self._bind(track, decided)

    def _relocalise(self, k: int, tracks: list[int], measurements: list[BoxMeasurement]) -> None:
        """Where the boxes show known objects from another pose than the predicted one, vote for those."""
        if self.settings.association == GIVEN or not any(self._recent(t, k) for t in tracks):
            return
        known = [j for j, landmark in self._graph.landmarks.items() if landmark.factors]
        if not known:
            return
        classes = [self._class_of(t) for t in tracks]
        compatible = np.array([[self._classes[j].most_common(1)[0][0] == c for j in known] for c in classes])
        # A young quadric is what is in question: it may be an old one, seen from where the camera is not.
        for m, j in enumerate(known):
            if k - self._graph.landmarks[j].born <= self.YOUNG:
                compatible[:, m] = False
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

    def _class_of(self, track: int) -> str:
        """The class most boxes of a track, or of the quadric it is bound to, carry."""
        candidate = self._candidates[track]
        classes = candidate.classes if candidate.landmark is None else self._classes[candidate.landmark]
        return classes.most_common(1)[0][0]

    def _recent(self, track: int, k: int) -> bool:
        """Whether a track is open, or bound to a young quadric."""
        landmark = self._candidates[track].landmark
        return landmark is None or k - self._graph.landmarks[landmark].born <= self.YOUNG

    def _near(self, T_map_camera: Array, j: int, boxes: list[BoxMeasurement]) -> bool:
        """Whether the box a quadric predicts comes within its own size of one of these boxes."""
        prediction = predict(T_map_camera, self._graph.quadric(j), np.zeros((15, 15)), self.camera.K, boxes[0], 0.0)
        if prediction is None:
            return False
        corners = prediction[0]
        size = np.tile(corners[2:] - corners[:2], 2)
        grown = corners + np.array([-1.0, -1.0, 1.0, 1.0]) * size
        return bool(overlap(grown[None], np.stack([box.corners for box in boxes])).max() > 0.0)

    def _bind(self, track: int, landmark: int) -> None:
        """The track's boxes are of this quadric: those it has and those to come."""
        candidate = self._candidates[track]
        for k, box in candidate.boxes:
            self._graph.add_box(k, landmark, box)
        self._classes.setdefault(landmark, Counter()).update(candidate.classes)
        self._candidates[track] = Candidate(landmark=landmark)
        self._votes.forget(track)
        self.counts["bound"] += 1

    def _start_quadrics(self, tracks: list[int]) -> list[int]:
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
            known = self._known(Ellipsoid.from_vector(first.vector), candidate)
            if known is not None:
                self._bind(track, known)
                continue
            j = self._next_quadric
            self._next_quadric += 1
            self._graph.add_quadric(j, first.vector)
            self._bind(track, j)
            added.append(j)
        return added

    def _known(self, ellipsoid: Ellipsoid, candidate: Candidate) -> int | None:
        """The quadric that this ellipsoid is, if the map has it."""
        if self.settings.association == GIVEN:
            return None
        best, nearest = None, np.inf
        for j in self._graph.landmarks:
            other = Ellipsoid.from_vector(self._graph.quadric(j))
            distance = float(np.linalg.norm(other.T_world_object[:3, 3] - ellipsoid.T_world_object[:3, 3]))
            if (
                distance < nearest
                and same_object(ellipsoid, other, self.settings.merge_distance)
                and self._classes[j].keys() & candidate.classes.keys()
                and not self._seen_apart(candidate, j)
            ):
                best, nearest = j, distance
        return best

    def _seen_apart(self, candidate: Candidate, landmark: int) -> bool:
        """Whether an image shows both the track and the landmark, as two boxes."""
        return _apart(candidate.boxes, self._graph.landmarks[landmark].boxes)

    def _merge(self) -> list[int]:
        """Quadrics that have become one object; the younger goes."""
        if self.settings.association == GIVEN:
            return []
        gone = []
        for j, target in self._same:
            if j in self._graph.landmarks and target in self._graph.landmarks:
                self._unite(j, target)
                gone.append(j)
        self._same.clear()
        for j in sorted(self._graph.landmarks, reverse=True):
            ellipsoid = Ellipsoid.from_vector(self._graph.quadric(j))
            boxes = list(self._graph.landmarks[j].boxes)
            older = Candidate(boxes, self._classes[j])
            target = None
            for i in sorted(self._graph.landmarks):
                if i >= j:
                    break
                other = Ellipsoid.from_vector(self._graph.quadric(i))
                if (
                    same_object(ellipsoid, other, self.settings.merge_distance)
                    and self._classes[i].most_common(1)[0][0] == self._classes[j].most_common(1)[0][0]
                    and not self._seen_apart(older, i)
                ):
                    target = i
                    break
            if target is None:
                continue
            self._unite(j, target)
            gone.append(j)
        return gone

    def _unite(self, j: int, target: int) -> None:
        """Quadric j is the same object as another, which gets its boxes."""
        boxes = list(self._graph.landmarks[j].boxes)
        self._graph.remove_quadric(j)
        seen = {k for k, _ in self._graph.landmarks[target].boxes}
        for k, box in boxes:
            if k not in seen:
                self._graph.add_box(k, target, box)
        self._classes[target] += self._classes.pop(j)
        for candidate in self._candidates.values():
            if candidate.landmark == j:
                candidate.landmark = target
        self.counts["merged"] += 1

    def _note(self, report: object) -> None:
        """Book what the graph took out: its tracks are open again."""
        removed = getattr(report, "removed", [])
        self.counts["quadrics_removed"] += len(removed)
        self.counts["repairs"] += bool(getattr(report, "repaired", ""))
        for candidate in self._candidates.values():
            if candidate.landmark is not None and candidate.landmark not in self._graph.landmarks:
                candidate.landmark = None


def select(boxes: Boxes, indices: Array) -> Boxes:
    """The boxes with these indices."""
    return Boxes(
        boxes.stamp,
        boxes.width,
        boxes.height,
        boxes.corners[indices],
        boxes.covariances[indices],
        tuple(boxes.class_ids[i] for i in indices),
        boxes.scores[indices],
        tuple(boxes.object_ids[i] for i in indices),
        boxes.frame_id,
    )


def _apart(a: list[tuple[int, BoxMeasurement]], b: list[tuple[int, BoxMeasurement]]) -> bool:
    """Whether two lists of boxes share more than a tenth of the keyframes of the shorter: then they are two objects."""
    frames_a, frames_b = {k for k, _ in a}, {k for k, _ in b}
    shared = len(frames_a & frames_b)
    return shared > 0.1 * min(len(frames_a), len(frames_b))
