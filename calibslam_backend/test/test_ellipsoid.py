"""Ellipsoids, their vectors, and their covariances against sampling."""

from __future__ import annotations

import gtsam
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibslam_backend.geometry.ellipsoid import (
    Ellipsoid,
    covariance_of_pose_and_radii,
    covariance_of_vector,
    matrix_from_vector,
    vector_from_matrix,
)
from calibslam_msgs_py.measurements import Array

tilts = st.floats(-np.pi, np.pi)
radii = st.floats(0.03, 0.6)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(a=tilts, b=tilts, c=tilts, r=st.tuples(radii, radii, radii), t=st.tuples(tilts, tilts, tilts))
def test_vector_and_ellipsoid_are_the_same_set(
    a: float, b: float, c: float, r: tuple[float, float, float], t: tuple[float, float, float]
) -> None:
    """The axes may come back in another order, but S = R diag(r^2) R^T is the same."""
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(a, b, c), np.array(t)).matrix()
    given_one = Ellipsoid(T, np.array(r))
    vector = given_one.vector()
    back = Ellipsoid.from_vector(vector)
    np.testing.assert_allclose(np.sort(r), back.radii, rtol=1e-9)
    R = back.T_world_object[:3, :3]
    np.testing.assert_allclose(np.linalg.det(R), 1.0, rtol=1e-9)
    shapes = [(e.T_world_object[:3, :3] * e.radii**2) @ e.T_world_object[:3, :3].T for e in (given_one, back)]
    np.testing.assert_allclose(shapes[0], shapes[1], atol=1e-9)
    np.testing.assert_allclose(back.vector(), vector, atol=1e-9)


def test_logarithmic_shapes_keep_their_norm() -> None:
    """So that one standard deviation for all six components is a prior that knows no direction."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        A = rng.normal(size=(3, 3))
        L = A + A.T
        v = vector_from_matrix(L)
        np.testing.assert_allclose(np.linalg.norm(v), np.linalg.norm(L))
        np.testing.assert_allclose(matrix_from_vector(v), L)
        R = Rotation.random(rng=rng).as_matrix()
        np.testing.assert_allclose(np.linalg.norm(vector_from_matrix(R @ L @ R.T)), np.linalg.norm(v))


def test_the_prior_does_not_depend_on_how_the_map_is_turned() -> None:
    """Two ellipsoids, turned together, stay as far apart in units of the prior."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        a, b = (
            Ellipsoid(gtsam.Pose3(gtsam.Rot3(Rotation.random(rng=rng).as_matrix()), rng.normal(size=3)).matrix(), r)
            for r in np.exp(rng.normal(-1.5, 0.5, size=(2, 3)))
        )
        T = np.eye(4)
        T[:3, :3] = Rotation.random(rng=rng).as_matrix()
        turned = [Ellipsoid(T @ e.T_world_object, e.radii).vector() for e in (a, b)]
        difference, difference_turned = a.vector() - b.vector(), turned[0] - turned[1]
        for part in (slice(0, 3), slice(3, 9)):
            np.testing.assert_allclose(np.linalg.norm(difference[part]), np.linalg.norm(difference_turned[part]))


def tangent(reference: Ellipsoid, ellipsoid: Ellipsoid) -> Array:
    """(9,) rotation, translation in the body, radii, between ellipsoids with the same order of axes."""
    R = reference.T_world_object[:3, :3].T @ ellipsoid.T_world_object[:3, :3]
    R = R * np.sign(np.diag(R))  # an axis and its opposite are one axis
    t = reference.T_world_object[:3, :3].T @ (ellipsoid.T_world_object[:3, 3] - reference.T_world_object[:3, 3])
    return np.concatenate([Rotation.from_matrix(R).as_rotvec(), t, ellipsoid.radii - reference.radii])


def test_covariance_of_pose_and_radii_against_sampling() -> None:
    """50,000 samples: entries agree within 4 % of the product of their standard deviations (5 sigma: 2.2 %)."""
    rng = np.random.default_rng(2)
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.5, 0.3, -0.7), np.array([1.0, 2.0, 3.0])).matrix()
    vector = Ellipsoid(T, np.array([0.1, 0.2, 0.45])).vector()
    A = rng.normal(size=(9, 9))
    covariance = (A @ A.T + 2.0 * np.eye(9)) * 1e-5
    reference = Ellipsoid.from_vector(vector)
    samples = rng.multivariate_normal(vector, covariance, size=50_000)
    sampled = np.cov(np.stack([tangent(reference, Ellipsoid.from_vector(v)) for v in samples]).T)
    analytic = covariance_of_pose_and_radii(vector, covariance)
    sigmas = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(analytic / np.outer(sigmas, sigmas), sampled / np.outer(sigmas, sigmas), atol=0.04)


def test_covariance_of_pose_and_radii_has_its_inverse() -> None:
    rng = np.random.default_rng(3)
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.5, 0.3, -0.7), np.array([1.0, 2.0, 3.0])).matrix()
    vector = Ellipsoid(T, np.array([0.1, 0.2, 0.45])).vector()
    A = rng.normal(size=(9, 9))
    covariance = (A @ A.T + np.eye(9)) * 1e-6
    ellipsoid = Ellipsoid.from_vector(vector)
    there = covariance_of_pose_and_radii(vector, covariance)
    back = covariance_of_vector(ellipsoid.T_world_object, ellipsoid.radii, there)
    # Rotations are held within their half circle on the way, and a floor of 1e-9 comes on the way back.
    np.testing.assert_allclose(back, covariance, atol=2e-4 * np.abs(covariance).max() + 1e-9)


def test_a_sphere_has_no_known_rotation() -> None:
    vector = Ellipsoid(np.eye(4), np.full(3, 0.2)).vector()
    covariance = covariance_of_pose_and_radii(vector, np.eye(9) * 1e-4)
    assert np.isfinite(covariance).all()
    np.testing.assert_allclose(np.diag(covariance)[:3], np.pi**2 / 12.0, rtol=1e-6)
    np.testing.assert_allclose(np.diag(covariance)[6:], 0.2**2 * 1e-4, rtol=1e-9)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12
    assert np.linalg.eigvalsh(covariance_of_vector(np.eye(4), np.full(3, 0.2), covariance)).min() > 0.0
