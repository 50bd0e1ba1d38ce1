"""What counts as an object, and as a leap."""

import gtsam
import numpy as np
import pytest

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.graph.plausible import is_object, leapt
from calibslam_msgs_py.measurements import Array

CAMERA = np.array([1.0, 0.0, 0.0])


def vector(centre: tuple[float, float, float], radii: tuple[float, float, float]) -> Array:
    T = np.eye(4)
    T[:3, 3] = centre
    return Ellipsoid(T, np.array(radii)).vector()


@pytest.mark.parametrize(
    ("centre", "radii", "expected"),
    [
        ((0.0, 0.0, 2.0), (0.1, 0.2, 0.3), True),
        ((0.0, 0.0, 2.0), (0.1, 0.2, 9.9), True),
        ((0.0, 0.0, 2.0), (0.1, 0.2, 10.1), False),
        ((0.0, 0.0, 2.0), (0.9e-4, 0.2, 0.3), False),
        ((200.9, 0.0, 0.0), (0.1, 0.2, 0.3), True),  # seen from the camera
        ((201.1, 0.0, 0.0), (0.1, 0.2, 0.3), False),
    ],
)
def test_size_and_place_of_an_object(
    centre: tuple[float, float, float], radii: tuple[float, float, float], expected: bool
) -> None:
    assert is_object(vector(centre, radii)[None], CAMERA[None]).tolist() == [expected]


def test_what_no_camera_has_seen_yet_may_be_anywhere() -> None:
    """The objects of a loaded map."""
    assert is_object(vector((1e4, 0.0, 0.0), (0.1, 0.2, 0.3))[None], np.full((1, 3), np.nan)).tolist() == [True]


@pytest.mark.parametrize("entry", range(9))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_no_object(entry: int, value: float) -> None:
    good = vector((0.0, 0.0, 2.0), (0.1, 0.2, 0.3))
    bad = good.copy()
    bad[entry] = value
    assert is_object(np.stack([bad, good]), np.stack([CAMERA, CAMERA])).tolist() == [False, True]


def test_no_quadrics() -> None:
    assert is_object(np.zeros((0, 9)), np.zeros((0, 3))).tolist() == []


@pytest.mark.parametrize(("angle", "distance", "expected"), [(0.49, 0.49, False), (0.51, 0.0, True), (0.0, 0.51, True)])
def test_a_pose_leaps_beyond_half_a_metre_or_radian(angle: float, distance: float, expected: bool) -> None:
    """About any axis, whatever the pose was: an angle of 0.51 has the chord 2 sin(0.255) = 0.504."""
    old = np.tile(np.eye(4), (3, 1, 1))
    old[1] = gtsam.Pose3(gtsam.Rot3.RzRyRx(1.0, -2.0, 0.5), np.array([3.0, 2.0, 1.0])).matrix()
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    new = old.copy()
    new[1] = old[1] @ gtsam.Pose3(gtsam.Rot3.Expmap(angle * axis), distance * axis).matrix()
    assert leapt(old, new) is expected
    assert not leapt(old, old)
