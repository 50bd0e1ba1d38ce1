"""The factor of a motion: error by hand, Jacobians against numerical derivatives, also of the robust loss."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numerical import assert_jacobians

from calibslam_backend.graph.odometry_factor import motion_factor
from calibslam_msgs_py.measurements import Array

START, END, DRIFT = 0, 1, 2
SIGMAS = np.array([0.02, 0.03, 0.01, 0.05, 0.02, 0.04])
A = np.random.default_rng(0).normal(size=(6, 6))
COVARIANCE = np.outer(SIGMAS, SIGMAS) * (np.eye(6) + 0.1 * A @ A.T)
FROM = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.3, 0.4), np.array([0.3, -0.2, 0.1]))
MOTION = gtsam.Pose3.Expmap(np.array([0.1, -0.2, 0.15, 0.3, 0.1, -0.2]))
RATE = np.array([0.01, -0.02, 0.005, 0.02, 0.01, -0.03])  # of a drift
WITHOUT_DOUBT = 1e6

tangents = st.tuples(*[st.floats(-1.0, 1.0)] * 6).filter(lambda d: np.linalg.norm(d) > 0.1)


def factor_of(drifts: float, k: float, covariance: Array = COVARIANCE) -> gtsam.CustomFactor:
    return motion_factor(START, END, DRIFT, MOTION.matrix(), covariance, drifts, k)


def values_of(start: gtsam.Pose3, end: gtsam.Pose3, drift: Array) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(START, start)
    values.insert(END, end)
    values.insert(DRIFT, drift)
    return values


def off_by(error: Array) -> gtsam.Pose3:
    """The pose at the end that misses the measured motion by this tangent."""
    return FROM.compose(MOTION).compose(gtsam.Pose3.Expmap(error))


def test_error_by_hand() -> None:
    """A pose at the end 2 sigma too far in x and turned 1 sigma about z: q = 5, error q / 2."""
    error = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
    diagonal = np.diag(SIGMAS**2)
    turned = values_of(FROM, off_by(error), np.zeros(6))
    assert factor_of(0.0, WITHOUT_DOUBT, diagonal).error(turned) == pytest.approx(0.5)
    moved = values_of(FROM, off_by(np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])), np.zeros(6))
    assert factor_of(0.0, WITHOUT_DOUBT, diagonal).error(moved) == pytest.approx(2.0)
    # Doubted beyond 1.5 sigma: rho = 2.25 (1 + log(4 / 2.25)).
    assert factor_of(0.0, 1.5, diagonal).error(moved) == pytest.approx(0.5 * 2.25 * (1.0 + np.log(4.0 / 2.25)))


def test_correlated_errors_have_their_mahalanobis_distance() -> None:
    error = 0.03 * np.arange(1.0, 7.0)
    q = error @ np.linalg.solve(COVARIANCE, error)
    values = values_of(FROM, off_by(error), np.zeros(6))
    assert 2.0 * factor_of(0.0, WITHOUT_DOUBT).error(values) == pytest.approx(q, rel=1e-9)


def test_drift_explains_what_it_says() -> None:
    """A pose off by the rate of the drift for 0.4 s has no error, and half of that rate leaves half of the error."""
    values = values_of(FROM, off_by(0.4 * RATE), RATE)
    assert factor_of(0.4, WITHOUT_DOUBT).error(values) == pytest.approx(0.0, abs=1e-12)
    left = 0.2 * RATE
    half = values_of(FROM, off_by(0.4 * RATE), 0.5 * RATE)
    assert 2.0 * factor_of(0.4, WITHOUT_DOUBT).error(half) == pytest.approx(left @ np.linalg.solve(COVARIANCE, left))


def test_without_drift_the_factor_does_not_touch_it() -> None:
    assert list(factor_of(0.0, 3.0).keys()) == [START, END]
    assert list(factor_of(0.1, 3.0).keys()) == [START, END, DRIFT]
    linear = factor_of(0.0, 3.0).linearize(values_of(FROM, off_by(0.02 * np.ones(6)), RATE))
    assert linear.jacobian()[0].shape == (6, 12)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(direction=tangents, size=st.sampled_from([0.0, 1e-3, 0.05, 0.5, 1.0]), drifts=st.sampled_from([0.0, 0.1, 2.0]))
def test_jacobians(direction: tuple[float, ...], size: float, drifts: float) -> None:
    """Without doubt the linearised residual is the derivative of the residual, by both poses and the drift."""
    factor = factor_of(drifts, WITHOUT_DOUBT)
    points = [FROM, off_by(size * np.array(direction)), RATE]
    whitener = np.linalg.inv(np.linalg.cholesky(COVARIANCE))

    def residual(start: gtsam.Pose3, end: gtsam.Pose3, drift: Array) -> Array:
        missed = gtsam.Pose3.Logmap(MOTION.between(start.between(end)))
        return np.asarray(whitener @ (missed - drifts * drift))

    J, b = factor.linearize(values_of(*points)).jacobian()
    np.testing.assert_allclose(-b, residual(*points), atol=1e-9)
    columns = [J[:, :6], J[:, 6:12]] + ([J[:, 12:]] if drifts else [])
    assert_jacobians(residual, points, columns)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    direction=tangents,
    size=st.sampled_from([1e-3, 0.05, 0.5, 1.0]),
    drifts=st.sampled_from([0.0, 0.1]),
    k=st.sampled_from([0.5, 3.5, WITHOUT_DOUBT]),
)
def test_gradient_of_the_factor(direction: tuple[float, ...], size: float, drifts: float, k: float) -> None:
    """What the optimisers linearise is the factor's own error: -A^T b is its gradient, also where it is doubted."""
    factor = factor_of(drifts, k)
    points = [FROM, off_by(size * np.array(direction)), RATE]

    def error(*at: gtsam.Pose3 | Array) -> Array:
        return np.array([factor.error(values_of(*at))])

    J, b = factor.linearize(values_of(*points)).jacobian()
    gradient = -(J.T @ b)[None]
    columns = [gradient[:, :6], gradient[:, 6:12]] + ([gradient[:, 12:]] if drifts else [])
    assert_jacobians(error, points, columns, rtol=1e-3)
