"""The factor of a box: its error against the robust likelihood, its Jacobian against numerical derivatives."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numerical import assert_jacobians

from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part, image_bounds
from calibslam_backend.graph.box_correlation import BoxCorrelation
from calibslam_backend.graph.box_factor import INVISIBLE, box_factor, box_tangents, pose_information, whitened_residual
from calibslam_msgs_py.measurements import Array

K = np.array([[520.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
BOUNDS = image_bounds(640, 480)
POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.3, 0.4), np.array([0.3, -0.2, 0.1]))
X, Q = 0, 1
COVARIANCE = np.array([[4.0, 1, 0.5, 0], [1, 9, 0, 0.5], [0.5, 0, 5, -1], [0, 0.5, -1, 6]])


def quadric_at(x: float, y: float, z: float) -> Array:
    T = POSE.compose(gtsam.Pose3(gtsam.Rot3.RzRyRx(0.5, 0.3, -0.7), np.array([x, y, z])))
    return Ellipsoid(T.matrix(), np.array([0.3, 0.15, 0.1])).vector()


def factor_of(corners: Array, k: float, clip: Array = ~ALL_EDGES) -> gtsam.CustomFactor:
    whitener = np.linalg.inv(np.linalg.cholesky(COVARIANCE))
    return box_factor(X, Q, BoxMeasurement(corners, whitener, BOUNDS, clip), K, k)


def values_of(pose: gtsam.Pose3, quadric: Array) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(X, pose)
    values.insert(Q, quadric)
    return values


def predicted(quadric: Array, clip: Array = ~ALL_EDGES) -> Array:
    return np.asarray(box_of_visible_part(POSE.matrix(), quadric, K, BOUNDS, clip)[1])


def linearised(factor: gtsam.CustomFactor, values: gtsam.Values) -> tuple[Array, Array]:
    """Jacobian (4, 15) by pose and quadric, and right-hand side (4,), as the optimisers get them."""
    A, b = factor.linearize(values).jacobian()
    return A, b


PLACES = [(0.1, 0.05, 2.0), (1.2, 0.1, 2.0), (1.15, 0.9, 2.0), (3.0, 0.0, 2.0), (0.1, 0.0, 0.35)]
directions = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda d: np.linalg.norm(d) > 0.1)
sizes = st.sampled_from([0.0, 1e-6, 1e-3, 1.0, 10.0, 100.0, 3000.0])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(direction=directions, size=sizes, place=st.sampled_from(PLACES))
def test_derivative_of_the_residual(
    direction: tuple[float, ...], size: float, place: tuple[float, float, float]
) -> None:
    """Whitened: in the image, at its border, outside and near the camera plane, for tiny and for gross errors."""
    quadric, whitener = quadric_at(*place), np.linalg.inv(np.linalg.cholesky(COVARIANCE))
    offset = size * np.array(direction)
    corners = predicted(quadric) + offset

    def residual(pose: gtsam.Pose3, vector: Array) -> Array:
        return np.asarray(whitened_residual(pose.matrix(), vector, K, corners, whitener, BOUNDS, ~ALL_EDGES)[1])

    visible, r, J = whitened_residual(POSE.matrix(), quadric, K, corners, whitener, BOUNDS, ~ALL_EDGES)
    assert visible
    np.testing.assert_allclose(r @ r, offset @ np.linalg.solve(COVARIANCE, offset), rtol=1e-3, atol=1e-9)
    assert_jacobians(residual, [POSE, quadric], [J[:, :6], J[:, 6:]])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(direction=directions, size=sizes, k=st.sampled_from([0.5, 2.0, 1e6]), place=st.sampled_from(PLACES))
def test_gradient_of_the_factor(
    direction: tuple[float, ...], size: float, k: float, place: tuple[float, float, float]
) -> None:
    """What the optimisers linearise is the factor's own error: -A^T b is its gradient."""
    quadric = quadric_at(*place)
    factor = factor_of(predicted(quadric) + size * np.array(direction), k)

    def error(pose: gtsam.Pose3, vector: Array) -> Array:
        return np.array([factor.error(values_of(pose, vector))])

    A, b = linearised(factor, values_of(POSE, quadric))
    gradient = -(A.T @ b)[None]
    if size > 1e-5:  # below, differences of the error are lost in its rounding
        assert_jacobians(error, [POSE, quadric], [gradient[:, :6], gradient[:, 6:]], rtol=1e-3)
    else:
        assert np.abs(gradient).max() < 1.0


@pytest.mark.parametrize("k", [0.5, 2.0, 10.0])
@pytest.mark.parametrize("size", [1e-5, 0.1, 3.0, 50.0, 1e4])
def test_error_is_the_robust_likelihood(size: float, k: float) -> None:
    """2 error = q = r^T Sigma^-1 r up to k^2, k^2 (1 + log(q / k^2)) beyond."""
    quadric = quadric_at(0.1, 0.05, 2.0)
    r = size * np.array([1.0, -2.0, 0.5, 1.0])
    q = r @ np.linalg.solve(COVARIANCE, r)
    error = factor_of(predicted(quadric) - r, k).error(values_of(POSE, quadric))
    assert 2.0 * error == pytest.approx(q if q < k**2 else k**2 * (1.0 + np.log(q / k**2)), rel=1e-6, abs=1e-12)


def test_without_a_robust_loss_it_is_the_mahalanobis_distance() -> None:
    quadric = quadric_at(0.1, 0.05, 2.0)
    r = np.array([10.0, -20.0, 5.0, 10.0])
    error = factor_of(predicted(quadric) - r, 1e6).error(values_of(POSE, quadric))
    assert 2.0 * error == pytest.approx(r @ np.linalg.solve(COVARIANCE, r), rel=1e-6)


