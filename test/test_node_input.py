"""The back end's node among bad input and service calls: what is wrong is counted, and it goes on."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from calibslam_msgs.msg import BoundingBox, BoundingBoxArray, RelativePose
from calibslam_msgs.srv import LoadMap, SaveMap
from live import PATIENCE, Process, Watcher, random_domain, trajectory_of, wait_until
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from small_world import CAMERA, SmallWorld, around, objects
from std_srvs.srv import SetBool, Trigger

from calibslam_backend.backend_node import BackendNode
from calibslam_backend.output.metrics import ate
from calibslam_backend.ros.event_messages_node import Decoder
from calibslam_backend.session.intake import Event, Kind, Report
from calibslam_backend.session.journal import Journal, Record
from calibslam_msgs_py.conversions import RosTypes, boxes_to_msg, camera_to_msg, motion_to_msg
from calibslam_msgs_py.measurements import SECOND, Boxes, Camera, RelativeMotion
from calibslam_msgs_py.node import LATCHED

WORLD = SmallWorld(around(150), objects())
TYPES = RosTypes()
PACE = 0.004  # [s] between messages: faster than any camera
NO_CAMERA = "waiting for camera_info"
# All of it is kept for a back end that has no time to take it in, or has not yet heard of its publisher.
KEPT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)


class Robot:
    """Publishes measurements to one back end, and sees what it reports."""

    def __init__(self, watcher: Watcher) -> None:
        self.watcher = watcher
        self._camera = watcher.node.create_publisher(CameraInfo, "camera/camera_info", LATCHED)
        self._boxes = watcher.node.create_publisher(BoundingBoxArray, "detections", KEPT)
        self._motions = watcher.node.create_publisher(RelativePose, "relative_pose", KEPT)
        watcher.listen(PathMessage, "/trajectory")
        for publisher in (self._camera, self._boxes, self._motions):
            wait_until(lambda p=publisher: p.get_subscription_count() == 1, "the back end does not subscribe")
        time.sleep(0.5)  # that one side has found the other does not tell that the other has

    def camera(self, stamp: int = 0, camera: Camera = CAMERA) -> None:
        self._camera.publish(camera_to_msg(camera, stamp, TYPES))

    def show_camera(self) -> None:
        """Until the back end has it: a subscriber that has not found its publisher yet misses what is sent once."""

        def is_known() -> bool:
            self.camera()
            time.sleep(PACE)
            return self.watcher.counts("/backend").get("state", NO_CAMERA) != NO_CAMERA

        wait_until(is_known, lambda: f"the back end has no camera: {self.watcher.counts('/backend')}")

    def boxes(self, boxes: Boxes, spoil: Callable[[Any], None] | None = None) -> None:
        message = boxes_to_msg(boxes, TYPES)
        if spoil:
            spoil(message)
        self._boxes.publish(message)
        time.sleep(PACE)

    def motion(self, motion: RelativeMotion, spoil: Callable[[Any], None] | None = None) -> None:
        message = motion_to_msg(motion, TYPES)
        if spoil:
            spoil(message)
        self._motions.publish(message)
        time.sleep(PACE)

    def drive(self, start: int, end: int, world: SmallWorld = WORLD) -> None:
        """Images from `start` to `end` - 1, and the motions to them."""
        boxes, motions = world.boxes(), world.motions()
        for k in range(start, end):
            if k:
                self.motion(motions[k - 1])
            self.boxes(boxes[k])

    def expect(self, **counts: int) -> None:
        """Wait until the diagnostics say so."""
        expected = {name: str(count) for name, count in counts.items()}
        wait_until(
            lambda: self.watcher.counts("/backend").items() >= expected.items(),
            lambda: f"expected {expected}, reported {self.watcher.counts('/backend')}",
        )


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    domain = random_domain()
    options = ("--ros-args", "-p", f"map_folder:={tmp_path}")
    with Watcher(domain) as watcher, Process(domain, "calibslam_backend", "backend", *options) as backend:
        yield Robot(watcher)
        assert backend.running, backend.output
        assert backend.end() == 0, backend.output
        assert "Traceback" not in backend.output


def test_bad_input_is_counted_and_the_graph_goes_on(robot: Robot) -> None:
    boxes, motions = WORLD.boxes(), WORLD.motions()
    robot.show_camera()
    robot.drive(0, 50)
    robot.expect(images=50, motions=49)

    def nan(message: Any) -> None:
        message.boxes[0].corners[2] = np.nan

    def indefinite(message: Any) -> None:
        for box in message.boxes[:2]:
            box.covariance[0] = -4.0

    def outside(message: Any) -> None:
        message.boxes[0].corners[:] = [-90.0, 0.0, -10.0, 20.0]

    def other_size(message: Any) -> None:
        message.width = 1280

    def infinite(message: Any) -> None:
        message.motion.pose.position.z = np.inf

    def indefinite_motion(message: Any) -> None:
        message.motion.covariance[7] = -1.0

    robot.motion(motions[49])
    robot.boxes(boxes[50], nan)
    robot.motion(motions[50])
    robot.boxes(boxes[51], indefinite)
    robot.motion(motions[51])
    robot.boxes(boxes[52], outside)
    robot.boxes(boxes[53], other_size)
    robot.motion(motions[52], infinite)
    robot.motion(motions[52], indefinite_motion)
    robot.motion(motions[10])  # a single one of long ago
    robot.motion(replace(motions[52], start=motions[52].end + 1, end=motions[52].end + 2), reversed_time)
    robot.boxes(boxes[45])
    robot.boxes(boxes[52])
    robot.expect(
        rejected_box_nan=1, rejected_box_covariance=2, rejected_box_outside=1, rejected_image_size=1, rejected_pose=1,
        rejected_covariance=1, rejected_time=1, rejected_late=1, rejected_duplicate=1, images=53,
    )  # fmt: skip
    robot.drive(53, 150)
    robot.expect(images=150, motions=149, rejected_time_jump=1)
    wait_until(lambda: ate(trajectory_of(robot.watcher.last["/trajectory"]), WORLD.truth()) < 0.04, "a good trajectory")
    assert "errors" not in robot.watcher.counts("/backend")


def test_a_peer_that_publishes_garbage(robot: Robot) -> None:
    """Bytes that are no message, far too many boxes, names that are none, another camera: counted, and nothing more."""
    boxes, motions = WORLD.boxes(), WORLD.motions()
    peer = robot.watcher.node.create_publisher(BoundingBoxArray, "detections", KEPT)
    other = robot.watcher.node.create_publisher(RelativePose, "relative_pose", KEPT)
    for publisher in (peer, other):
        wait_until(lambda p=publisher: p.get_subscription_count() == 1, "the back end does not subscribe")
    robot.show_camera()
    robot.drive(0, 40)
    robot.expect(images=40)
    for data in (b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 200, b"\0\1\0\0" + b"\0" * 16 + b"\xff\xff\xff\x7f" * 9):
        peer.publish(data)
        other.publish(data)
    peer.publish(BoundingBoxArray())
    peer.publish(BoundingBoxArray(width=640, height=480, boxes=[BoundingBox()] * 10_000))
    other.publish(RelativePose())
    robot.expect(rejected_undecodable=6, rejected_message_size=1, rejected_image_size=1, rejected_time=1)

    def foreign(message: Any) -> None:
        message.header.frame_id = "another camera"

    def nameless(message: Any) -> None:
        message.header.frame_id = ""
        for box in message.boxes:
            box.class_id = box.object_id = ""

    robot.motion(motions[39], foreign)
    robot.motion(motions[39])
    robot.boxes(boxes[40], foreign)
    robot.boxes(boxes[40], nameless)
    robot.expect(rejected_frame=2, images=41)
    robot.drive(41, 150)
    robot.expect(images=150, motions=149)
    assert "errors" not in robot.watcher.counts("/backend")


def reversed_time(message: Any) -> None:
    message.start, message.header.stamp = message.header.stamp, message.start


def test_measurements_wait_for_the_camera(robot: Robot) -> None:
    robot.drive(0, 40)
    robot.show_camera()
    robot.expect(images=40, motions=39)


def test_another_camera(robot: Robot) -> None:
    """The first one stays, whatever comes between; after a reset it is the newest."""
    other = replace(CAMERA, K=np.diag([1.1, 1.1, 1.0]) @ CAMERA.K)
    robot.show_camera()
    robot.drive(0, 10)
    robot.expect(images=10)
    robot.camera(stamp=SECOND)
    for changes in (1, 2):
        robot.camera(2 * SECOND, other)
        robot.expect(rejected_camera_changed=changes)
        robot.camera(3 * SECOND)
    robot.drive(10, 20)
    robot.expect(rejected_camera_changed=2, images=20)
    robot.camera(4 * SECOND, other)
    robot.expect(rejected_camera_changed=3)
    assert robot.watcher.call(Trigger, "/backend/reset").success
    robot.camera(5 * SECOND, other)
    robot.camera(6 * SECOND)
    robot.expect(rejected_camera_changed=4)


class Said(Report):
    """What a decoder reports."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def say(self, text: str) -> None:
        self.texts.append(text)


