"""The boxes that ellipsoids project to, against derivatives and sampled surfaces."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numerical import assert_jacobians

from calibslam_backend.geometry.ellipsoid import (
    Ellipsoid,
)
from calibslam_backend.geometry.visible_box import (
    ALL_EDGES,
    POSE,
    QUADRIC,
    UNBOUNDED,
    box_of_visible_part,
    image_bounds,
    project,
)
from calibslam_msgs_py.measurements import Array

K = np.array([[520.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
BOUNDS = image_bounds(640, 480)
SOME_POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.3, 0.4), np.array([0.3, -0.2, 0.1]))
NO_EDGES = ~ALL_EDGES
RADII = (0.3, 0.15, 0.1)


def seen_at(centre: tuple[float, float, float], radii: tuple[float, float, float] = RADII) -> Array:
    """Vector (9,) of a tilted ellipsoid that has this centre in the camera frame of SOME_POSE."""
    rotation = gtsam.Rot3.RzRyRx(0.5, 0.3, -0.7)
    T_map_object = SOME_POSE.compose(gtsam.Pose3(rotation, np.array(centre)))
    return Ellipsoid(T_map_object.matrix(), np.array(radii)).vector()


def surface(ellipsoid: Ellipsoid, n: int = 20_000) -> Array:
    """(N, 3) points spread evenly over directions (a Fibonacci lattice) on the surface, in the world."""
    i = np.arange(n) + 0.5
    z, turn = 1.0 - 2.0 * i / n, np.pi * (1.0 + 5.0**0.5) * i
    r = np.sqrt(1.0 - z**2)
    points = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1) * ellipsoid.radii
    return points @ ellipsoid.T_world_object[:3, :3].T + ellipsoid.T_world_object[:3, 3]


# Where an ellipsoid of 30 cm at 2 m is, in the camera frame: it is cut by one border, by two, or by none.
PLACES = {
    "inside": (0.1, 0.05, 2.0),
    "cut on the left": (-1.15, 0.1, 2.0),
    "cut on the right": (1.2, 0.1, 2.0),
    "cut above": (0.1, -0.9, 2.0),
    "cut below": (0.1, 0.95, 2.0),
    "cut in a corner": (1.15, 0.9, 2.0),
    "wholly outside": (2.5, 0.2, 2.0),
    "near the camera plane": (0.1, 0.05, 0.33),
    "far away": (1.0, 2.0, 30.0),
}


@pytest.mark.parametrize("clip", [ALL_EDGES, NO_EDGES, np.array([True, False, False, True])], ids=str)
@pytest.mark.parametrize("place", PLACES)
def test_derivative_of_a_box(place: str, clip: Array) -> None:
    vector = seen_at(PLACES[place])

    def box(pose: gtsam.Pose3, quadric: Array) -> Array:
        visible, corners, _ = box_of_visible_part(pose.matrix(), quadric, K, BOUNDS, clip)
        assert visible
        return corners

    visible, corners, J = box_of_visible_part(SOME_POSE.matrix(), vector, K, BOUNDS, clip)
    assert visible and np.isfinite(corners).all()
    assert_jacobians(box, [SOME_POSE, vector], [J[:, POSE], J[:, QUADRIC]])


@pytest.mark.parametrize("spread", [0.0, 1e-12, 1e-7, 1e-5, 1.1e-5, 1e-3])
def test_derivative_of_a_box_near_a_sphere(spread: float) -> None:
    """Where radii are equal the formula is a limit; nothing may jump on the way to it."""
    vector = seen_at((0.1, 0.05, 2.0), tuple(0.2 * np.exp(spread * np.array([0.0, 1.0, -1.0]))))

    def box(pose: gtsam.Pose3, quadric: Array) -> Array:
        return np.asarray(box_of_visible_part(pose.matrix(), quadric, K, BOUNDS, ALL_EDGES)[1])

    J = box_of_visible_part(SOME_POSE.matrix(), vector, K, BOUNDS, ALL_EDGES)[2]
    assert_jacobians(box, [SOME_POSE, vector], [J[:, POSE], J[:, QUADRIC]])


def test_clipped_edges_have_no_derivative_and_the_others_go_on() -> None:
    vector = seen_at(PLACES["cut on the right"])
    _, clipped, J = box_of_visible_part(SOME_POSE.matrix(), vector, K, BOUNDS, ALL_EDGES)
    assert clipped[2] == 640.0 and not J[2].any() and J[[0, 1, 3]].any(axis=1).all()
    _, free, J_free = box_of_visible_part(SOME_POSE.matrix(), vector, K, BOUNDS, NO_EDGES)
    assert free[2] > 640.0 and J_free[2].any()
    np.testing.assert_array_equal(free[[0, 1, 3]], clipped[[0, 1, 3]])


def test_skew_of_the_camera_matrix_is_used() -> None:
    skewed = K.copy()
    skewed[0, 1] = 30.0
    vector = seen_at(PLACES["inside"])

    def box(pose: gtsam.Pose3, quadric: Array) -> Array:
        return np.asarray(box_of_visible_part(pose.matrix(), quadric, skewed, BOUNDS, ALL_EDGES)[1])

    _, corners, J = box_of_visible_part(SOME_POSE.matrix(), vector, skewed, BOUNDS, ALL_EDGES)
    assert_jacobians(box, [SOME_POSE, vector], [J[:, POSE], J[:, QUADRIC]])
    points = surface(Ellipsoid.from_vector(vector)) - SOME_POSE.translation()
    pixels = points @ SOME_POSE.rotation().matrix() @ skewed.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    np.testing.assert_allclose(corners, np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]), atol=0.1)


def flat_ellipse(x: float, y: float, half_width: float, half_height: float) -> Array:
    """Vector (9,) of an ellipsoid, seen from the origin, with this outline [px]: far away, so hardly distorted."""
    distance = 1e4
    centre = np.linalg.inv(K) @ np.array([x, y, 1.0]) * distance
    T = np.eye(4)
    T[:3, 3] = centre
    return Ellipsoid(T, np.array([half_width / K[0, 0], half_height / K[1, 1], 0.001]) * distance).vector()


def test_the_example_of_the_truncated_ellipse() -> None:
    """Centre (600, 240), half axes 100 and 50, image 640 wide: the visible part spans 500 190 640 290."""
    _, box, _ = box_of_visible_part(np.eye(4), flat_ellipse(600.0, 240.0, 100.0, 50.0), K, BOUNDS, ALL_EDGES)
    np.testing.assert_allclose(box, [500.0, 190.0, 640.0, 290.0], atol=1e-2)
    # Its highest point lies outside: what is visible is lower.
    _, box, _ = box_of_visible_part(np.eye(4), flat_ellipse(680.0, 240.0, 100.0, 50.0), K, BOUNDS, ALL_EDGES)
    height = 50.0 * np.sqrt(1.0 - 0.4**2)
    np.testing.assert_allclose(box, [580.0, 240.0 - height, 640.0, 240.0 + height], atol=1e-2)


tilts = st.floats(-np.pi, np.pi)
radii = st.floats(0.03, 0.6)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    x=st.floats(-3.0, 3.0), y=st.floats(-2.0, 2.0), z=st.floats(0.7, 5.0), a=tilts, b=tilts, c=tilts,
    r=st.tuples(radii, radii, radii),
)  # fmt: skip
def test_boxes_are_those_of_the_sampled_surface(
    x: float, y: float, z: float, a: float, b: float, c: float, r: tuple[float, float, float]
) -> None:
    """The outline from points on the surface; the box of its visible part from points on the outline's inside."""
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(a, b, c), np.array([x, y, z]))
    ellipsoid = Ellipsoid(pose.matrix(), np.array(r))
    points = surface(ellipsoid)
    assume(points[:, 2].min() > 0.1)
    pixels = points @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    whole = project(pose.matrix()[None], np.array([r]), K)[0]
    sampled = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    size = (whole[2:] - whole[:2]).max()
    np.testing.assert_allclose(sampled, whole, atol=2e-3 * size)
    # Every surface point that the image shows lies in the box of the visible part, and such points come near it.
    inside = ((pixels > BOUNDS[:2]) & (pixels < BOUNDS[2:])).all(axis=1)
    clipped = project(pose.matrix()[None], np.array([r]), K, BOUNDS)[0]
    if not inside.any():
        return
    shown = pixels[inside]
    assert (shown.min(axis=0) >= clipped[:2] - 1e-6).all() and (shown.max(axis=0) <= clipped[2:] + 1e-6).all()
    if np.count_nonzero(inside) > 2000:
        extent = np.concatenate([shown.min(axis=0), shown.max(axis=0)])
        np.testing.assert_allclose(extent, clipped, atol=0.03 * size)


def test_what_is_not_wholly_in_front_has_no_box() -> None:
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, 2, 3] = [2.0, 0.1, -2.0, 0.0]  # in front, around the camera plane, behind, around the camera
    boxes = project(T, np.full((4, 3), 0.2), K)
    assert np.isfinite(boxes[0]).all() and np.isnan(boxes[1:]).all()
    T[0, 0, 3] = 20.0  # in front, but far outside the image
    assert np.isfinite(project(T[:1], np.full((1, 3), 0.2), K)).all()
    assert np.isnan(project(T[:1], np.full((1, 3), 0.2), K, BOUNDS)).all()


def test_an_image_without_borders_is_the_default() -> None:
    assert not np.isfinite(UNBOUNDED).any()
    np.testing.assert_array_equal(image_bounds(640, 480), [0.0, 0.0, 640.0, 480.0])
