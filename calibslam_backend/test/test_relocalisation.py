"""Where the camera is by the objects it sees: exact boxes of eight objects, a prediction that is 0.8 m off."""

from __future__ import annotations

import numpy as np
import pytest

from calibslam_backend.association.relocalisation import RelocalisationSettings, Relocalised, overlaps_at, relocalise
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part, image_bounds
from calibslam_backend.kernels import load_kernels
from calibslam_msgs_py.measurements import Array

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
BOUNDS = image_bounds(640, 480)
N = 8
TRUE = np.eye(4)
OFF = np.eye(4)
OFF[:3, 3] = [0.8, 0.1, -0.2]


def quadrics() -> Array:
    """(8, 9) balls of different sizes, in front of a camera at the origin."""
    rng = np.random.default_rng(0)
    vectors = []
    for n in range(N):
        T = np.eye(4)
        T[:3, 3] = [0.35 * (n % 4) - 0.5, 0.4 * (n // 4) - 0.2, rng.uniform(1.8, 2.6)]
        vectors.append(Ellipsoid(T, np.full(3, rng.uniform(0.05, 0.12))).vector())
    return np.stack(vectors)


def found(predicted: Array | None, plausible: bool = True) -> Relocalised | None:
    load_kernels()
    vectors = quadrics()
    boxes = []
    for vector in vectors:
        visible, corners, _ = box_of_visible_part(TRUE, vector, K, BOUNDS, ~ALL_EDGES)
        assert visible
        boxes.append(BoxMeasurement(corners, np.eye(4) / 2.0, BOUNDS, ~ALL_EDGES))
    return relocalise(
        predicted,
        boxes,
        vectors,
        np.ones((N, N), bool),
        K,
        (640, 480),
        2.0,
        RelocalisationSettings(),
        lambda T: plausible,
    )


@pytest.mark.parametrize("predicted", [OFF, None], ids=["near", "anywhere"])
def test_the_pose_that_explains_the_boxes(predicted: Array | None) -> None:
    result = found(predicted)
    assert result is not None
    np.testing.assert_allclose(result.T_map_camera, TRUE, atol=1e-3)
    assert sorted(result.pairs) == [(n, n) for n in range(N)]


def test_a_prediction_that_explains_as_much_stays() -> None:
    assert found(TRUE) is None


def test_a_pose_that_cannot_be_is_not_found() -> None:
    assert found(OFF, plausible=False) is None


def test_overlaps_by_hand() -> None:
    """A ball of 0.1 m, 2 m away, shows as 50 px around the middle, to 0.2 %: against that, half of it, and none."""
    T = np.eye(4)
    T[2, 3] = 2.0
    load_kernels()
    surface = np.eye(3)[None] * 0.1**2
    corners = np.array([[295.0, 215.0, 345.0, 265.0], [295.0, 215.0, 320.0, 265.0], [0.0, 0.0, 10.0, 10.0]])
    everything = np.ones((3, 1), bool)
    size = np.array([640.0, 480.0])
    result = overlaps_at(np.eye(4), T[None, :3, 3].copy(), surface, K, size, corners, everything)
    np.testing.assert_allclose(result[:, 0], [1.0, 0.5, 0.0], atol=6e-3)
    assert not overlaps_at(np.eye(4), T[None, :3, 3].copy(), surface, K, size, corners, ~everything).any()
