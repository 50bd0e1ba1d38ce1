"""Errors of neighbouring boxes that are alike: estimated, and what a box is worth then beside any odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.association.matching import GIVEN
from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.graph.box_correlation import FASTEST, BoxCorrelation, crossover, slow_part, spectrum
from calibslam_backend.output.metrics import Trajectory, position_nees
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


def test_slow_part_by_hand() -> None:
    """0.5 and 0.4: memory 0.8, share 0.625. Faster than one process: that process. Slower than any: the longest."""
    assert slow_part(0.5, 0.4) == pytest.approx((0.625, 0.8))
    assert slow_part(0.5, 0.1) == slow_part(0.5, -0.3) == (1.0, 0.5)
    assert slow_part(0.45, 0.449) == pytest.approx((0.5, 0.9))
    assert slow_part(0.95, 0.95) == (1.0, 0.95)


def test_spectrum_by_hand() -> None:
    """A single process has (1 + m) / (1 - m) at rest, (1 - m) / (1 + m) at its fastest; then half of it."""
    assert spectrum(1.0, 0.5, 0.0) == pytest.approx(3.0)
    assert spectrum(1.0, 0.5, FASTEST) == pytest.approx(1.0 / 3.0)
    assert spectrum(0.5, 0.5, 0.0) == pytest.approx(2.0)


shares, memories = st.floats(0.01, 1.0), st.floats(0.01, 0.95)


@given(shares, memories)
def test_mean_of_the_spectrum_is_the_variance(share: float, memory: float) -> None:
    frequencies = (np.arange(2000) + 0.5) * np.pi / 2000
    assert np.mean(spectrum(share, memory, 2.0 - 2.0 * np.cos(frequencies))) == pytest.approx(1.0, abs=1e-6)


@given(shares, memories, st.floats(1e-6, 1e4))
def test_boxes_and_odometry_know_equally_much_at_the_crossover(share: float, memory: float, ratio: float) -> None:
    u = crossover(share, memory, ratio)
    assert 0.0 <= u <= FASTEST
    if u < FASTEST:
        assert u * spectrum(share, memory, u) == pytest.approx(ratio, rel=1e-6)
    else:
        assert FASTEST * spectrum(share, memory, FASTEST) <= ratio * (1.0 + 1e-9)


def solved(worth: float, known: Array, boxes: Array, errors: Array) -> tuple[Array, Array]:
    """Covariance of an estimate that gives boxes this worth, as it is and as the graph states it, by what is known
    besides, the information of the boxes, and how their errors enter there."""
    stated = np.linalg.inv(known + worth * boxes)
    return stated @ (known + worth**2 * errors) @ stated, stated


@pytest.mark.parametrize("ratio", [0.01, 0.1, 0.3, 1.0, 3.0, 100.0])
@pytest.mark.parametrize(("share", "memory"), [(1.0, 0.5), (0.63, 0.74), (0.56, 0.58)])
def test_no_other_worth_is_much_better(share: float, memory: float, ratio: float) -> None:
    """A random walk tied down by boxes, solved exactly: the mean squared error with this worth is at most 2.5 % above
    that with the best of thirty, and what is stated is too small by a factor between 1 and `understated`."""
    n = 200
    steps = np.diff(np.eye(n), axis=0)
    walk = steps.T @ steps / ratio  # its information; a box has 1
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    errors = share * memory**apart + (1.0 - share) * np.eye(n)

    def found(worth: float) -> tuple[float, float]:
        """Mean squared error, as it is and as the graph states it, away from the ends."""
        true, stated = solved(worth, walk, np.eye(n), errors)
        middle = slice(n // 3, -n // 3)
        return float(np.diag(true)[middle].mean()), float(np.diag(stated)[middle].mean())

    correlation = BoxCorrelation()
    first, second = share * memory, share * memory**2
    teach(correlation, first, second, ratio)
    true, stated = found(correlation.worth)
    assert true < 1.025 * min(found(worth)[0] for worth in np.geomspace(0.1, 1.0, 30))
    assert 0.999 < true / stated < 1.02 * correlation.understated()


@pytest.mark.parametrize("ratio", [0.01, 0.1, 0.3, 1.0, 3.0])
@pytest.mark.parametrize(("share", "memory"), [(1.0, 0.5), (0.63, 0.74), (0.56, 0.58)])
def test_motions_where_objects_come_and_go(share: float, memory: float, ratio: float) -> None:
    """Poses on a line, objects that are seen for 30 keyframes, five at a time, solved exactly: the variance of a motion
    over 1 to 50 keyframes is what the graph states times the factor, within a quarter (without it up to twice that).
    And of those over ten and more it is at most 6 % above that with the best of twenty worths."""
    n, seen, at_once = 180, 30, 5
    births = np.arange(1 - seen, n, seen // at_once)
    pairs = [(k, j) for j, born in enumerate(births) for k in range(max(born, 0), min(born + seen, n))]
    keyframes, quadrics = np.array(pairs).T
    unknown = np.eye(n + len(births))
    boxes = unknown[keyframes] - unknown[n + quadrics]
    steps = np.diff(unknown[:n], axis=0)
    known = at_once / ratio * steps.T @ steps + 1e-6 * unknown
    known[0, 0] += 1e6  # the origin; a box has the information 1
    apart = np.abs(np.subtract.outer(keyframes, keyframes))
    alike = np.equal.outer(quadrics, quadrics) * share * memory**apart
    errors = boxes.T @ (alike + (1.0 - share) * np.eye(len(pairs))) @ boxes

    def of_motions(covariance: Array, span: int) -> float:
        """Their summed variance, away from the ends."""
        first = np.arange(n // 4, n - n // 4 - span)
        motions = unknown[first + span] - unknown[first]
        return float(np.trace(motions @ covariance @ motions.T))

    correlation = BoxCorrelation()
    teach(correlation, share * memory, share * memory**2, ratio)
    true, stated = solved(correlation.worth, known, boxes.T @ boxes, errors)
    others = [solved(worth, known, boxes.T @ boxes, errors)[0] for worth in np.geomspace(0.1, 3.0, 20)]
    for span in (1, 3, 10, 30, 50):
        assert 0.75 < of_motions(true, span) / of_motions(stated, span) / correlation.understated(span) < 1.25
        if span >= 10:
            assert of_motions(true, span) < 1.06 * min(of_motions(other, span) for other in others)


def test_factor_by_hand() -> None:
    """Boxes tell each motion and count fully: over one keyframe s is (1 - m) / (1 + m), over two
    (1 - m^2) / (1 + m^2), and without an end (1 + m) / (1 - m)."""
    correlation = BoxCorrelation()
    teach(correlation, 0.5, 0.25, 100.0)
    assert correlation.worth == 1.0
    assert correlation.understated(1) == correlation.understated(2) == 1.0
    assert correlation.understated(3) == pytest.approx(1.0, abs=0.001)  # u = 1: s is just 1
    assert correlation.understated() == pytest.approx(np.sqrt(3.0), rel=0.001)
    assert correlation.understated(1e6) == pytest.approx(np.sqrt(3.0), rel=0.001)


def teach(correlation: BoxCorrelation, first: float, second: float, ratio: float) -> None:
    """Correlations one and two keyframes apart, and how much more boxes know than odometry, of very many keyframes."""
    n = 400_000
    for lag, value in ((1, first), (2, second)):
        before = np.tile([1.0, -1.0], n // 2)[:, None].repeat(4, axis=1)
        other = np.tile([1.0, 1.0, -1.0, -1.0], n // 4)[:, None].repeat(4, axis=1)  # uncorrelated with it
        correlation.learn(before, value * before + np.sqrt(1.0 - value**2) * other, lag)
    for _ in range(2000):
        correlation.learn_motion(ratio * np.eye(6), np.eye(6))


def test_ratio_of_informations_by_hand() -> None:
    """Boxes know 4 times as much in three directions, a sixteenth in the others: as volumes go, half as much.
    Ten keyframes begin that say nothing: after one, a third of an eleventh is told."""
    found = BoxCorrelation()
    assert found.ratio == 0.0
    found.learn_motion(np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0]), np.diag([1.0, 1.0, 1.0, 1 / 16, 1 / 16, 1 / 16]))
    told = (1.0 / 3.0) / (1.0 + 10.0 * np.exp(-0.01))
    assert found.ratio == pytest.approx(told / (1.0 - told))
    before = found.ratio
    found.learn_motion(np.full((6, 6), np.nan), np.eye(6))
    assert found.ratio == before
    for _ in range(2000):
        found.learn_motion(np.diag([1e6] * 4 + [0.0, 0.0]), np.eye(6))  # one box: nothing of two directions
    assert found.ratio < 1e-6


@pytest.mark.parametrize("information", [0.0, 1e-300, 1e60, 1e300])
def test_extreme_information_is_survived(information: float) -> None:
    """For so long that what it began with has faded."""
    found = BoxCorrelation()
    for _ in range(6000):
        found.learn_motion(information * np.eye(6), 1e-6 * np.eye(6))
    errors = autoregressive(0.5, 4000, 2)
    found.learn(errors[:, 0], errors[:, 1])
    assert np.isfinite(found.ratio)
    assert 0.3 < found.worth <= 1.0 <= found.understated() < 2.0
    assert (found.worth == 1.0) == (information > 1.0)


def test_better_odometry_makes_boxes_that_err_alike_count_less() -> None:
    worths = []
    for ratio in (100.0, 1.0, 0.3, 0.1, 0.001):
        correlation = BoxCorrelation()
        teach(correlation, 0.46, 0.34, ratio)
        worths.append(correlation.worth)
        assert correlation.understated() >= 1.0
    assert worths == sorted(worths, reverse=True)
    assert worths[0] == 1.0 and worths[-1] == pytest.approx(1.0 / spectrum(*slow_part(0.46, 0.34), 0.0), rel=0.01)


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
    assert found.correlation > 0.5 and found.worth == found.understated() == 1.0


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
