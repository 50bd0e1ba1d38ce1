"""Messages <-> measurements, with the message classes of ROS and of bags."""

import os

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"  # before any message is imported

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation

from calibslam_msgs_py import bags
from calibslam_msgs_py import conversions as c
from calibslam_msgs_py.covariance import is_covariance
from calibslam_msgs_py.geometry_conversions import quaternion_from_rotation, rotation_from_quaternion
from calibslam_msgs_py.measurements import (
    Boxes,
    Camera,
    InvalidMeasurement,
    QuadricEstimate,
    RelativeMotion,
    StampedPose,
)

STAMP = 1_700_000_001_123_456_789


@pytest.fixture(params=["ros", "bag"])
def types(request: pytest.FixtureRequest) -> c.MessageTypes:
    return c.RosTypes() if request.param == "ros" else bags.types


def pose(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    return T


def covariance(n: int, seed: int = 0) -> np.ndarray:
    A = np.random.default_rng(seed).normal(size=(n, n))
    return A @ A.T + np.eye(n)


def boxes() -> Boxes:
    covariances = np.stack([covariance(4), np.full((4, 4), np.nan)])
    corners = np.array([[1.0, 2.0, 30.0, 40.0], [5.5, 6.5, 7.5, 8.5]])
    return Boxes(STAMP, 640, 480, corners, covariances, ("cup", "7"), np.array([0.9, 0.5]), ("a", ""), "camera")


def with_box(corners: object = None, covariance_: np.ndarray | None = None, score: float = 1.0) -> Boxes:
    return Boxes(
        STAMP,
        640,
        480,
        np.array([[1.0, 2.0, 30.0, 40.0] if corners is None else corners]),
        np.eye(4)[None] if covariance_ is None else covariance_[None],
        ("cup",),
        np.array([score]),
        ("",),
    )


def over_the_wire(msg: object) -> object:
    """A ROS message as a subscriber gets it; a bag's message as it is."""
    return msg if hasattr(msg, "__msgtype__") else deserialize_message(serialize_message(msg), type(msg))


def test_boxes_survive(types: c.MessageTypes) -> None:
    there = boxes()
    back = c.boxes_from_msg(over_the_wire(c.boxes_to_msg(there, types)))
    np.testing.assert_array_equal(back.corners, there.corners)
    np.testing.assert_allclose(back.covariances, there.covariances)
    np.testing.assert_array_equal(back.scores, there.scores)
    np.testing.assert_array_equal(back.has_covariance, [True, False])
    assert (back.stamp, back.width, back.height, back.frame_id) == (STAMP, 640, 480, "camera")
    assert (back.class_ids, back.object_ids) == (("cup", "7"), ("a", ""))


def test_an_image_without_boxes(types: c.MessageTypes) -> None:
    empty = Boxes(STAMP, 4, 3, np.empty((0, 4)), np.empty((0, 4, 4)), (), np.empty(0), ())
    back = c.boxes_from_msg(over_the_wire(c.boxes_to_msg(empty, types)))
    assert len(back) == 0 and back.covariances.shape == (0, 4, 4)
    assert c.valid_boxes(back) == (back, {})


def test_boxes_without_image_size_are_refused(types: c.MessageTypes) -> None:
    msg = c.boxes_to_msg(boxes(), types)
    msg.width = 0
    with pytest.raises(InvalidMeasurement, match="0 x 480") as error:
        c.boxes_from_msg(msg)
    assert error.value.reason == "image_size"


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (with_box([np.nan, 2.0, 30.0, 40.0]), "nan"),
        (with_box([1.0, 2.0, np.inf, 40.0]), "nan"),
        (with_box(score=np.nan), "nan"),
        (with_box([30.0, 2.0, 30.0, 40.0]), "empty"),
        (with_box([1.0, 41.0, 30.0, 40.0]), "empty"),
        (with_box([-30.0, 2.0, -1.0, 40.0]), "outside"),
        (with_box([640.0, 2.0, 700.0, 40.0]), "outside"),
        (with_box([1.0, 480.0, 30.0, 500.0]), "outside"),
        (with_box(covariance_=np.diag([1.0, 1.0, 1.0, -1.0])), "covariance"),
        (with_box(covariance_=np.zeros((4, 4))), "covariance"),
        (with_box(covariance_=np.eye(4) + np.diag([0.1, 0.1, 0.1], 1)), "covariance"),
        (with_box(covariance_=np.diag([1.0, np.inf, 1.0, 1.0])), "covariance"),
    ],
)
def test_bad_boxes_are_dropped_and_counted(bad: Boxes, reason: str) -> None:
    kept, rejected = c.valid_boxes(bad)
    assert len(kept) == 0
    assert rejected == {reason: 1}