def test_boxes_of_another_image_size_are_warned_of_once() -> None:
    said = Said()
    decoder = Decoder("map", said)
    for measured in list(WORLD.boxes())[:60]:
        drawn = boxes_to_msg(replace(measured, corners=1.5 * measured.corners), TYPES)
        decoder.event(Kind.BOXES, serialize_message(drawn), 0.0)
    assert len(said.texts) == 1 and "do boxes and camera_info belong to one image size?" in said.texts[0]


@pytest.fixture
def resuming(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[BackendNode, threading.Event]]:
    """A node in this process that reads the camera in its journal once the event is set."""
    read = threading.Event()
    journal = Journal(tmp_path / "journal")
    journal.append(Record(Kind.CAMERA, serialize_message(camera_to_msg(CAMERA, 0, TYPES))))
    journal.close()
    recorded = Decoder.recorded

    def waiting(decoder: Decoder, record: Record) -> Event:
        read.wait(PATIENCE)
        return recorded(decoder, record)

    monkeypatch.setattr(Decoder, "recorded", waiting)
    monkeypatch.setitem(os.environ, "ROS_DOMAIN_ID", str(random_domain()))
    rclpy.init(args=["--ros-args", "-p", f"journal:={tmp_path / 'journal'}"])
    node = BackendNode()
    yield node, read
    read.set()
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()


