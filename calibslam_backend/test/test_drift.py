"""The constant drift of odometry without covariance: found, with an honest covariance, and worth it."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from scipy.stats import chi2
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.association.matching import GIVEN
from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.graph.keys import D
from calibslam_backend.output import metrics
from calibslam_msgs_py.measurements import SECOND, Array, RelativeMotion

WORLD = SmallWorld(around(240, turn=2.0 * np.pi), objects())
SIGMAS = np.repeat([0.01, 0.02], 3)  # [rad/s, m/s] of drifts
RUNS = 4
ALONG = 3  # the axis of a drift along the path: the camera moves sideways


def drifting(world: SmallWorld, drift: Array) -> list[RelativeMotion]:
    """The motions of a world, none with a covariance, that miss a constant velocity (6,)."""
    motions = []
    for motion in world.motions():
        missed = gtsam.Pose3.Expmap(-(motion.end - motion.start) / SECOND * drift)
        motions.append(replace(motion, T_start_end=motion.T_start_end @ missed.matrix(), covariance=None))
    return motions


def run(world: SmallWorld, drift: Array, sigmas: Array) -> Estimator:
    """The estimator on it, told the noise of the motions and these standard deviations (6,) of their drift."""
    settings = EstimatorSettings(
        association=GIVEN,
        rotation_share=0.0,
        rotation_floor=world.rotation_sigma * np.sqrt(world.rate),
        roll_share=1.0,
        translation_share=0.0,
        translation_floor=world.translation_sigma * np.sqrt(world.rate),
        drift_rotation=float(sigmas[0]),
        drift_translation=float(sigmas[3]),
        scene_depth=0.0,
    )
    estimator = Estimator(CAMERA, np.eye(4), settings)
    motions = drifting(world, drift)
    for k, boxes in enumerate(world.boxes()):
        if k:
            estimator.add(motions[k - 1])
        estimator.add(boxes)
    estimator.finish()
    return estimator


def ate(estimator: Estimator, world: SmallWorld) -> float:
    return metrics.ate(metrics.Trajectory(np.array(estimator.stamps), estimator.trajectory()), world.truth())


def test_a_constant_drift_is_found() -> None:
    """Drifts drawn from their prior: NEES with 6 degrees of freedom each in its 99.9 % interval, and the drift known at
    least twice as well as before.

    But for that along the path: on a circle it is a change of scale, of which boxes tell nothing.
    """
    squared = []
    for seed in range(RUNS):
        drift = SIGMAS * np.random.default_rng(seed).normal(size=6)
        estimator = run(replace(WORLD, seed=seed), drift, SIGMAS)
        found, covariance = estimator._graph.drift(), estimator._graph._smoother.marginal(D)
        squared.append(float((found - drift) @ np.linalg.solve(covariance, found - drift)))
        assert (np.delete(np.sqrt(np.diag(covariance)) / SIGMAS, ALONG) < 0.5).all()
    low, high = chi2.interval(0.999, 6 * RUNS)
    assert low < sum(squared) < high


def test_a_drift_that_is_estimated_does_not_bend_the_trajectory() -> None:
    """The camera turns by 3 degrees per second more than odometry says, and boxes are too coarse to make up for it."""
    world = replace(WORLD, objects=objects(4), box_sigma=6.0, rotation_sigma=0.0005, translation_sigma=0.001, seed=2)
    drift = np.array([0.03, -0.03, 0.03, 0.0, 0.0, 0.0])
    known, ignored = (ate(run(world, drift, np.repeat([rotation, 1e-9], 3)), world) for rotation in (0.03, 1e-9))
    assert known < 0.5 * ignored


def test_without_drift_none_is_found() -> None:
    estimator = run(WORLD, np.zeros(6), SIGMAS)
    covariance = estimator._graph._smoother.marginal(D)
    found = estimator._graph.drift()
    assert found @ np.linalg.solve(covariance, found) < chi2.ppf(0.999, 6)


def test_odometry_with_covariance_has_no_drift() -> None:
    estimator = Estimator(CAMERA, np.eye(4), EstimatorSettings(association=GIVEN))
    for measurement in replace(WORLD, poses=WORLD.poses[:60]).measurements():
        estimator.add(measurement)
    assert not estimator._graph.drift().any()
