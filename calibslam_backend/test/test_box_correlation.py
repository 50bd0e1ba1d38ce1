"""Errors of neighbouring boxes that are alike: estimated, and what a box is worth then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.association import GIVEN
from calibslam_backend.box_correlation import BoxCorrelation
from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.metrics import Trajectory, position_nees
from calibslam_msgs_py.measurements import Array


def autoregressive(correlation: float, repetitions: int, n: int, seed: int = 3) -> Array:
    """(repetitions, n, 4) of unit variance, whose neighbours along n correlate."""
    errors = np.random.default_rng(seed).normal(size=(repetitions, n, 4))
    for k in range(1, n):
        errors[:, k] = correlation * errors[:, k - 1] + np.sqrt(1.0 - correlation**2) * errors[:, k]
    return errors


def test_by_hand() -> None:
    """One pair: products 2 + 2, squares (1 + 4 + 4 + 1) / 2, and 100 boxes of four edges that show nothing."""
    found = BoxCorrelation()
    assert found.correlation == 0.0 and found.worth == 1.0
    found.learn(np.array([[1.0, 2.0, 0.0, 0.0]]), np.array([[2.0, 1.0, 0.0, 0.0]]))
    assert found.correlation == pytest.approx(4.0 / (5.0 + 400.0))
    assert found.worth == pytest.approx((1.0 - 4.0 / 405.0) / (1.0 + 4.0 / 405.0))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_broken_state_teaches_nothing(value: float) -> None:
    found, same = BoxCorrelation(), BoxCorrelation()
    errors = autoregressive(0.5, 100, 2)
    spoilt = errors.copy()
    spoilt[:50, 0, 2] = value
    found.learn(spoilt[:, 0], spoilt[:, 1])
    same.learn(errors[50:, 0], errors[50:, 1])
    assert found.worth == same.worth < 1.0


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.8])
def test_it_is_found(correlation: float) -> None:
    errors = autoregressive(correlation, 40, 200)
    found = BoxCorrelation()
    for k in range(1, 200):
        found.learn(errors[:, k - 1], errors[:, k])
    # About 3000 pairs of four edges, and those that it began with.
    assert found.correlation == pytest.approx(correlation, abs=0.05)


def test_errors_against_each_other_are_worth_no_more_than_independent_ones() -> None:
    found = BoxCorrelation()
    found.learn(np.ones((1000, 4)), -np.ones((1000, 4)))
    assert found.correlation < -0.5 and found.worth == 1.0


def test_not_estimated() -> None:
    found = BoxCorrelation(is_estimated=False)
    found.learn(np.ones((1000, 4)), np.ones((1000, 4)))
    assert found.correlation > 0.5 and found.worth == 1.0


def test_what_it_was_before_fades() -> None:
    found = BoxCorrelation()
    found.learn(np.ones((3000, 4)), np.ones((3000, 4)))
    errors = autoregressive(0.0, 1000, 21)
    for k in range(1, 21):
        found.learn(errors[:, k - 1], errors[:, k])
    assert abs(found.correlation) < 0.05


@pytest.mark.parametrize("correlation", [0.3, 0.6])
def test_a_row_is_worth_its_boxes_times_their_worth(correlation: float) -> None:
    """The variance of a mean of n is 1 / (n worth); 16,000 means tell it to 1.1 % (one deviation)."""
    n = 300
    means = autoregressive(correlation, 4000, n).mean(axis=1)
    worth = (1.0 - correlation) / (1.0 + correlation)
    assert means.var() * n * worth == pytest.approx(1.0, abs=0.05)


WORLD = SmallWorld(around(110, turn=2.0 * np.pi), objects(), rate=10.0, rotation_sigma=0.01, translation_sigma=0.015)


def estimate(world: SmallWorld, box_correlation: bool) -> Estimator:
    estimator = Estimator(CAMERA, np.eye(4), EstimatorSettings(association=GIVEN, box_correlation=box_correlation))
    for measurement in world.measurements():
        estimator.add(measurement)
    estimator.finish()
    return estimator


def nees(world: SmallWorld, estimator: Estimator) -> float:
    found = estimator.object_map()
    value = position_nees(Trajectory(np.array(found.stamps), found.poses), found.covariances, world.truth())
    assert value is not None
    return value


def test_independent_errors_count_fully() -> None:
    """Then nothing changes by the time all is known."""
    estimator = estimate(WORLD, True)
    assert estimator.box_correlation < 0.03
    np.testing.assert_allclose(estimator.trajectory(), estimate(WORLD, False).trajectory(), atol=1e-4)


def test_covariances_are_more_honest_with_it() -> None:
    """Six worlds whose boxes err alike: NEES is above 3 by less, paired (t-test)."""
    with_it, without = [], []
    for seed in range(6):
        world = replace(WORLD, box_memory=0.8, seed=seed)
        estimator = estimate(world, True)
        assert estimator.box_correlation > 0.2
        with_it.append(nees(world, estimator))
        without.append(nees(world, estimate(world, False)))
    assert stats.ttest_rel(with_it, without, alternative="less").pvalue < 0.01
    assert np.mean(with_it) < 0.9 * np.mean(without)
