"""map -> odom on /tf: odometry at the time of a keyframe, and the transform with each odometry message."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from types import ModuleType, SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest
from nav_msgs.msg import Odometry

from calibslam_backend.ros.map_to_odom_node import MapToOdom, OdometryHistory
from calibslam_msgs_py.conversions import RosTypes, header_to_msg, pose_to_msg, stamp_from_msg
from calibslam_msgs_py.measurements import SECOND, Array, InvalidMeasurement, StampedPose

MS = SECOND // 1000
TOLERANCE = 0.1
TYPES = RosTypes()


def along_x(metres: float) -> Array:
    T = np.eye(4)
    T[0, 3] = metres
    return T


def driven(until: int, step: int = 10 * MS) -> OdometryHistory:
    """1 m/s from time 0."""
    history = OdometryHistory()
    for stamp in range(0, until + 1, step):
        history.add(stamp, along_x(stamp / SECOND))
    return history


def test_between_two_poses_the_body_is_on_the_geodesic() -> None:
    """A quarter of a circle with a radius of 1 m, of which a third is driven."""
    history = OdometryHistory()
    arc = np.array([0.0, 0.0, np.pi / 2, np.pi / 2, 0.0, 0.0])
    history.add(0, np.eye(4))
    history.add(300 * MS, gtsam.Pose3.Expmap(arc).matrix())
    T = history.at(100 * MS)
    assert T is not None
    assert T[:2, 3] == pytest.approx([np.sin(np.pi / 6), 1 - np.cos(np.pi / 6)])
    assert T[:2, 0] == pytest.approx([np.cos(np.pi / 6), np.sin(np.pi / 6)])


def test_a_repeated_message_changes_nothing() -> None:
    history = driven(1990 * MS)
    history.add(1990 * MS, along_x(7.0))
    history.add(1985 * MS, along_x(7.0))  # a little late
    for seconds in (1.0, 1.985, 1.99):
        assert history.at(int(seconds * SECOND)) == pytest.approx(along_x(seconds))


def test_the_pose_at_an_old_image_among_fast_odometry() -> None:
    assert driven(2 * SECOND, MS).at(500 * MS) == pytest.approx(along_x(0.5))


def test_no_pose_outside_what_is_kept_and_in_gaps() -> None:
    history = driven(100 * SECOND)
    assert len(history._stamps) == 100 * OdometryHistory.KEPT // SECOND + 1
    assert history.at(69 * SECOND) is None and history.at(71 * SECOND) is not None
    assert history.at(100 * SECOND + 1) is None and history.at(100 * SECOND) is not None
    assert not history.add(101 * SECOND, along_x(101.0))
    assert history.at(100 * SECOND + 500 * MS) is None and history.at(101 * SECOND) is not None


def test_when_time_goes_back_history_begins_anew() -> None:
    history = driven(20 * SECOND)
    assert not history.add(SECOND, along_x(0.0))
    assert history.at(15 * SECOND) is None and history.at(SECOND) == pytest.approx(along_x(0.0))


def measured(stamp: int) -> Any:
    message = Odometry(header=header_to_msg(stamp, "odometry", TYPES), child_frame_id="body")
    message.pose.pose = pose_to_msg(along_x(stamp / SECOND), TYPES)
    return message


class Robot:
    """Odometry at 20 Hz and 1 m/s, and what comes of it on /tf."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        package, messages = ModuleType("tf2_msgs"), ModuleType("tf2_msgs.msg")
        messages.TFMessage = SimpleNamespace  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "tf2_msgs", package)
        monkeypatch.setitem(sys.modules, "tf2_msgs.msg", messages)
        self.counts: Counter[str] = Counter()
        self.published: list[tuple[int, float]] = []  # stamp, and metres that odometry is moved by
        self.odometry: Any = None
        self.tf = MapToOdom(self, "map", TOLERANCE, self)

    def create_publisher(self, *_: Any) -> Any:
        return self

    def create_subscription(self, kind: Any, topic: str, receive: Any, profile: Any) -> None:
        self.odometry = receive

    def publish(self, message: Any) -> None:
        (each,) = message.transforms
        assert (each.header.frame_id, each.child_frame_id) == ("map", "odometry")
        self.published.append((stamp_from_msg(each.header.stamp), each.transform.translation.x))

    def count(self, name: str, by: int = 1) -> None:
        self.counts[name] += by

    def reject(self, error: InvalidMeasurement, count: int = 1) -> None:
        self.counts[f"rejected_{error.reason}"] += count

    def say(self, text: str) -> None:
        raise AssertionError(text)

    def drives(self, start: int, end: int) -> None:
        for stamp in range(start, end, 50 * MS):
            self.odometry(measured(stamp))

    def is_at(self, stamp: int, offset: float) -> None:
        """By the map it is so far ahead of its odometry."""
        self.tf.pose = StampedPose(stamp, along_x(stamp / SECOND + offset))


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    return Robot(monkeypatch)


