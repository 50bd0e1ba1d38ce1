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
from collections import Counter
from collections.abc import Callable, Set

import gtsam
import numpy as np

from calibslam_backend.association.assignments import Assignments
from calibslam_backend.association.data_association import DataAssociation
from calibslam_backend.association.map_search import MapSearch
from calibslam_backend.association.matching import GIVEN
from calibslam_backend.association.relocalisation import FOUND, Relocalised
from calibslam_backend.association.tracking import Tracker, unique
from calibslam_backend.estimator_settings import EstimatorSettings
from calibslam_backend.geometry.box_measurement import undistorted
from calibslam_backend.geometry.ellipsoid import Ellipsoid, covariance_of_pose_and_radii, covariance_of_vector
from calibslam_backend.graph.known import Known
from calibslam_backend.graph.measured import Motion
from calibslam_backend.graph.noise import QUADRICSLAM
from calibslam_backend.graph.object_graph import ObjectGraph, UpdateReport
from calibslam_backend.graph.published import PublishedCovariances
from calibslam_backend.kernels import load_kernels
from calibslam_backend.keyframe import Keyframe
from calibslam_backend.objects.new_quadrics import NewQuadrics
from calibslam_backend.objects.upkeep import Upkeep
from calibslam_backend.odometry.motion_chain import MotionChain
from calibslam_backend.odometry.waiting_images import WaitingImages
from calibslam_backend.output.object_map import MotionCovariances, ObjectMap
from calibslam_msgs_py.measurements import (
    SECOND,
    Array,
    Boxes,
    Camera,
    InvalidMeasurement,
    QuadricEstimate,
    RelativeMotion,
)


