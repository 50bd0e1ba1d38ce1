"""One object in several tracks of one or two boxes: exact boxes of balls before a camera that moves sideways."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part, image_bounds
from calibslam_backend.objects import joining
from calibslam_backend.objects.initialisation import InitialisationSettings
from calibslam_backend.objects.joining import Glimpse, Joined, join, rays_meet
from calibslam_msgs_py.measurements import Array

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
BOUNDS = image_bounds(640, 480)
LEFT, RIGHT = (-0.3, 0.0, 2.0), (0.3, 0.0, 2.0)  # [m]


def ball(place: tuple[float, float, float], radius: float = 0.06) -> Array:
    T = np.eye(4)
    T[:3, 3] = place
    return Ellipsoid(T, np.full(3, radius)).vector()


def glimpse(place: tuple[float, float, float], *keyframes: int, radius: float = 0.06) -> Glimpse:
    """The ball there, seen in these keyframes, which are 5 cm apart."""
    poses = np.tile(np.eye(4), (len(keyframes), 1, 1))
    poses[:, 0, 3] = 0.05 * np.array(keyframes)
    boxes = []
    for pose in poses:
        visible, corners, _ = box_of_visible_part(pose, ball(place, radius), K, BOUNDS, ~ALL_EDGES)
        assert visible
        boxes.append(BoxMeasurement(corners, np.eye(4) / 2.0, BOUNDS, ~ALL_EDGES))
    return Glimpse(keyframes, poses, boxes)


def joined(glimpses: list[Glimpse], **demanded: int) -> list[Joined]:
    return join(glimpses, K, 2.0, InitialisationSettings(**demanded))  # type: ignore[arg-type]


def test_what_is_seen_now_and_then_is_one_object() -> None:
    [found] = joined([glimpse(LEFT, 0), glimpse(LEFT, 4), glimpse(LEFT, 7, 8), glimpse(LEFT, 11)])
    assert found.glimpses == [0, 1, 2, 3]
    np.testing.assert_allclose(found.vector[:3], LEFT, atol=0.02)


def test_fewer_boxes_than_an_object_needs_are_none() -> None:
    three = [glimpse(LEFT, 0), glimpse(LEFT, 4), glimpse(LEFT, 8)]
    assert joined(three) == []
    assert [found.glimpses for found in joined(three, min_boxes=3)] == [[0, 1, 2]]


def test_one_track_is_not_joined_with_itself() -> None:
    assert joined([glimpse(LEFT, 0, 3, 6, 9)]) == []


def test_views_from_one_place_do_not_tell_where_it_is() -> None:
    still = glimpse(LEFT, 0)
    same = [Glimpse((k,), still.poses, still.boxes) for k in range(6)]
    assert joined(same) == []


def test_an_object_has_one_box_in_an_image() -> None:
    """Two detections of one ball in the same images."""
    glimpses = [glimpse(LEFT, 0, 6), glimpse(LEFT, 0, 6), glimpse(LEFT, 3, 9)]
    [found] = joined(glimpses)
    assert len(found.glimpses) == 2
    assert 2 in found.glimpses


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(12)), st.permutations(range(12)), st.permutations(range(12)))
def test_neighbours_are_told_apart(left: list[int], right: list[int], order: list[int]) -> None:
    """Two balls, each in six glimpses of two keyframes, however they are cut and in whatever order they come."""
    cut = [glimpse(LEFT, *sorted(left[n : n + 2])) for n in range(0, 12, 2)]
    cut += [glimpse(RIGHT, *sorted(right[n : n + 2])) for n in range(0, 12, 2)]
    found = joined([cut[n] for n in order])
    groups = sorted(sorted(order[n] for n in each.glimpses) for each in found)
    for group in groups:
        assert {n < 6 for n in group} in ({True}, {False})
    assert groups == [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 10, 11]]


def test_of_a_crowd_the_glimpses_of_most_boxes_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joining, "MOST", 2)
    [found] = joined([glimpse(RIGHT, 5), glimpse(LEFT, 0, 2), glimpse(RIGHT, 10), glimpse(LEFT, 7, 9)])
    assert found.glimpses == [1, 3]


@pytest.mark.parametrize(
    ("other", "meets"),
    [
        (glimpse(LEFT, 8), True),
        (glimpse(LEFT, 0), False),  # the same image
        (glimpse((-0.3, 0.3, 2.0), 8), False),  # passes 0.3 m below, more than twice the radius
        (glimpse(LEFT, 8, radius=0.3), False),  # five times as large
        (glimpse((0.5, 0.0, 2.0), 8), False),  # the rays part: they would meet behind the cameras
    ],
    ids=["same", "one image", "below", "larger", "behind"],
)
def test_rays_meet(other: Glimpse, meets: bool) -> None:
    meeting = rays_meet([glimpse(LEFT, 0), other], K)
    np.testing.assert_array_equal(meeting, [[False, meets], [meets, False]])
