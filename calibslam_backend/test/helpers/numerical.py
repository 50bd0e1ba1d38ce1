"""Derivatives checked against central differences, taken on the manifold as GTSAM does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from calibslam_msgs_py.measurements import Array

Point = gtsam.Pose3 | Array


def retract(point: Any, step: Array) -> Any:
    """A Pose3 moved by a tangent (6,), or a vector by a vector."""
    return point.retract(step) if isinstance(point, gtsam.Pose3) else point + step


def numerical_jacobian(function: Callable[[Any], Array], point: Any, step: float = 1e-6) -> Array:
    """(M, N) derivative of a function with values (M,) by central differences."""
    size = 6 if isinstance(point, gtsam.Pose3) else len(point)
    columns = [
        (function(retract(point, step * unit)) - function(retract(point, -step * unit))) / (2.0 * step)
        for unit in np.eye(size)
    ]
    return np.stack(columns, axis=1)


def assert_jacobians(
    function: Callable[..., Array],
    points: Sequence[Any],
    jacobians: Sequence[Array],
    rtol: float = 1e-5,
) -> None:
    """Each analytic Jacobian (M, N_i) of `function(*points)` equals the numerical one.

    The tolerance is relative to the largest entry of the Jacobian: small entries are differences of large numbers.
    """
    for i, analytic in enumerate(jacobians):

        def of_one(point: Any, i: int = i) -> Array:
            return function(*points[:i], point, *points[i + 1 :])

        numerical = numerical_jacobian(of_one, points[i])
        scale = max(float(np.abs(numerical).max()), 1e-3)
        np.testing.assert_allclose(analytic, numerical, rtol=0.0, atol=rtol * scale, err_msg=f"argument {i}")