def test_the_transform_is_there_at_any_time(robot: Robot) -> None:
    """Also between keyframes, and a little ahead of odometry; no stamp comes twice."""
    robot.drives(0, SECOND)
    assert robot.published == []
    robot.is_at(910 * MS, 0.25)
    robot.drives(950 * MS, 2 * SECOND)  # the first one for the second time
    assert robot.published == [(t + 100 * MS, pytest.approx(0.25)) for t in range(SECOND, 2 * SECOND, 50 * MS)]
    robot.is_at(1910 * MS, 0.5)
    robot.drives(2 * SECOND, 3 * SECOND)
    assert [metres for _, metres in robot.published[20:]] == pytest.approx(20 * [0.5])
    assert not robot.counts


def test_a_pose_waits_for_its_odometry(robot: Robot) -> None:
    robot.drives(0, SECOND)
    robot.is_at(1020 * MS, 0.25)
    robot.drives(SECOND, 1050 * MS)
    assert robot.published == []
    robot.drives(1050 * MS, 1100 * MS)
    assert robot.published == [(1150 * MS, pytest.approx(0.25))] and not robot.counts


def test_a_pose_without_odometry_is_counted(robot: Robot) -> None:
    """The transform stays as it was: odometry's frame does not jump (REP 105)."""
    robot.drives(0, SECOND)
    robot.is_at(500 * MS, 0.25)
    robot.drives(3 * SECOND, 4 * SECOND)
    robot.is_at(2 * SECOND, 0.5)
    robot.drives(4 * SECOND, 5 * SECOND)
    assert robot.counts == {"rejected_odom_gap": 1}
    assert {round(metres, 9) for _, metres in robot.published} == {0.25}


def test_nothing_is_published_while_the_pose_is_not_known(robot: Robot) -> None:
    """After a reset, and after time went back."""
    robot.is_at(0, 0.25)
    robot.drives(0, SECOND)
    before = len(robot.published)
    assert before == 19
    robot.tf.pose = None
    robot.drives(SECOND, 2 * SECOND)
    robot.is_at(1900 * MS, 0.5)
    robot.drives(2 * SECOND, 2100 * MS)
    assert len(robot.published) == before + 2
    robot.drives(0, SECOND)
    assert len(robot.published) == before + 2


def test_a_single_stamp_far_ahead(robot: Robot) -> None:
    robot.is_at(0, 0.25)
    robot.drives(0, SECOND)
    last = 2**31 * SECOND - 1  # that a message can have
    robot.odometry(measured(last))
    robot.drives(SECOND, 2 * SECOND)
    assert max(stamp for stamp, _ in robot.published) == 2050 * MS


def test_poses_may_come_from_another_thread(robot: Robot) -> None:
    errors: list[Exception] = []
    stop = threading.Event()

    def work() -> None:
        try:
            while not stop.is_set():
                robot.is_at(25 * MS, 0.25)
        except Exception as error:
            errors.append(error)

    messages = [measured(stamp) for stamp in (0, 50 * MS, 2 * SECOND)]
    switched = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    worker = threading.Thread(target=work)
    worker.start()
    try:
        for _ in range(3000):  # in each, time goes back
            for message in messages:
                robot.odometry(message)
    finally:
        stop.set()
        worker.join()
        sys.setswitchinterval(switched)
    assert not errors and {round(metres, 9) for _, metres in robot.published} == {0.25}