def test_another_camera_while_the_journal_is_read(resuming: tuple[BackendNode, threading.Event]) -> None:
    """It is rejected when the journal's is known, and with each message from then on."""
    node, read = resuming
    (receive,) = (s.callback for s in node.subscriptions if s.msg_type is CameraInfo)
    other = serialize_message(camera_to_msg(replace(CAMERA, K=np.diag([1.1, 1.1, 1.0]) @ CAMERA.K), 0, TYPES))
    for _ in range(3):
        receive(other)
    assert not node._counters["rejected_camera_changed"]
    read.set()
    wait_until(lambda: node._counters["rejected_camera_changed"] == 1, "it is not compared")
    for _ in range(2):
        receive(other)
    assert node._counters["rejected_camera_changed"] == 3


def test_pause_reset_save_and_load(robot: Robot, tmp_path: Path) -> None:
    call = robot.watcher.call
    path = str(tmp_path / "map.json")
    refused = call(LoadMap, "/backend/load_map", path=path)
    assert not refused.success and "no camera_info yet" in refused.message
    refused = call(SaveMap, "/backend/save_map", path=path)
    assert not refused.success and "nothing to save" in refused.message
    robot.show_camera()
    robot.drive(0, 100)
    robot.expect(images=100, motions=99, **{"objects": 9})
    # Into a file as if it were a folder.
    (tmp_path / "file").touch()
    refused = call(SaveMap, "/backend/save_map", path=str(tmp_path / "file" / "map.json"))
    assert not refused.success and "cannot write" in refused.message
    assert call(SaveMap, "/backend/save_map", path=path).success
    # While paused, measurements are ignored; afterwards they count again.
    paused = call(SetBool, "/backend/pause", data=True)
    assert paused.success and "paused" in paused.message
    robot.drive(100, 110)
    robot.expect(images=100, ignored_while_paused=20)
    assert call(SetBool, "/backend/pause", data=False).message == "running"
    robot.drive(110, 120)
    robot.expect(images=110, odometry_gap=1)
    # After a reset a recording can start again, also at an earlier time.
    assert call(Trigger, "/backend/reset").success
    robot.drive(0, 60)
    robot.expect(images=170)
    refused = call(SaveMap, "/backend/save_map", path=str(tmp_path / "second.json"))
    assert refused.success
    # A known map: its objects are there before anything is seen.
    loaded = call(LoadMap, "/backend/load_map", path=path)
    assert loaded.success and "9 objects" in loaded.message
    robot.drive(0, 60, replace(WORLD, seed=1))
    robot.expect(images=230, objects=9)