def test_good_boxes_are_kept_beside_bad_ones() -> None:
    mixed = boxes()
    mixed.corners[0, 0] = np.nan
    kept, rejected = c.valid_boxes(mixed)
    assert (kept.class_ids, rejected) == (("7",), {"nan": 1})


@pytest.mark.parametrize(
    ("drawn", "cut"),
    [([-5.0, -6.0, 5.0, 5.0], [0.0, 0.0, 5.0, 5.0]), ([600.0, 400.0, 755.0, 481.0], [600.0, 400.0, 640.0, 480.0])],
)
def test_a_box_partly_outside_is_cut_at_the_border(drawn: list[float], cut: list[float]) -> None:
    kept, rejected = c.valid_boxes(with_box(drawn, np.full((4, 4), np.nan)))
    assert len(kept) == 1 and not rejected
    np.testing.assert_array_equal(kept.corners, [cut])


@pytest.mark.parametrize(
    ("corners", "many"),
    [
        ([10.0, 10.0, 671.0, 300.0], False),  # as far as good detectors draw
        ([10.0, 10.0, 673.0, 300.0], True),
        ([10.0, -25.0, 30.0, 30.0], True),
        ([700.0, 10.0, 800.0, 300.0], True),
        ([np.nan, 10.0, 30.0, 30.0], False),
    ],
)
def test_many_boxes_far_beyond_the_image_are_told_once(corners: list[float], many: bool) -> None:
    beyond = c.BeyondImage()
    told = [beyond.news(with_box(corners if k % 10 == 0 else [10.0, 10.0, 30.0, 30.0])) for k in range(200)]
    assert bool(beyond.problem) == many
    assert [k for k, news in enumerate(told) if news] == ([99] if many else [])
    assert not many or told[99].startswith("10 of 100 boxes go beyond the image by more than 5% of it")


def test_nan_covariance_in_a_message_is_a_defect_and_not_unknown(types: c.MessageTypes) -> None:
    msg = c.boxes_to_msg(boxes(), types)
    msg.boxes[0].covariance = np.full(16, np.nan)
    _, rejected = c.valid_boxes(c.boxes_from_msg(msg))
    assert rejected == {"covariance": 1}


@pytest.mark.parametrize("known", [True, False])
def test_motion_survives(types: c.MessageTypes, known: bool) -> None:
    there = RelativeMotion(STAMP - 40_000_000, STAMP, pose(1), covariance(6) * 1e-4 if known else None, "base")
    back = c.motion_from_msg(over_the_wire(c.motion_to_msg(there, types)))
    assert (back.start, back.end, back.frame_id) == (there.start, there.end, "base")
    np.testing.assert_allclose(back.T_start_end, there.T_start_end, atol=1e-12)
    if there.covariance is None:
        assert back.covariance is None
    else:
        assert back.covariance is not None
        np.testing.assert_allclose(back.covariance, there.covariance, atol=1e-15)


def test_bad_motions_are_refused(types: c.MessageTypes) -> None:
    good = RelativeMotion(STAMP - 1, STAMP, pose(), np.eye(6))
    backwards = c.motion_to_msg(RelativeMotion(STAMP, STAMP - 1, pose()), types)
    garbage = c.motion_to_msg(good, types)
    garbage.motion.pose.orientation.w = 5.0
    nan = c.motion_to_msg(good, types)
    nan.motion.pose.position.x = float("nan")
    indefinite = c.motion_to_msg(good, types)
    indefinite.motion.covariance = np.diag([1.0, 1, 1, 1, 1, -1]).ravel()
    zeros = c.motion_to_msg(good, types)
    zeros.motion.covariance = np.zeros(36)
    cases = [
        (backwards, "time"),
        (garbage, "pose"),
        (nan, "pose"),
        (indefinite, "covariance"),
        (zeros, "covariance"),
    ]
    for msg, reason in cases:
        with pytest.raises(InvalidMeasurement) as error:
            c.motion_from_msg(msg)
        assert error.value.reason == reason


