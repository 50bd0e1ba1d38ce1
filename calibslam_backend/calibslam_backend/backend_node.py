"""Node `backend`: boxes and motions in, trajectory, pose and quadrics out.

The executor's thread takes messages in, and one worker thread uses them, so that a slow update never makes a
measurement wait in the network. Only services use the estimator in the executor's thread: what comes meanwhile waits in
the network. Results depend on the measurements, not on when they come.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rclpy.node import Node

from calibslam_backend.estimator import EstimatorSettings
from calibslam_backend.geometry.transform import transform_from_text
from calibslam_backend.kernels import load_kernels
from calibslam_backend.output.published import POSE, TOPICS, pose_message
from calibslam_backend.ros.diagnostics import of_session
from calibslam_backend.ros.event_messages_node import TYPES, Decoder
from calibslam_backend.ros.map_publisher_node import MapPublisher
from calibslam_backend.ros.map_services_node import MapServices
from calibslam_backend.ros.map_to_odom_node import MapToOdom
from calibslam_backend.session.intake import Kind
from calibslam_backend.session.journal import Journal, JournalError
from calibslam_backend.session.session import NotReady, Session
from calibslam_backend.session.settings import SessionSettings
from calibslam_backend.session.tally import USUALLY_LEFT_OUT
from calibslam_msgs_py.conversions import RosTypes
from calibslam_msgs_py.measurements import Boxes, InvalidMeasurement, RelativeMotion, StampedPose
from calibslam_msgs_py.node import (
    LATCHED,
    MEASUREMENT_INPUT,
    SENSOR,
    Counters,
    advertise,
    run,
)
from calibslam_msgs_py.node_subscription import Subscription
from calibslam_msgs_py.settings import SettingsError, declare_parameters, setting

SECONDS_TO_SAVE = 3.0  # at the end, for measurements that still wait
BEHIND_STAMP = 12  # [bytes] of a serialised message with a header: what kind of CDR it is, seconds, nanoseconds


@dataclass(frozen=True)
class NodeSettings(SessionSettings):
    """Parameters of the node beside those of the estimator."""

    camera_in_body: str = setting("0 0 0 0 0 0 1", "camera's optical frame in odometry's body: x y z qx qy qz qw")
    map_frame: str = setting("map", "name of the frame that poses and quadrics are published in")
    transform_tolerance: float = setting(
        0.1,
        "how far ahead of odometry map -> odom is dated on /tf, to be found by who looks up the present",
        unit="s",
        low=0.0,
    )
    map_period: float = setting(1.0, "least wall time between two messages of the map", unit="s", low=0.0)
    map_folder: str = setting(".", "folder that the maps of services lie in; paths that lead out of it are refused")
    save_at_exit: str = setting("", "file in map_folder to write the map to at SIGINT or SIGTERM; empty: none")
    journal: str = setting(
        "", "file that keeps what was taken in; after a crash, the node goes on from there; empty: none"
    )


class BackendNode(Node):
    """detections, relative_pose, camera/camera_info, initialpose, odom -> trajectory, pose, quadrics, quadric_markers.

    Where tf2_msgs is installed, /tf; services ~/reset, ~/pause, ~/save_map, ~/load_map.
    """

    def __init__(self) -> None:
        super().__init__("backend")
        self._settings = settings = declare_parameters(self, NodeSettings)
        estimator_settings = declare_parameters(self, EstimatorSettings)
        try:
            T_body_camera = transform_from_text(settings.camera_in_body)
            journal = Journal(Path(settings.journal)) if settings.journal else None
        except JournalError as error:
            raise SettingsError(f"journal: {error}") from None
        except ValueError as error:
            raise SettingsError(f"camera_in_body: {error}") from None
        self._types = RosTypes()
        self._counters = Counters(self, lambda: of_session(self._session), usual=USUALLY_LEFT_OUT)
        self._outputs = {topic: advertise(self, self._types(kind), topic, LATCHED) for topic, kind in TOPICS.items()}
        self._map = MapPublisher(self._outputs, self._types, settings.map_frame, settings.map_period)
        self._map_to_odom = MapToOdom(self, settings.map_frame, settings.transform_tolerance, self)
        load_kernels()  # before anything can come in and wait
        self._session = Session(T_body_camera, settings, estimator_settings, self, journal)
        self._decoder = Decoder(settings.map_frame, self)
        self._camera_data = b""  # of the one in use, if it came last
        if journal is not None:
            self._introduce(journal)
        self._stop = threading.Event()
        self._worker = threading.Thread(target=self._work, name="estimator", daemon=True)
        self._worker.start()
        for kind, topic, profile in (
            (Kind.CAMERA, "camera/camera_info", SENSOR),
            (Kind.MOTION, "relative_pose", MEASUREMENT_INPUT),
            (Kind.BOXES, "detections", MEASUREMENT_INPUT),
            (Kind.START, "initialpose", MEASUREMENT_INPUT),
        ):
            # As bytes: what cannot be decoded would otherwise end the node, and the journal takes them as they are.
            receive, follows = self._receiver(kind, topic), kind != Kind.CAMERA  # that is said once in some bags
            Subscription(self, self._counters, TYPES[kind], topic, receive, profile, raw=True, follows=follows)
        self._map_services = MapServices(
            self, self._session, Path(settings.map_folder), estimator_settings.start_in_map
        )

    def _introduce(self, journal: Journal) -> None:
        if journal.found:
            self.get_logger().info(f"going on from journal {journal.path}: {journal.found} records")
        if journal.cut:
            self.get_logger().warning(
                f"journal {journal.path}: {journal.cut} bytes behind the last whole record are kept in "
                f"{journal.path}.damaged"
            )
            self.count("journal_bytes_cut", journal.cut)

    # -- what the session reports -------------------------------------------------------------------------------

    def count(self, name: str, by: int = 1) -> None:
        """Something happened."""
        self._counters.count(name, by)

    def reject(self, error: InvalidMeasurement, count: int = 1) -> None:
        """A measurement was left out."""
        self._counters.reject(error, count)

    def say(self, text: str) -> None:
        """Something a person should see."""
        self._counters.warn(text)

    # -- executor's thread --------------------------------------------------------------------------------------

    def _receiver(self, kind: Kind, topic: str) -> Callable[[bytes], None]:
        name = topic.rpartition("/")[2]

        def receive(data: bytes) -> None:
            arrived = time.monotonic()
            try:
                if kind == Kind.CAMERA:
                    self._take_camera(data, arrived)
                    return
                event = self._decoder.event(kind, data, arrived)
                if isinstance(event.content, Boxes):
                    self._counters.arrived(name, event.content.stamp)
                elif isinstance(event.content, RelativeMotion):
                    self._counters.arrived(name, event.content.end)
                self._session.intake.offer(event)
            except InvalidMeasurement as error:
                self.reject(error)

        return receive

    def _take_camera(self, data: bytes, arrived: float) -> None:
        if data[BEHIND_STAMP:] == self._camera_data:  # with each image the same
            return
        self._camera_data = b""
        if self._session.offer_camera(self._decoder.event(Kind.CAMERA, data, arrived)):
            self._camera_data = data[BEHIND_STAMP:]

    # -- worker's thread ----------------------------------------------------------------------------------------

    def _work(self) -> None:
        for _ in self._session.resume(self._decoder.recorded):
            if self._stop.is_set():
                return
        while not self._stop.is_set():
            try:
                if not self._map.publish_some(self._session):
                    self._step()
                    self._publish_pose()
            except Exception as error:  # an estimate that cannot be used for now
                self.count("errors")
                self.say(f"publishing: {type(error).__name__}: {error}")

    def _step(self) -> None:
        before = self._session.camera
        self._session.step(timeout=0.05)
        if before is None and (camera := self._session.camera) is not None:
            self.get_logger().info(f"camera {camera.frame_id}: {camera.width} x {camera.height} pixels")

    def _publish_pose(self) -> None:
        """As soon as there is a new one; the map has time."""
        session = self._session
        with session.lock:
            if not session.is_located:
                self._map_to_odom.pose = None  # until the camera is found in the map
            estimator = session.estimator
            if estimator is None or not estimator.stamps or not session.pose_is_new:
                return
            session.pose_is_new = False
            self._outputs[POSE].publish(pose_message(estimator, self._types, self._settings.map_frame))
            self._map_to_odom.pose = StampedPose(estimator.stamps[-1], estimator.body_pose())

    def close(self) -> None:
        """Let the worker end its update, save the map if that is wanted, and have the journal on disk."""
        self._stop.set()
        self._worker.join(timeout=10.0)
        if self._settings.save_at_exit:
            try:
                saved = self._map_services.save(self._settings.save_at_exit, patience=SECONDS_TO_SAVE)
                self.get_logger().info(f"saved: {saved}")
            except NotReady as error:
                self.get_logger().error(f"the map is not saved: {error}")
        self._session.intake.close()


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit code."""
    return run(BackendNode, args)


if __name__ == "__main__":
    sys.exit(main())
