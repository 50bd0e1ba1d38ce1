"""Odometry as robots publish it: directions left open by huge variances, and first motions that nothing can make."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.output.metrics import Trajectory, ate
from calibslam_msgs_py.measurements import Boxes, RelativeMotion

WORLD = SmallWorld(around(60), objects())


def drive(spoil: dict[int, RelativeMotion]) -> Estimator:
    """Through the small world, with some of its motions replaced by others."""
    estimator = Estimator(CAMERA, np.eye(4), EstimatorSettings())
    k = -1
    for measured in WORLD.measurements():
        if isinstance(measured, Boxes):
            estimator.add(measured)
        else:
            k += 1
            estimator.add(spoil.get(k, measured))
    estimator.finish()
    return estimator


def error(estimator: Estimator) -> float:
    return ate(Trajectory(np.array(estimator.stamps), estimator.trajectory()), WORLD.truth())


@pytest.mark.parametrize("variance", [1e2, 1e6, 1e12])
@pytest.mark.parametrize("axes", [[4], [0, 2, 4]], ids=["height", "plane"])
def test_directions_left_open(axes: list[int], variance: float) -> None:
    """As robots that drive in a plane say that they do not measure height, roll and pitch."""
    motions = {}
    for k, motion in enumerate(WORLD.motions()):
        assert motion.covariance is not None
        covariance = motion.covariance.copy()
        covariance[axes, axes] = variance
        motions[k] = replace(motion, covariance=covariance)
    estimator = drive(motions)
    assert len(estimator.stamps) > 20
    assert error(estimator) < 0.02


TURNED = gtsam.Pose3(gtsam.Rot3.Ypr(-1.4, 0.2, -1.6), np.array([0.3, 0.05, 0.4])).matrix()


@pytest.mark.parametrize("variance", [1e6, 1e12, 1e15])
def test_directions_left_open_by_a_body_that_carries_the_camera_turned(variance: float) -> None:
    """In the camera's axes they are mixed with others, and what is left open there is rounded more coarsely than those
    are known."""
    back = np.linalg.inv(TURNED)
    estimator = Estimator(CAMERA, TURNED, EstimatorSettings())
    stated = np.diag([variance, variance, 1e-5, 1e-5, 1e-5, variance])
    for measured in WORLD.measurements():
        if isinstance(measured, RelativeMotion):
            measured = replace(measured, T_start_end=TURNED @ measured.T_start_end @ back, covariance=stated)
        estimator.add(measured)
    estimator.finish()
    assert len(estimator.stamps) > 20
    assert error(estimator) < 0.03


@pytest.mark.parametrize("metres", [50.0, 1e4, 1e9, 1e300])
def test_a_first_motion_that_nothing_can_make(metres: float) -> None:
    """There is none before to compare it with, but no body is that fast."""
    first = WORLD.motions()[0]
    T = first.T_start_end.copy()
    T[1, 3] = metres
    estimator = drive({0: replace(first, T_start_end=T)})
    assert estimator.counts["odometry_implausible"] == 1
    assert error(estimator) < 0.05
