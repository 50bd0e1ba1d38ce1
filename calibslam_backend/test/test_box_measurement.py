"""Boxes made ready: undistorted, whitened, their edges at the image border marked."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibslam_backend.geometry.box_measurement import BORDER, BORDER_SIGMAS, prepare, undistorted
from calibslam_msgs_py.measurements import Array, Boxes, Camera

# TUM fr1, as published by its authors.
FR1 = Camera(
    640,
    480,
    np.array([[517.306408, 0.0, 318.643040], [0.0, 516.469215, 255.313989], [0.0, 0.0, 1.0]]),
    np.array([0.262383, -0.953104, -0.005358, 0.002628, 1.163314]),
)
RECTIFIED = Camera(640, 480, FR1.K, np.zeros(5))


def boxes_with(corners: Array, camera: Camera = FR1) -> Boxes:
    n = len(corners)
    names = tuple("" for _ in range(n))
    return Boxes(0, camera.width, camera.height, corners, np.full((n, 4, 4), np.nan), names, np.ones(n), names)


def distorted(points: Array) -> Array:
    """(N, 2) pinhole pixels -> (N, 2) pixels of the distorted image, by OpenCV's projection."""
    rays = np.linalg.solve(FR1.K, np.concatenate([points, np.ones((len(points), 1))], axis=1).T).T
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), FR1.K, FR1.distortion)[0].reshape(-1, 2)


def test_distorting_again_gives_the_measured_edges() -> None:
    """The middle of each undistorted edge, distorted by OpenCV's own model, lies on the measured edge."""
    rng = np.random.default_rng(0)
    low = rng.uniform([20.0, 20.0], [400.0, 300.0], size=(50, 2))
    corners = np.concatenate([low, low + rng.uniform(20.0, 180.0, size=(50, 2))], axis=1)
    straight = undistorted(corners, FR1)
    # Where the edges' middles are in the pinhole image: the other coordinate is not part of the result.
    x, y = corners[:, [0, 2]].mean(axis=1), corners[:, [1, 3]].mean(axis=1)
    for edge, middles in enumerate(
        (np.stack([corners[:, 0], y], 1), np.stack([x, corners[:, 1]], 1),
         np.stack([corners[:, 2], y], 1), np.stack([x, corners[:, 3]], 1))
    ):  # fmt: skip
        pinhole = cv2.undistortPoints(middles.reshape(-1, 1, 2), FR1.K, FR1.distortion, P=FR1.K).reshape(-1, 2)
        axis = edge % 2
        pinhole[:, axis] = straight[:, edge]
        np.testing.assert_allclose(distorted(pinhole)[:, axis], corners[:, edge], atol=0.05)
    assert np.abs(straight - corners).max() > 2.0  # it does something


def test_a_rectified_camera_changes_nothing() -> None:
    corners = np.array([[1.0, 2.0, 300.0, 400.0]])
    result = undistorted(corners, RECTIFIED)
    np.testing.assert_array_equal(result, corners)
    assert result is not corners
    assert undistorted(np.empty((0, 4)), FR1).shape == (0, 4)


@pytest.mark.parametrize("sigma, margin", [(0.01, BORDER), (4.0, BORDER_SIGMAS * 4.0)], ids=["sure", "unsure"])
@pytest.mark.parametrize("camera", [FR1, RECTIFIED], ids=["distorted", "rectified"])
def test_edges_on_the_border_are_marked(camera: Camera, sigma: float, margin: float) -> None:
    """Those nearer to it than three standard deviations, or two pixels."""
    beyond = margin + 0.1
    corners = np.array(
        [
            [100.0, 100.0, 200.0, 200.0],
            [margin, 100.0, 200.0, 200.0],
            [100.0, 0.0, 200.0, 200.0],
            [100.0, 100.0, 640.0 - margin, 480.0],
            [beyond, beyond, 640.0 - beyond, 480.0 - beyond],
            [-5.0, -5.0, 650.0, 490.0],
        ]
    )
    covariances = np.tile(np.eye(4) * sigma**2, (6, 1, 1))
    clips = np.stack([m.clip for m in prepare(boxes_with(corners, camera), covariances, camera)])
    expected = ["0000", "1000", "0100", "0011", "0000", "1111"]
    assert ["".join(str(int(c)) for c in clip) for clip in clips] == expected


def test_distances_to_the_border_by_hand() -> None:
    found = boxes_with(np.array([[10.0, 20.0, 600.0, 470.0], [-5.0, 0.0, 650.0, 480.0]])).to_border
    np.testing.assert_array_equal(found, [[10.0, 20.0, 40.0, 10.0], [-5.0, 0.0, -10.0, 0.0]])


def test_each_edge_has_its_own_deviation() -> None:
    corners = np.array([[10.0, 10.0, 630.0, 470.0]])
    (box,) = prepare(boxes_with(corners), np.diag([16.0, 4.0, 4.0, 16.0])[None], FR1)
    assert box.clip.tolist() == [True, False, False, True]


def test_bounds_are_where_the_border_lies_beside_the_box() -> None:
    """A box whose edge is on the border of the distorted image has this edge on its bounds in the pinhole image."""
    corners = np.array([[0.0, 60.0, 120.0, 300.0], [500.0, 0.0, 640.0, 480.0]])
    covariances = np.tile(np.eye(4), (2, 1, 1))
    left, right = prepare(boxes_with(corners), covariances, FR1)
    assert left.bounds[0] == pytest.approx(left.corners[0], abs=1e-6)
    for edge in (1, 2, 3):
        assert right.bounds[edge] == pytest.approx(right.corners[edge], abs=1e-6)
    (plain,) = prepare(boxes_with(corners[:1], RECTIFIED), covariances[:1], RECTIFIED)
    np.testing.assert_array_equal(plain.bounds, [0.0, 0.0, 640.0, 480.0])


def test_whitening_gives_the_mahalanobis_distance() -> None:
    covariance = np.array([[4.0, 1, 0.5, 0], [1, 9, 0, 0.5], [0.5, 0, 5, -1], [0, 0.5, -1, 6]])
    (measurement,) = prepare(boxes_with(np.array([[10.0, 20, 30, 40]])), covariance[None], FR1)
    r = np.array([1.0, -2.0, 3.0, 0.5])
    whitened = measurement.whitener @ r
    np.testing.assert_allclose(whitened @ whitened, r @ np.linalg.solve(covariance, r))
