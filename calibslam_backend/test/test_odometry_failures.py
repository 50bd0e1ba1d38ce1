"""Failures of odometry: probabilities by hand, and simulated odometry whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import chi2, multivariate_normal

from calibslam_backend.odometry.failures import BelievedStep, FailureFilter, FailureSettings
from calibslam_msgs_py.measurements import Array

STEP = 1.0 / 30.0  # [s]
NOISE = 0.15  # [rad/s, m/s] of good steps
DEFAULT = FailureSettings()


def walk(n: int, rng: np.random.Generator) -> Array:
    """(n, 6) velocities of a body as agile as is believed."""
    start = rng.normal(0.0, 0.5, 6)
    return start + np.cumsum(rng.normal(0.0, DEFAULT.agility * np.sqrt(STEP), (n, 6)), axis=0)


def run(measured: Array, is_visual: bool = True, covariance: Array | None = None) -> list[BelievedStep]:
    steps = FailureFilter(DEFAULT, is_visual)
    return [steps.believe(velocity, STEP, covariance) for velocity in measured]


def test_probability_by_hand() -> None:
    """The second step: v ~ N(first, 0.3^2 + 1/30), noise 0.3^2, failing 1 + 9 * 0.3^2 more, begun by 2 % of steps."""
    first, second = np.array([0.1, 0.2, 0.0, 0.4, -0.1, 0.0]), np.array([1.0, -0.8, 0.4, 1.4, 0.6, -1.0])
    steps = FailureFilter(DEFAULT)
    assert steps.believe(first, STEP, None).failed == 0.0
    found = steps.believe(second, STEP, None)
    before = 0.3**2 + STEP
    good, bad = before + 0.3**2, before + 0.3**2 + 1.0 + 9.0 * 0.3**2
    likelihoods = [multivariate_normal(first, variance * np.eye(6)).pdf(second) for variance in (good, bad)]
    p = 0.02 * likelihoods[1] / (0.98 * likelihoods[0] + 0.02 * likelihoods[1])
    assert 0.1 < p < 0.9
    assert found.failed == pytest.approx(p)
    np.testing.assert_allclose(found.velocity, (1.0 - p) * second + p * first)
    np.testing.assert_allclose(found.variance, p * before + p * (1.0 - p) * (second - first) ** 2)
    # And what is believed after it: the mixture of an update and of none.
    gain = before / good
    third = steps.believe(np.full(6, 1e3), STEP, None)
    np.testing.assert_allclose(third.velocity, first + (1.0 - p) * gain * (second - first))
    after = (1.0 - p) * (1.0 - gain) * before + p * before + p * (1.0 - p) * (gain * (second - first)) ** 2
    np.testing.assert_allclose(third.variance, after + STEP)


def test_failing_goes_on() -> None:
    """The same doubtful step after a failure and after none."""
    steps = [np.zeros(6)] * 15, [np.zeros(6)] * 14 + [np.full(6, 9.0)]
    doubtful = np.full(6, 0.75)
    after_good, after_failure = (run(np.array([*before, doubtful]))[-1].failed for before in steps)
    assert after_good < 0.5 * after_failure


def test_good_odometry_is_taken_as_it_is() -> None:
    """20,000 steps of the usual noise: fewer than one in 500 is doubted by half, and 99 % are as measured."""
    rng = np.random.default_rng(0)
    measured = walk(20_000, rng) + rng.normal(0.0, NOISE, (20_000, 6))
    believed = run(measured)
    assert np.mean([step.failed > 0.5 for step in believed]) < 0.002
    unchanged = [np.array_equal(step.velocity, z) for step, z in zip(believed, measured, strict=True)]
    assert np.mean(unchanged) > 0.99


@pytest.mark.parametrize(("length", "most"), [(1, 7.5), (10, 9.0), (25, 15.0)])
def test_bridged_motion_is_honest(length: int, most: float) -> None:
    """400 failures of so many steps, which say anything: where the body has got to, against what is stated.

    Of one wrong velocity, whose deviations add up. The mean of d^2 would be 6 (degrees of freedom). The longer a
    failure lasts, the less is known that what it says could contradict, and now and then it is believed.
    """
    rng = np.random.default_rng(length)
    d2, plain = [], []
    for _ in range(400):
        truth = walk(40 + length, rng)
        measured = truth + rng.normal(0.0, NOISE, truth.shape)
        measured[40:] = rng.normal(0.0, [1.5] * 3 + [2.0] * 3, (length, 6))
        believed = run(measured)[40:]
        error = sum((step.velocity - v) * STEP for step, v in zip(believed, truth[40:], strict=True))
        sigma = sum(np.sqrt(step.variance) * STEP for step in believed)
        d2.append(np.sum(error**2 / np.maximum(sigma, 0.05 * STEP) ** 2))
        plain.append(np.sum((np.sum(measured[40:] - truth[40:], axis=0) * STEP) ** 2 / np.maximum(sigma, 1e-3) ** 2))
    assert 3.0 < np.mean(d2) < most
    assert np.mean(plain) > 4.0 * np.mean(d2)  # what believing all of it would have cost


def test_the_usual_noise_is_read_off_the_steps() -> None:
    """3,000 steps of a steady body, rotations and translations that err differently, read off thirty at a time: their
    mean deviations, to 5 %. What never errs has the least noise there is."""
    rng = np.random.default_rng(4)
    deviations = np.repeat([0.1, 0.3], 3)
    steps, found = FailureFilter(DEFAULT), []
    for velocity in 0.5 + rng.normal(0.0, deviations, (3_000, 6)):
        steps.believe(velocity, STEP, None)
        found.append(steps._noise)
    np.testing.assert_allclose(np.sqrt(np.mean(found[30:], axis=0)), deviations, rtol=0.05)
    for _ in range(40):
        steps.believe(np.full(6, 0.5), STEP, None)
    np.testing.assert_allclose(np.sqrt(steps._noise), FailureFilter.LEAST_NOISE)


def test_failures_do_not_change_what_is_usual() -> None:
    """A third of the steps say anything: good ones are still believed and failures found."""
    rng = np.random.default_rng(3)
    measured = walk(2_000, rng) + rng.normal(0.0, NOISE, (2_000, 6))
    fails = (np.arange(2_000) // 10) % 3 == 2
    measured[fails] = rng.normal(0.0, [1.5] * 3 + [2.0] * 3, (int(fails.sum()), 6))
    failed = np.array([step.failed > 0.5 for step in run(measured)])
    assert failed[fails].mean() > 0.9
    assert failed[~fails].mean() < 0.15  # the first after a failure, mostly


def test_a_moving_body_does_not_stop_at_once() -> None:
    """Visual odometry that says nothing has failed, for a second; wheels, and what states a covariance, know."""
    measured = np.vstack([np.tile([0.0, 0.0, 0.1, 0.4, 0.0, 0.0], (20, 1)), np.zeros((40, 6))])
    stood = np.array([step.failed > 0.5 for step in run(measured)])
    assert stood[20:49].all() and not stood[51:].any() and not stood[:20].any()
    assert not any(step.failed > 0.5 for step in run(measured, is_visual=False))
    assert not any(step.failed > 0.5 for step in run(measured, covariance=1e-6 * np.eye(6)))


def test_a_body_at_rest_may_stay_there() -> None:
    assert not any(step.failed > 0.01 for step in run(np.zeros((50, 6))))


def test_steps_that_agree_are_a_new_motion() -> None:
    """From 1 to 15 m/s at once: no body does that, but odometry that insists is believed."""
    measured = np.zeros((40, 6))
    measured[:20, 3], measured[20:, 3] = 1.0, 15.0
    failed = np.array([step.failed > 0.5 for step in run(measured)])
    np.testing.assert_array_equal(np.flatnonzero(failed), 20 + np.arange(FailureFilter.NEW_MOTION))


def test_no_body_is_that_fast() -> None:
    """Whatever it stands between, at the start as well."""
    measured = np.zeros((12, 6))
    measured[[0, 6, 7, 8, 9, 10, 11], 3] = 1e9
    believed = run(measured)
    np.testing.assert_allclose([step.failed for step in believed], [1.0, *[0.0] * 5, *[1.0] * 6], atol=0.01)
    assert all(np.abs(step.velocity).max() == 0.0 for step in believed)


def test_directions_that_are_left_open_hide_no_failure() -> None:
    """Height is not measured; a step along x that fails is found, one along z is not asked."""
    covariance = np.diag([1e-6] * 3 + [1e-6, 1e-6, 1e6])
    usual = np.zeros((20, 6))
    usual[:, 3] = 0.5
    along_x, along_z = usual[0].copy(), usual[0].copy()
    along_x[3], along_z[5] = 6.0, 6.0
    assert run(np.array([*usual, along_x]), covariance=covariance)[-1].failed > 0.99
    assert run(np.array([*usual, along_z]), covariance=covariance)[-1].failed < 0.01


def test_the_median_is_that_of_chi_squared() -> None:
    assert pytest.approx(chi2(3).median() / 3.0, rel=1e-3) == FailureFilter.MEDIAN


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    measured=arrays(float, (12, 6), elements=st.floats(-1e300, 1e300)),
    seconds=st.lists(st.floats(1e-9, 1e3), min_size=12, max_size=12),
    stated=st.lists(st.one_of(st.none(), st.floats(1e-300, 1e300)), min_size=12, max_size=12),
)
def test_whatever_is_measured(measured: Array, seconds: list[float], stated: list[float | None]) -> None:
    """Finite in, finite out: a probability, variances, and no velocity beyond the fastest body's."""
    steps = FailureFilter(DEFAULT)
    for velocity, duration, variance in zip(measured, seconds, stated, strict=True):
        velocity[:3] = np.clip(velocity[:3], -np.pi / duration, np.pi / duration)  # what a rotation can be
        covariance = None if variance is None else variance * np.eye(6)
        believed = steps.believe(velocity, duration, covariance)
        assert 0.0 <= believed.failed <= 1.0
        assert np.isfinite(believed.velocity).all() and np.isfinite(believed.variance).all()
        assert (believed.variance >= 0.0).all()
        assert np.linalg.norm(believed.velocity[3:]) <= DEFAULT.max_speed * (1.0 + 1e-9)