def test_odometry_survives(types: c.MessageTypes) -> None:
    velocity = np.arange(6.0)
    S = covariance(6) * 1e-3
    there = StampedPose(STAMP, pose())
    msg = over_the_wire(c.odometry_to_msg(there, types, velocity=velocity, velocity_covariance=S))
    back, S_back = c.odometry_from_msg(msg)
    assert back.stamp == STAMP
    np.testing.assert_allclose(back.T, there.T, atol=1e-12)
    np.testing.assert_allclose(S_back, S, atol=1e-15)
    assert (msg.twist.twist.angular.y, msg.twist.twist.linear.x) == (1.0, 3.0)  # type: ignore[attr-defined]
    unknown = over_the_wire(c.odometry_to_msg(there, types, velocity=velocity))
    assert c.odometry_from_msg(unknown)[1] is None


def test_camera_survives(types: c.MessageTypes) -> None:
    K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    there = Camera(640, 480, K, np.array([0.1, -0.2, 0.0, 0.0, 0.3]), "optical")
    back = c.camera_from_msg(over_the_wire(c.camera_to_msg(there, STAMP, types)))
    assert (back.width, back.height, back.frame_id) == (640, 480, "optical")
    np.testing.assert_array_equal(back.K, K)
    np.testing.assert_array_equal(back.distortion, there.distortion)


def test_unusable_cameras_are_refused(types: c.MessageTypes) -> None:
    there = Camera(640, 480, np.diag([500.0, 500.0, 1.0]), np.zeros(5))
    uncalibrated = c.camera_to_msg(there, STAMP, types)
    uncalibrated.k = np.zeros(9)
    fisheye = c.camera_to_msg(there, STAMP, types)
    fisheye.distortion_model, fisheye.d = "equidistant", types.doubles(np.ones(4))
    for msg, text in ((uncalibrated, "not calibrated"), (fisheye, "only plumb_bob")):
        with pytest.raises(InvalidMeasurement, match=text):
            c.camera_from_msg(msg)


@pytest.mark.parametrize("known", [True, False])
def test_quadrics_survive(types: c.MessageTypes, known: bool) -> None:
    S = covariance(9) if known else np.full((9, 9), np.nan)
    there = QuadricEstimate(7, "cup", pose(3), np.array([0.1, 0.2, 0.3]), S, 12)
    msg = over_the_wire(c.quadrics_to_msg(STAMP, [there], types))
    (back,) = c.quadrics_from_msg(msg)
    assert (back.id, back.class_id, back.observations) == (7, "cup", 12)
    np.testing.assert_allclose(back.T_map_object, there.T_map_object, atol=1e-12)
    np.testing.assert_array_equal(back.radii, there.radii)
    np.testing.assert_allclose(back.covariance, S, atol=1e-12)
    assert msg.header.frame_id == "map"  # type: ignore[attr-defined]
    if known:
        # Position and rotation are those of a pose; the radii keep their place.
        flat = np.asarray(msg.quadrics[0].covariance).reshape(9, 9)  # type: ignore[attr-defined]
        np.testing.assert_allclose(flat[:6, :6], c.ros_from_gtsam_covariance(S[:6, :6], there.T_map_object[:3, :3]))
        np.testing.assert_allclose(flat[6:, 6:], S[6:, 6:])
        assert is_covariance(flat)


def test_path_and_pose(types: c.MessageTypes) -> None:
    poses = [StampedPose(STAMP + i, pose(i)) for i in range(3)]
    path = over_the_wire(c.path_to_msg(poses, "map", types))
    assert c.stamp_from_msg(path.header.stamp) == STAMP + 2  # type: ignore[attr-defined]
    back = [c.stamped_pose_from_msg(msg) for msg in path.poses]  # type: ignore[attr-defined]
    assert [p.stamp for p in back] == [p.stamp for p in poses]
    np.testing.assert_allclose([p.T for p in back], [p.T for p in poses], atol=1e-12)
    unknown = over_the_wire(c.pose_with_covariance_to_msg(poses[0], None, "map", types))
    assert unknown.pose.covariance[0] == -1.0  # type: ignore[attr-defined]


def test_quaternions_of_all_kinds_of_rotation() -> None:
    rotations = [np.eye(3), *(np.diag(d) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1]))]
    rotations += list(Rotation.random(200, random_state=0).as_matrix())
    for R in rotations:
        q = quaternion_from_rotation(R)
        assert q[3] >= 0.0
        np.testing.assert_allclose(rotation_from_quaternion(q), R, atol=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), R, atol=1e-12)


@pytest.mark.parametrize("stamp", [0, 1, 999_999_999, 1_000_000_000, STAMP])
def test_stamps_are_exact(types: c.MessageTypes, stamp: int) -> None:
    assert c.stamp_from_msg(c.stamp_to_msg(stamp, types)) == stamp