def test_an_edge_on_the_border_is_met_by_whatever_lies_beyond() -> None:
    """The object reaches at least that far: how much farther is all the same, short of it is not."""
    clip = np.array([False, False, True, False])
    for x in (1.2, 1.4):
        quadric = quadric_at(x, 0.1, 2.0)
        box = predicted(quadric, clip)
        assert box[2] == 640.0
        A, b = linearised(factor_of(box, 2.0, clip), values_of(POSE, quadric))
        assert not b.any()
        np.testing.assert_allclose((np.linalg.cholesky(COVARIANCE) @ A)[2], 0.0, atol=1e-9)
    quadric = quadric_at(0.1, 0.1, 2.0)
    reaching = np.where(clip, 640.0, predicted(quadric))
    assert factor_of(reaching, 2.0, clip).error(values_of(POSE, quadric)) > 5.0


@pytest.mark.parametrize("z", [-2.0, -0.05, 0.0, 0.05, 0.1])
@pytest.mark.parametrize("k", [0.5, 2.0, 10.0])
def test_an_invisible_quadric_costs_a_constant_and_pulls_nowhere(z: float, k: float) -> None:
    """Behind the camera, around it, and through the camera plane."""
    values = values_of(POSE, quadric_at(0.0, 0.0, z))
    factor = factor_of(np.array([100.0, 100.0, 200.0, 200.0]), k)
    assert 2.0 * factor.error(values) == pytest.approx(k**2 * (1.0 + np.log(INVISIBLE**2 / k**2)))
    assert not linearised(factor, values)[0].any()


def test_nothing_is_nan_on_the_way_through_the_camera() -> None:
    factor = factor_of(np.array([100.0, 100.0, 200.0, 200.0]), 2.0)
    states = set()
    for z in np.linspace(0.5, -0.5, 2001):
        values = values_of(POSE, quadric_at(0.02, 0.01, z))
        A, b = linearised(factor, values)
        assert np.isfinite(A).all() and np.isfinite(b).all() and np.isfinite(factor.error(values))
        states.add(bool(A.any()))
    assert states == {True, False}


@pytest.mark.parametrize("vector", [np.full(9, 50.0), np.array([0, 0, 1e9, 0, 0, 0, 0, 0, 0.0]), np.full(9, -300.0)])
def test_absurd_quadrics_give_no_nan(vector: Array) -> None:
    factor, values = factor_of(np.array([1.0, 1, 2, 2]), 2.0), values_of(POSE, vector)
    A, b = linearised(factor, values)
    assert np.isfinite(A).all() and np.isfinite(b).all() and np.isfinite(factor.error(values))


@pytest.mark.parametrize("size", [0.1, 50.0])
def test_a_box_like_its_neighbours_counts_less(size: float) -> None:
    """By the same share in error, gradient and tangent; the residual that the correlation is learnt from stays."""
    correlation = BoxCorrelation()
    half = np.full((1000, 4), 0.5)
    correlation.learn(half, half)
    assert 0.01 < correlation.worth < 0.5
    quadric, whitener = quadric_at(0.1, 0.05, 2.0), np.linalg.inv(np.linalg.cholesky(COVARIANCE))
    box = BoxMeasurement(predicted(quadric) + size, whitener, BOUNDS, ~ALL_EDGES)
    values, keys = values_of(POSE, quadric), [(X, Q)]
    alone, like = box_factor(X, Q, box, K, 2.0), box_factor(X, Q, box, K, 2.0, correlation)
    assert like.error(values) == pytest.approx(correlation.worth * alone.error(values))
    A, b = linearised(like, values)
    arrays = keys, POSE.matrix()[None].copy(), quadric[None], [box], K, 2.0
    (tangent,), residuals = box_tangents(*arrays, correlation.worth)
    np.testing.assert_allclose(tangent.jacobian()[0], A, atol=1e-12)
    np.testing.assert_allclose(tangent.jacobian()[1], b, atol=1e-12)
    np.testing.assert_allclose(residuals, -linearised(alone, values)[1][None], atol=1e-12)
    np.testing.assert_allclose(residuals, box_tangents(*arrays)[1])


def test_information_of_boxes_on_a_pose() -> None:
    """The sum of J^T J of their factors by the pose, doubted or not; an invisible one adds nothing."""
    whitener = np.linalg.inv(np.linalg.cholesky(COVARIANCE))
    quadrics = [quadric_at(*place) for place in [(0.1, 0.05, 2.0), (-0.4, 0.3, 2.5), (0.1, 0.05, -2.0)]]
    corners = [predicted(quadrics[0]) + 50.0, predicted(quadrics[1]) + 1.0, np.array([10.0, 10.0, 20.0, 20.0])]
    boxes = [BoxMeasurement(each, whitener, BOUNDS, ~ALL_EDGES) for each in corners]
    expected = np.zeros((6, 6))
    for quadric, box in zip(quadrics[:2], boxes, strict=False):
        J = linearised(box_factor(X, Q, box, K, 1e6), values_of(POSE, quadric))[0][:, :6]
        expected += J.T @ J
    found = pose_information(POSE.matrix(), quadrics, boxes, K)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * expected.max())
    assert np.linalg.eigvalsh(found).min() > 0.0
    np.testing.assert_array_equal(pose_information(POSE.matrix(), [], [], K), np.zeros((6, 6)))