class Estimator:
    """Incremental object SLAM of one camera."""

    START_ERROR = 1.0  # [rad, m] of a start pose that is given
    NIS_EVERY = 10  # keyframes, since it takes about as long as half an update's votes
    SETTLE_EVERY = 2  # keyframes
    # At the end: rounds of association and optimisation, and when poses [rad, m] count as settled.
    ROUNDS, ITERATIONS_OF_A_ROUND, ITERATIONS, CONVERGED = 5, 2, 10, 5e-3

    SPANS, MOTIONS = (1, 3, 10, 30), 100  # keyframes that motions span whose covariances are told, and how many of each

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
        self._graph = ObjectGraph(self.camera.K, self.settings, self.settings, self.settings)
        self._covariances = PublishedCovariances(self._graph)
        self._assignments = Assignments(self._graph)
        self._objects = DataAssociation(self._assignments, self.camera, self.settings, self.counts)
        self._new = NewQuadrics(self._assignments, self.camera, self.settings, self._objects.bind, self.counts)
        self._upkeep = Upkeep(self._assignments, self.camera, self.settings, self.counts)
        self._known: Set[int] = set()  # quadrics after the last keyframe
        self._repairs: list[str] = []
        self._between = 0.0
        self._chores: list[Callable[[], object]] = []
        self._search = MapSearch(self._objects, self._motions)
        self._given: dict[str, int] = {}
        self._waiting = WaitingImages(self.camera)
        self._last_frame: int | None = None

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
        problem = self._motions.add(motion)
        if problem:
            self.counts[problem] += 1
        self.counts["motions"] += 1
        return self._process()

    def add_boxes(self, boxes: Boxes) -> list[Keyframe]:
        """The boxes of an image; returns the keyframes that became possible.

        Raises:
            InvalidMeasurement: see `WaitingImages.add`; nothing is changed.
        """
        self._waiting.add(boxes, self._last_frame)
        self.counts["images"] += 1
        return self._process()

    @property
    def waiting(self) -> int:
        """Images for which odometry has not come yet."""
        return len(self._waiting)

    def limit_waiting(self, limit: int) -> int:
        """Leave out the latest images that wait for odometry beyond so many; returns how many."""
        return self._waiting.limit(limit)

    def finish(self) -> None:
        """Associate and relinearise until nothing changes any more: the best estimate of all that was seen."""
        if not self.stamps:
            return
        for left in reversed(range(self.ROUNDS)):
            changed = self._upkeep.revise()
            if left:  # what is given here is judged in the next round
                changed += sum(self._objects.give_open(k) for k in range(len(self.stamps)))
            self._new.start_leftovers()
            self._converge(self.ITERATIONS_OF_A_ROUND)
            self._upkeep.merge()
            if not changed:
                break
        self._converge(self.ITERATIONS)

    def _converge(self, iterations: int) -> None:
        for _ in range(iterations):
            before = self._graph.poses()
            self._note(self._graph.iterate())
            if np.abs(self._graph.poses() - before).max() < self.CONVERGED:
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
        return self._covariances.pose(index)

    def motion_covariances(self) -> MotionCovariances:
        """Of motions over as many keyframes as `SPANS` says, of each at most `MOTIONS` that are evenly spread."""
        count = len(self.stamps)
        pairs = [
            (first, first + span)
            for span in self.SPANS
            if span < count
            for first in np.unique(np.linspace(0, count - span - 1, self.MOTIONS).astype(int)).tolist()
        ]
        first, last = np.array(pairs, dtype=int).reshape(-1, 2).T
        covariances = [self._covariances.motion(*pair) for pair in pairs]
        return MotionCovariances(first, last, np.reshape(covariances, (-1, 6, 6)))

    def object_map(self) -> ObjectMap:
        """Everything that is estimated, with covariances."""
        stamps = tuple(self.stamps)
        covariances = [self.pose_covariance(k) for k in range(len(stamps))]
        return ObjectMap(
            stamps,
            self.trajectory(),
            np.reshape(covariances, (-1, 6, 6)),
            self.quadrics(),
            self.camera.frame_id,
            self._covariances.known(),
        )

    def quadrics(self) -> tuple[QuadricEstimate, ...]:
        """The map."""
        result = []
        for j, covariance in self._covariances.quadrics().items():
            vector = self._graph.quadric(j)
            ellipsoid = Ellipsoid.from_vector(vector)
            result.append(
                QuadricEstimate(
                    j,
                    self._assignments.class_of_quadric(j),
                    ellipsoid.T_world_object,
                    ellipsoid.radii,
                    covariance_of_pose_and_radii(vector, covariance),
                    len(self._graph.landmarks[j].boxes),
                )
            )
        return tuple(result)

    @property
    def objects(self) -> int:
        """Number of quadrics."""
        return len(self._graph.landmarks)

    @property
    def boxes_used(self) -> int:
        """Number of boxes that quadrics rest on."""
        return sum(len(landmark.boxes) for landmark in self._graph.landmarks.values())

    @property
    def box_correlation(self) -> float:
        """Of the errors of an object's boxes in consecutive keyframes, as far as residuals show it."""
        return self._graph.correlation.correlation

    def body_pose(self) -> Array:
        """(4, 4) T_map_body of the newest keyframe."""
        return self.pose(len(self.stamps) - 1) @ np.linalg.inv(self._T_body_camera)

    def load(self, known: ObjectMap) -> None:
        """Forget everything and start in a known map.

        By setting the camera is then where that map was begun, or it is found by the objects it sees: nothing is
        estimated until two images, at least `MapSearch.SIGHTINGS_APART` apart, agree on where it is.

        Raises:
            ValueError: a quadric has no covariance that it could begin with, its id is there twice, or priors do not
                fit each other; nothing is changed.
        """
        quadrics = {quadric.id: quadric for quadric in known.quadrics}
        if len(quadrics) < len(known.quadrics):
            raise ValueError("two quadrics of the map have the same id")
        if known.prior.quadrics.keys() - quadrics:
            raise ValueError("the prior of the map knows quadrics that the map does not have")
        known.prior.check()
        alone = {j: _known_alone(quadric) for j, quadric in quadrics.items() if j not in known.prior.quadrics}
        self.reset()
        if quadrics:
            self._graph.frame = known.prior.frame
        if quadrics and self.settings.start_in_map == FOUND:
            self._search.search()
        for j, prior in {**known.prior.quadrics, **alone}.items():
            classes = Counter({quadrics[j].class_id: max(quadrics[j].observations, 1)})
            self._assignments.know(j, prior, classes)

    def begin_again(self, keep_map: bool) -> None:
        """Forget the trajectory, and the objects unless the map is kept: then as in a loaded map."""
        no_poses = (), np.zeros((0, 4, 4)), np.zeros((0, 6, 6))
        known = (self.quadrics(), self.camera.frame_id, self._covariances.known()) if keep_map else ((),)
        self.load(ObjectMap(*no_poses, *known))

    def start_at(self, T_map_body: Array, error: float = START_ERROR) -> None:
        """Begin a trajectory in the map there is, where the body is said to be (4, 4), within `error` [rad, m].

        Raises:
            InvalidMeasurement: "start_pose", if there is no map.
        """
        if not self.objects:
            raise InvalidMeasurement("start_pose", "there is no map yet that a start pose could be in")
        if self.stamps:
            self.begin_again(keep_map=True)
        self._search.expect(T_map_body @ self._T_body_camera, error)

    def associations(self) -> list[tuple[int | None, str]]:
        """For each box of a keyframe the quadric it is given to, and its true identity ("": unknown)."""
        frames = self._assignments.frames
        return [pair for frame in frames for pair in zip(frame.quadrics, frame.names, strict=True)]

    def optimise(self) -> None:
        """Move the whole graph to its batch optimum; the noise model `quadricslam` then knows all boxes."""
        if self.settings.noise_model == QUADRICSLAM:
            self._objects.spread_over_all()
        self._graph.optimise()

    # -- one image ----------------------------------------------------------------------------------------------

    def _process(self) -> list[Keyframe]:
        keyframes = []
        start, end = self._motions.start, self._motions.end
        while start is not None and end is not None and (boxes := self._waiting.take(end)) is not None:
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
            turned = self._motions.motion(self._last_frame, boxes.stamp)[:3, :3].T
        self._last_frame = boxes.stamp
        boxes, tracks = self._tracks(boxes, turned)
        motion = found = None
        if self._search.needed:
            found = self._search.place(boxes.stamp, self._objects.frame(boxes, tracks))
            if found is None:
                self.counts["images_not_found"] += 1
                return None
        if self.stamps:
            interval = self.stamps[-1], boxes.stamp
            if not self._moved(self._motions.motion(*interval), boxes.stamp - self.stamps[-1]):
                if self._chores:
                    self._chores.pop(0)()
                self._between = max(self._between, time.perf_counter() - began)
                return None
            motion = Motion(
                *self._motions.between(*interval), self._motions.drifts(*interval), self._motions.measured(*interval)
            )
        return self._keyframe(boxes, tracks, motion, found, began)

    def _tracks(self, boxes: Boxes, R_now_before: Array) -> tuple[Boxes, list[int]]:
        """The boxes that belong to a track, and the number of that track."""
        if self.settings.association == GIVEN:
            known = np.array([i for i, name in enumerate(boxes.object_ids) if name], dtype=int)
            self.counts["rejected_no_identity"] += len(boxes) - len(known)
            boxes = boxes.select(known)
            tracks = [self._given.setdefault(name, len(self._given)) for name in boxes.object_ids]
        else:
            kept = unique(boxes.corners, boxes.scores, self.settings.duplicate_overlap)
            self.counts["rejected_double_box"] += len(boxes) - len(kept)
            boxes = boxes.select(kept)
            corners = undistorted(boxes.corners, self.camera)
            linked = self._tracker.update(boxes.stamp, corners, boxes.class_ids, R_now_before)
            tracks = [track.id for track in linked]
        self._assignments.see(tracks, boxes.class_ids)
        return boxes, tracks

    def _moved(self, motion: Array, duration: int) -> bool:
        s = self.settings
        rotation = float(np.linalg.norm(gtsam.Rot3.Logmap(gtsam.Rot3(motion[:3, :3]))))
        translation = float(np.linalg.norm(motion[:3, 3]))
        return (
            rotation / max(s.keyframe_rotation, 1e-9) + translation / max(s.keyframe_translation, 1e-9) >= 1.0
            or duration >= s.keyframe_interval * SECOND
        )

    def _chores_of(self, k: int) -> list[Callable[[], object]]:
        """What keyframe k leaves to be done: each a piece of work for one image."""
        objects = self._objects

        def look_for_known_and_new() -> None:
            if k:
                objects.relocalise(k)
            self._new.start(self._assignments.frames[k].tracks)

        def join() -> None:
            self._new.join_ended(k)

        def revise() -> None:
            self._upkeep.revise(-(-self.settings.revised // 2))

        # Every update has a price of its own, whatever it relinearises.
        last = [] if k % self.SETTLE_EVERY else [self._settle]
        return [look_for_known_and_new, join, revise, revise, *last]

    def _settle(self) -> None:
        report = self._graph.settle()
        if report is not None:
            self._note(report)

    def _note(self, report: UpdateReport) -> None:
        self._objects.note(report)
        if report.repaired:
            self._repairs.append(report.repaired)

    def _keyframe(
        self, boxes: Boxes, tracks: list[int], motion: Motion | None, found: Relocalised | None, began: float
    ) -> Keyframe:
        while self._chores:  # one that fails is not tried again
            self._chores.pop(0)()
        before = self._known
        objects = self._objects
        frame = objects.frame(boxes, tracks)
        k = len(self.stamps)
        nis = np.zeros(0)
        if motion is None:
            self._graph.add_origin(None if found is None else found.T_map_camera)
        else:
            predicted = self._graph.predict(motion)
            if k % self.NIS_EVERY == 0:
                nis = objects.innovations(frame, predicted, motion)
            guess = objects.localise(frame, predicted, motion.covariance)
            self._graph.add_pose(motion, guess)
        self.stamps.append(boxes.stamp)
        self._motions.forget_before(boxes.stamp)
        used = objects.add(frame)
        if found is not None:
            objects.bind_found(frame, found)
        if motion is not None:
            objects.vote(k, motion)
        self._note(self._graph.update())
        self._upkeep.merge()
        self._chores = self._chores_of(k)
        self._known = set(self._graph.landmarks)
        repaired, self._repairs = "; ".join(self._repairs), []
        between, self._between = self._between, 0.0
        return Keyframe(
            k,
            boxes.stamp,
            self._graph.pose(k),
            used,
            sorted(self._known - before),
            sorted(before - self._known),
            repaired,
            time.perf_counter() - began,
            between,
            nis,
        )


def _known_alone(quadric: QuadricEstimate) -> Known:
    """A quadric of which nothing is known but its estimate and covariance.

    Raises:
        ValueError: it has none.
    """
    if not np.isfinite(quadric.covariance).all():
        raise ValueError(f"quadric {quadric.id} of the map has no covariance")
    vector = Ellipsoid(quadric.T_map_object, quadric.radii).vector()
    covariance = covariance_of_vector(quadric.T_map_object, quadric.radii, quadric.covariance)
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise ValueError(f"the covariance of quadric {quadric.id} of the map is not positive definite") from None
    return Known(vector, covariance)
