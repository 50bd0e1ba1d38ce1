"""Boxes of the same object in consecutive images."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from small_world import CAMERA

from calibslam_backend.association.tracking import Tracker, TrackingSettings, overlap, rotated, unique
from calibslam_msgs_py.measurements import SECOND

A = np.array([100.0, 100.0, 200.0, 200.0])
B = np.array([300.0, 100.0, 420.0, 180.0])
STILL = np.eye(3)


def tracker(**settings: float) -> Tracker:
    return Tracker(TrackingSettings(**settings), CAMERA.K)


def ids(tracks: list) -> list[int]:
    return [track.id for track in tracks]


def test_overlap_by_hand() -> None:
    """Shifted by half its width: 1/3. Inside with half the area: 1/2. Apart or only touching: 0."""
    others = np.array([[150.0, 100, 250, 200], [100, 100, 150, 200], [200, 100, 300, 200], [400, 400, 401, 401], A])
    np.testing.assert_allclose(overlap(A[None], others), [[1 / 3, 1 / 2, 0.0, 0.0, 1.0]])
    assert overlap(np.empty((0, 4)), others).shape == (0, 5)


def test_double_boxes_lose_to_the_better_one() -> None:
    boxes = np.stack([A, A + 5.0, B, A + 40.0])
    assert list(unique(boxes, np.array([0.6, 0.9, 0.5, 0.4]), 0.75)) == [1, 2, 3]
    assert list(unique(boxes, np.array([0.9, 0.9, 0.5, 0.4]), 0.75)) == [0, 2, 3]
    assert list(unique(np.empty((0, 4)), np.empty(0), 0.75)) == []


def test_a_track_is_followed_and_others_begin() -> None:
    t = tracker()
    first = ids(t.update(0, np.stack([A, B]), ("cup", "book"), STILL))
    assert first == [0, 1]
    assert ids(t.update(1, np.stack([B + 10, A + 5]), ("book", "cup"), STILL)) == [1, 0]
    assert ids(t.update(2, np.stack([A + 250]), ("cup",), STILL)) == [2]
    assert ids(t.update(3, np.empty((0, 4)), (), STILL)) == []


def test_each_box_gets_a_track_of_its_own() -> None:
    """Two boxes overlap one track: the better takes it."""
    t = tracker()
    t.update(0, A[None], ("cup",), STILL)
    assert ids(t.update(1, np.stack([A + 30, A + 5]), ("cup", "cup"), STILL)) == [1, 0]


def test_a_track_ends_when_it_is_not_seen() -> None:
    t = tracker(max_gap=0.5)
    t.update(0, A[None], ("cup",), STILL)
    assert ids(t.update(SECOND // 2, A[None], ("cup",), STILL)) == [0]
    assert ids(t.update(SECOND + 1, A[None], ("cup",), STILL)) == [1]


def test_the_camera_s_rotation_is_undone() -> None:
    """A turn by 15 degrees moves boxes by 143 px in the middle of the image: without knowing it, none is found."""
    R_before_now = Rotation.from_euler("y", 15.0, degrees=True).as_matrix()
    far = np.linalg.inv(CAMERA.K) @ np.array([320.0, 240.0, 1.0])
    now = CAMERA.K @ R_before_now.T @ far
    shift = now[:2] / now[2] - [320.0, 240.0]
    assert abs(shift[0]) > 140.0
    box = np.array([280.0, 200.0, 360.0, 280.0])
    moved = box + np.tile(shift, 2)
    np.testing.assert_allclose(rotated(box[None], R_before_now.T, CAMERA.K)[0], moved, atol=1e-9)
    for R, expected in ((R_before_now.T, [0]), (STILL, [1])):
        t = tracker()
        t.update(0, box[None], ("cup",), STILL)
        assert ids(t.update(1, moved[None], ("cup",), R)) == expected


def test_rotation_adds_up_while_a_track_is_not_seen() -> None:
    turn = Rotation.from_euler("y", -8.0, degrees=True).as_matrix()
    box = np.array([280.0, 200.0, 360.0, 280.0])
    t = tracker()
    t.update(0, box[None], ("cup",), STILL)
    t.update(1, np.empty((0, 4)), (), turn)
    moved = rotated(rotated(box[None], turn, CAMERA.K), turn, CAMERA.K)
    assert ids(t.update(2, moved, ("cup",), turn)) == [0]


def test_a_class_may_be_wrong_once_but_must_then_fit_better() -> None:
    shifted = A + np.array([35.0, 0.0, 35.0, 0.0])  # overlap 0.48
    for class_id, expected in (("cup", [0]), ("book", [1])):
        t = tracker(track_overlap=0.3)
        t.update(0, A[None], ("cup",), STILL)
        assert ids(t.update(1, shifted[None], (class_id,), STILL)) == expected
    t = tracker()
    t.update(0, A[None], ("cup",), STILL)
    t.update(1, A[None], ("cup",), STILL)
    (track,) = t.update(2, A[None], ("book",), STILL)
    assert (track.id, track.class_id, dict(track.classes)) == (0, "cup", {"cup": 2, "book": 1})
