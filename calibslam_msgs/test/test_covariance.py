"""The two orders of covariance against sampling, and what counts as a covariance."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibslam_msgs_py.covariance import (
    gtsam_from_ros_covariance,
    is_covariance,
    ros_from_gtsam_covariance,
    symmetric,
)


def random_covariance(rng: np.random.Generator, n: int, scale: float) -> np.ndarray:
    A = rng.normal(size=(n, n))
    return scale**2 * (A @ A.T + 0.1 * np.eye(n))


def test_ros_covariance_is_that_of_sampled_poses() -> None:
    """GTSAM perturbs on the right; ROS states the error of x y z and of the rotation about fixed axes."""
    rng = np.random.default_rng(0)
    pose = gtsam.Pose3(gtsam.Rot3(Rotation.from_rotvec([0.4, -1.1, 0.8]).as_matrix()), np.array([1.0, -2.0, 3.0]))
    R, t = pose.rotation().matrix(), pose.translation()
    covariance = random_covariance(rng, 6, 1e-3)

    tangents = rng.multivariate_normal(np.zeros(6), covariance, size=100_000)
    # Whitened with the exact root, the samples have exactly this covariance: no sampling error remains.
    tangents -= tangents.mean(axis=0)
    L = np.linalg.cholesky(np.cov(tangents.T, bias=True))
    tangents = tangents @ np.linalg.inv(L).T @ np.linalg.cholesky(covariance).T
    errors = np.empty((2_000, 6))
    for row, tangent in zip(errors, tangents[: len(errors)], strict=True):
        perturbed = pose.compose(gtsam.Pose3.Expmap(tangent))
        row[:3] = perturbed.translation() - t
        row[3:] = Rotation.from_matrix(perturbed.rotation().matrix() @ R.T).as_rotvec()
    sampled = tangents[: len(errors)]
    expected = ros_from_gtsam_covariance(sampled.T @ sampled / len(sampled), R)
    np.testing.assert_allclose(errors.T @ errors / len(errors), expected, atol=5e-3 * expected.max())


def test_orders_are_inverse() -> None:
    rng = np.random.default_rng(1)
    R = Rotation.random(random_state=2).as_matrix()
    covariance = random_covariance(rng, 6, 1.0)
    there_and_back = gtsam_from_ros_covariance(ros_from_gtsam_covariance(covariance, R), R)
    np.testing.assert_allclose(there_and_back, covariance, atol=1e-12)


def test_identity_rotation_only_swaps_the_blocks() -> None:
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    swapped = ros_from_gtsam_covariance(covariance, np.eye(3))
    np.testing.assert_array_equal(np.diag(swapped), [4.0, 5.0, 6.0, 1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (np.eye(2), True),
        (np.diag([1e-12, 1e6]), True),  # units differ, nothing is singular
        (np.array([[1.0, 0.5], [0.5, 1.0]]), True),
        (np.array([[1.0, 0.5], [0.4, 1.0]]), False),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), False),
        (np.array([[1.0, 1.0], [1.0, 1.0]]), False),
        (np.zeros((2, 2)), False),
        (np.diag([1.0, -1.0]), False),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), False),
        (np.diag([1.0, np.inf]), False),
    ],
)
def test_is_covariance(matrix: np.ndarray, expected: bool) -> None:
    assert bool(is_covariance(matrix)) is expected


def test_is_covariance_of_many() -> None:
    np.testing.assert_array_equal(is_covariance(np.stack([np.eye(3), -np.eye(3)])), [True, False])
    assert is_covariance(np.empty((0, 4, 4))).shape == (0,)


def test_symmetric_is_exact() -> None:
    A = np.random.default_rng(0).normal(size=(4, 4))
    assert (symmetric(A) == symmetric(A).T).all()
