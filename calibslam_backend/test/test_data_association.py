"""Boxes beside the quadrics that they are of, since the camera is not where it is thought to be: cups, by hand."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from small_map import CAMERA, FRAMES, LEFT, RIGHT, World

from calibslam_backend.association.matching import GIVEN, predicted_corners
from calibslam_backend.geometry.box_measurement import cut_alike
from calibslam_backend.graph.known import Known
from calibslam_backend.graph.measured import Motion
from calibslam_backend.graph.noise import QUADRICSLAM
from calibslam_msgs_py.measurements import Array, Boxes

AT_BORDER = (-0.73, 0.0, 2.0)  # its left half is outside the image of the last keyframe, where odometry is right
BESIDE_IT = (-0.63, 0.0, 2.0)
OFF = 0.1  # [m] that odometry errs by in the last motion, to the left: 25 px at a cup that is 30 px wide
NEARLY_RIGHT = 0.005  # [m, rad]: 1 and 2.5 px


def lost(
    *seen: tuple[tuple[float, float, float], int],
    sigma: float = 0.05,
    off: float = OFF,
    name: str = "cup",
    known: tuple[tuple[float, float, float], ...] = (LEFT, RIGHT),
    **settings: str,
) -> World:
    """A map of cups that are known, and a keyframe, a motion of deviation `sigma` [rad, m] later, that shows cups.

    Its boxes carry the class `cup`, the cups of the map this one.
    """
    world = World(**settings)
    for j, place in enumerate(known):
        world.books.know(j, Known(world.cup(place), np.eye(9) * 1e-6), Counter({name: 1}))
    for _ in range(FRAMES):
        world.show()
    motion = Motion(np.eye(4), np.eye(6) * sigma**2, 0.0, np.eye(4))
    world.graph.add_pose(motion, world.graph.predict(motion))
    world.graph.update()
    world.show(*seen, seen_from=beside(world.graph.pose(FRAMES - 1), off))
    return world


def beside(T_map_camera: Array, off: float) -> Array:
    """(4, 4), so far to the right of a pose."""
    moved = np.array(T_map_camera)
    moved[:3, 3] += off * moved[:3, 0]
    return moved


def test_boxes_that_the_pose_explains_are_given_and_put_it_right() -> None:
    world = lost((LEFT, 0), (RIGHT, 1))
    assert world.upkeep.revise() == 0  # takes the pose as it is
    assert world.objects.give_open(FRAMES) == 2
    assert [world.keyframes(j) for j in (0, 1)] == [[FRAMES]] * 2
    assert world.books.frames[FRAMES].quadrics == [0, 1]
    assert world.counts["given_late"] == 2
    for _ in range(3):
        world.graph.iterate()
    for place, box in zip((LEFT, RIGHT), world.books.frames[FRAMES].boxes, strict=True):
        found = predicted_corners(world.graph.pose(FRAMES), world.cup(place), CAMERA.K, box)
        np.testing.assert_allclose(found, box.corners, atol=1.0)  # 25 px before
    assert world.upkeep.revise() == 0 and world.objects.give_open(FRAMES) == 0


def test_boxes_that_are_cut_differently_are_each_predicted_as_they_are_cut() -> None:
    """A cup of which the border cuts off a half, and a whole one beside it, in either order.

    What is left of the first might well be the second, if the first were expected whole.
    """
    places = (BESIDE_IT, AT_BORDER)
    for order in ((0, 1), (1, 0)):
        seen = ((places[j], track) for track, j in enumerate(order))
        world = lost(*seen, known=places, off=NEARLY_RIGHT, sigma=NEARLY_RIGHT)
        boxes = world.books.frames[FRAMES].boxes
        assert [bool(box.clip[0]) for box in boxes] == [places[j] == AT_BORDER for j in order]
        assert cut_alike(boxes) == [[0], [1]] and cut_alike([boxes[0]] * 2) == [[0, 1]]
        assert world.objects.give_open(FRAMES) == 2
        assert world.books.frames[FRAMES].quadrics == list(order)


def test_a_pose_that_is_known_explains_nothing_beside_it() -> None:
    world = lost((LEFT, 0), (RIGHT, 1), sigma=0.002)
    assert world.objects.give_open(FRAMES) == 0
    assert world.books.frames[FRAMES].quadrics == [None, None]


@pytest.mark.parametrize("x", [OFF, -OFF])
def test_what_may_be_of_either_stays_open(x: float) -> None:
    """A box half way between where two cups are expected, or 50 px nearer to one, where the pose may be 112 px off."""
    assert lost(((x, 0.0, 2.0), 0), sigma=0.2).objects.give_open(FRAMES) == 0


@pytest.mark.parametrize("settings", [{"name": "bottle"}, {"association": GIVEN}])
def test_other_classes_and_given_identities_are_left_alone(settings: dict[str, str]) -> None:
    assert lost((LEFT, 0), (RIGHT, 1), **settings).objects.give_open(FRAMES) == 0


def test_quadricslam_knows_the_boxes_that_a_track_had_before_it_was_bound() -> None:
    """The spread of sizes is that of the object, not of what was seen of it since it has a quadric (eq. 4.3.1)."""
    world = World(noise_model=QUADRICSLAM)
    boxes = [Boxes(k, 640, 480, np.array([[100.0, 100.0, 120.0 + 10.0 * (k % 2), 120.0]]), np.full((1, 4, 4), np.nan),
                   ("cup",), np.ones(1), ("",)) for k in range(4)]  # fmt: skip
    variances = []
    for k, each in enumerate(boxes):
        world.books.see([0], each.class_ids)
        frame = world.objects.frame(each, [0])
        variances.append(frame.boxes[0].covariance[0, 0])
        world.books.frames.append(frame)
        world.books.tracks[0].seen.append((k, 0))
        if k == 1:
            world.books.know(0, Known(world.cup(LEFT), np.eye(9)), Counter(cup=1))
            world.objects.bind(0, 0)
        elif k > 1:
            world.books.give(k, 0, 0)
    # Widths 20, 30, 20, 30: no spread yet (5 px), then deviations 5, sqrt(200 / 9) and 5.
    np.testing.assert_allclose(variances, [25.0, 25.0, 200.0 / 9.0, 25.0])
