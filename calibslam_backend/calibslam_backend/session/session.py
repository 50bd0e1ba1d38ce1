"""A live estimator: what comes is taken in at once, used in its turn, and never lost silently.

A session that is begun with the journal of one that was killed uses the same events in the same order, and so ends up
in the same state.
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.session.intake import Event, Intake, Kind, Report
from calibslam_backend.session.journal import Journal, Record
from calibslam_backend.session.settings import SessionSettings
from calibslam_backend.session.tally import Tally
from calibslam_backend.session.time_guard import KEEP_MAP, TimeGuard
from calibslam_msgs_py.measurements import Array, Boxes, Camera, InvalidMeasurement, RelativeMotion, StampedPose


class NotReady(Exception):
    """What was asked for cannot be done now; the text says why."""


class Session:
    """An estimator, what waits for it, and its sense of time.

    Attributes:
        intake: where to offer measurements and start poses.
        lock: hold it to read `estimator`.
        estimator: None until the camera is known.
        pose_is_new, map_is_new: what changed since whoever publishes set them to False.
        refined: whether all that was seen is optimised together.
        resumed: share of the journal that has been used.
        tally: what it counts and how long it takes.
    """

    SINCE_KEYFRAME = 0.1  # [rad, m] that the body may have moved since the newest one

    def __init__(
        self,
        T_body_camera: Array,
        settings: SessionSettings,
        estimator_settings: EstimatorSettings,
        report: Report,
        journal: Journal | None = None,
    ) -> None:
        self._T_body_camera, self._settings, self._estimator_settings = T_body_camera, settings, estimator_settings
        self._report = report
        self.intake = Intake(settings.queue_size, report, journal)
        self._guard = TimeGuard(settings, report.reject)
        self.lock = threading.RLock()
        self.estimator: Estimator | None = None
        self._camera = self._camera_seen = Event(Kind.CAMERA)
        self._early: list[Event] = []  # of the journal, before its camera
        self._frames: dict[type, str] = {}
        self.tally = Tally(report)
        self._used = 0.0
        self.refined, self.pose_is_new, self.map_is_new = True, False, False
        self._goes_on = False  # where the trajectory before ended
        self.resumed = 0.0 if journal is not None and journal.found else 1.0
        if self.resumed < 1.0:
            self.intake.write(Event(Kind.RESUMED))

    # -- taking in ----------------------------------------------------------------------------------------------

    def offer_camera(self, event: Event) -> bool:
        """The camera; the first one stays. Returns whether it is the one in use; before there is one, `step` takes it.

        Raises:
            InvalidMeasurement: "camera_changed".
        """
        assert isinstance(event.content, Camera)
        self._camera_seen = event
        return self._is_in_use(event.content)

    def _is_in_use(self, camera: Camera) -> bool:
        known = self.camera
        if known is not None and not _same(camera, known):
            raise InvalidMeasurement(
                "camera_changed", "camera_info changed; the first one stays in use until ~/reset is called"
            )
        return known is not None

    @property
    def is_located(self) -> bool:
        """Whether something is known of where the body is in the map: from the first keyframe on, and before it where
        the trajectory goes on from one that had become too long."""
        return self.estimator is not None and (bool(self.estimator.stamps) or self._goes_on)

    @property
    def camera(self) -> Camera | None:
        """In use."""
        return self._camera.content if isinstance(self._camera.content, Camera) else None

    # -- using --------------------------------------------------------------------------------------------------

    def resume(self, decode: Callable[[Record], Event]) -> Iterator[None]:
        """Use what is in the journal; yields after each record.

        Args:
            decode: makes an event of a record; ValueError if it cannot.
        """
        journal = self.intake.journal
        if journal is None or not journal.found:
            return
        for n, record in enumerate(journal.records(), start=1):
            try:
                event = decode(record)
            except ValueError as error:
                self._report.count("errors_journal")
                self._report.say(f"journal {journal.path}, record {n}: {error}")
            else:
                with self.lock:
                    self._use(event)
            self.resumed = min(n / journal.found, 0.999)
            yield
        with self.lock:
            self._use(Event(Kind.RESUMED))
        self.refined = True  # as it was
        self.resumed = 1.0
        if isinstance(seen := self._camera_seen.content, Camera):  # maybe before the journal's was known
            try:
                self._is_in_use(seen)
            except InvalidMeasurement as error:
                self._report.reject(error)

    def step(self, timeout: float) -> None:
        """Use the next event, or refine after a rest; waits for an event at most `timeout` [s]."""
        if self.estimator is None:  # measurements wait for the camera
            if not self._begin_with_camera():
                time.sleep(timeout)
            return
        self.intake.wait(timeout)
        with self.lock:
            now = time.monotonic()
            if (event := self.intake.next()) is not None:
                self._used = now
                self._use(event)
            elif not self.refined and now - self._used > self._settings.refine_after:
                self._refine()

    def _begin_with_camera(self) -> bool:
        """Whether there is one."""
        with self.lock:
            if self.estimator is None and self._camera_seen.content is not None:
                self.intake.write(self._camera_seen)
                self._use(self._camera_seen)
            return self.estimator is not None

    def _use(self, event: Event) -> None:
        if self.estimator is None and event.kind != Kind.CAMERA:
            self._early.append(event)
            return
        try:
            self._apply(event)
        except InvalidMeasurement as error:
            self._report.reject(error)
        except Exception as error:  # the session goes on; the map as it was stays published
            self._report.count("errors")
            self._report.say(f"estimator: {type(error).__name__}: {error}")
        if self.estimator is not None:
            self.tally.tell(self.estimator)

    def _apply(self, event: Event) -> None:
        content = event.content
        if isinstance(content, Camera):
            self._set_camera(event)
            early, self._early = self._early, []
            for each in early:
                self._use(each)
            return
        if event.kind == Kind.RESUMED:
            self._guard.resumed()
            return
        assert self.estimator is not None
        if isinstance(content, Boxes | RelativeMotion):
            self._add(content, event.arrived)
        elif isinstance(content, StampedPose):
            estimator, T = self.estimator, content.T
            self._begin(lambda: estimator.start_at(T))
            self._guard.reset()
        elif isinstance(content, ObjectMap):
            self._load(content)
        elif event.kind == Kind.REFINED:
            self.estimator.finish()
            self.refined = self.pose_is_new = self.map_is_new = True

    def _check_frame(self, measurement: Boxes | RelativeMotion) -> None:
        """Boxes of another camera and motions of another body are none of ours. An empty name may be any."""
        kind, frame = type(measurement), measurement.frame_id
        expected = self._frames.setdefault(kind, frame) if frame else ""
        if frame and expected and frame != expected:
            raise InvalidMeasurement("frame", f"{kind.__name__} of frame '{frame}', but so far it was '{expected}'")

    def _add(self, measurement: Boxes | RelativeMotion, arrived: float) -> None:
        assert self.estimator is not None
        self._check_frame(measurement)
        present = self._guard.take(measurement)
        if present.jumped:
            self._report.count("time_jumps")
            self._report.say("time has jumped back: a new trajectory begins")
            estimator = self.estimator
            self._begin(lambda: estimator.begin_again(self._settings.time_jump == KEEP_MAP))
        elif len(self.estimator.stamps) >= self._settings.max_keyframes:
            self._end_trajectory()
        for each in present.measurements:
            try:
                keyframes = self.estimator.add(each)
            except InvalidMeasurement as error:
                self._report.reject(error)
                continue
            self.tally.keyframes(keyframes, arrived)
            if keyframes:
                self.pose_is_new, self.map_is_new, self.refined = True, True, False
        self._left_out(self.estimator.limit_waiting(self._settings.images_without_odometry))

    def _end_trajectory(self) -> None:
        """It has become too long to be kept: go on where it ends, with the objects there are."""
        assert self.estimator is not None
        estimator = self.estimator
        self._report.count("trajectories_ended")
        self._report.say(f"{len(estimator.stamps)} keyframes (max_keyframes): a new trajectory begins in the map")
        if estimator.objects:
            self._begin(lambda: estimator.start_at(estimator.body_pose(), self.SINCE_KEYFRAME))
            self._goes_on = True
        else:
            self._begin(lambda: estimator.begin_again(keep_map=False))
        gc.collect()  # a graph is in reference cycles

    def _begin(self, begin: Callable[[], None]) -> None:
        """Begin a trajectory; images that wait for the odometry of the one before are left out."""
        assert self.estimator is not None
        waiting = self.estimator.waiting
        begin()
        self._goes_on = False
        self._left_out(waiting - self.estimator.waiting)

    def _load(self, known: ObjectMap) -> None:
        assert self.estimator is not None
        self.estimator.load(known)
        self._goes_on = False
        self._guard.reset()

    def _left_out(self, images: int) -> None:
        if images:
            self._report.reject(InvalidMeasurement("no_odometry", f"{images} images: there is no odometry"), images)

    def _set_camera(self, event: Event) -> None:
        assert isinstance(event.content, Camera)
        self._camera = event
        self._frames = {Boxes: event.content.frame_id} if event.content.frame_id else {}
        self.estimator = Estimator(event.content, self._T_body_camera, self._estimator_settings)
        self._goes_on = False
        self._guard.reset()

    def _refine(self) -> None:
        event = Event(Kind.REFINED)
        if self.intake.write_if_empty(event):
            self._use(event)
            self.refined = True

    # -- what is asked for --------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget everything, and what waits.

        Raises:
            NotReady: the journal cannot be begun anew; nothing is changed.
        """
        self._check_resumed()
        with self.lock:
            camera = self._camera_seen
            known = [camera] if camera.content is not None else []
            try:
                self.intake.begin_again(known, keep_queue=False)
            except OSError as error:
                raise NotReady(f"the journal cannot be begun anew: {error.strerror}; nothing is changed") from None
            for each in known:
                self._set_camera(each)
            self.refined = True

    def load(self, known: ObjectMap) -> None:
        """Forget everything and go on in a map.

        Raises:
            NotReady: see `check_ready`.
            ValueError: the map cannot be used; nothing is changed.
        """
        self.check_ready()
        with self.lock:
            loaded = Event(Kind.MAP, known, known.to_json().encode())
            self._load(known)
            self.refined = True
            try:
                self.intake.begin_again([self._camera, loaded], keep_queue=True)
            except OSError as error:
                self._report.count("errors_journal")
                self.intake.journal_problem = f"does not have the loaded map: {error.strerror}"

    def save(self, path: Path, patience: float = np.inf) -> str:
        """Use what has come in, refine, and write: the best map there is now. Returns what was written.

        Args:
            path: of the file.
            patience: time [s] to use what has come in; with what is left then, the map is not up to date.

        Raises:
            NotReady: there is nothing to save.
            OSError: it cannot be written.
            RuntimeError: the estimate cannot be used.
        """
        self._check_resumed()
        end = time.monotonic() + patience
        with self.lock:
            while self.estimator is not None and time.monotonic() < end and (event := self.intake.next()) is not None:
                self._use(event)
            if self.estimator is None or not self.estimator.stamps:
                raise NotReady("nothing to save: there is no keyframe yet")
            left = len(self.intake)
            if not left:
                self._refine()
            self.estimator.object_map().save(path)
            text = f"{self.estimator.objects} objects and {len(self.estimator.stamps)} keyframes in {path}"
            return text + (f"; {left} measurements had not been used yet" if left else "")

    def check_ready(self) -> None:
        """Raises NotReady unless a map could be loaded now."""
        self._check_resumed()
        if self.estimator is None:
            raise NotReady("no camera_info yet: publish it, then load the map")

    def _check_resumed(self) -> None:
        if self.resumed < 1.0:
            raise NotReady(f"the journal is still being read ({self.resumed:.0%}): try again later")


def _same(a: Camera, b: Camera) -> bool:
    return bool(
        np.allclose(a.K, b.K) and np.allclose(a.distortion, b.distortion) and (a.width, a.height) == (b.width, b.height)
    )
