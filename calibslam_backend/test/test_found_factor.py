"""The factor of a camera that is found beside an object of a known map."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from numerical import assert_jacobians

from calibslam_backend.graph.found_factor import found_factor
from calibslam_backend.graph.known import Known
from calibslam_msgs_py.measurements import Array

POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, -0.3, 0.4), np.array([0.3, -0.2, 0.1]))
KNOWN = Known(np.array([1.0, 2.0, 3.0, 0.1, 0.2, -0.1, 0.0, 0.1, 0.3]), np.eye(9))
FACTOR = found_factor(0, 1, POSE.matrix(), KNOWN, 0.5)


def values_of(pose: gtsam.Pose3, vector: Array) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(0, pose)
    values.insert(1, vector)
    return values


def test_error_by_hand() -> None:
    """0.3 m aside are 0.6 deviations: error 0.18. Both moved together are none."""
    assert FACTOR.error(values_of(POSE, KNOWN.vector)) == pytest.approx(0.0)
    aside = POSE.compose(gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.0, 0.0])))
    assert FACTOR.error(values_of(aside, KNOWN.vector)) == pytest.approx(0.18)
    shift = np.array([5.0, -3.0, 1.0])
    moved = KNOWN.vector.copy()
    moved[:3] += shift
    together = gtsam.Pose3(POSE.rotation(), POSE.translation() + shift)
    assert FACTOR.error(values_of(together, moved)) == pytest.approx(0.0, abs=1e-12)


def test_jacobians() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        points = [POSE.retract(rng.normal(size=6)), rng.normal(size=9)]

        def residual(pose: gtsam.Pose3, vector: Array) -> Array:
            return np.asarray((pose.transformTo(vector[:3]) - POSE.transformTo(KNOWN.vector[:3])) / 0.5)

        J, b = FACTOR.linearize(values_of(*points)).jacobian()
        np.testing.assert_allclose(-b, residual(*points), atol=1e-9)
        assert_jacobians(residual, points, [J[:, :6], J[:, 6:]])
