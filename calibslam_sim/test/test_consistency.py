"""Covariances of the back end against the truth of simulated desks, where the noise is Gaussian and known.

Association given, everything else as it is by default. What the benchmark measures on longer recordings.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats
from simulated_runs import position_nees_at_the_end, quadric_nees, run

from calibslam_backend.association.matching import GIVEN
from calibslam_backend.estimator import EstimatorSettings
from calibslam_backend.graph.noise import CALIBRATED, FIXED, QUADRICSLAM
from calibslam_sim.experiments.statistics import nees_interval, paired
from calibslam_sim.simulation.recording import SCENARIOS, SimulationSettings, simulate

SEEDS = 25
DESK = SimulationSettings(duration=20.0, frame_rate=10.0)
SCALES = (1.0, 0.5, 2.0)  # factors on the standard deviations of boxes
SPANS = (1, 3, 10)  # keyframes


@dataclass
class Found:
    """For each scale NEES of the last position of each run, and of its motions by span; NEES of quadrics at scale 1."""

    positions: dict[float, list[float]]
    motions: dict[tuple[float, int], list[float]]
    quadrics: list[float]


@pytest.fixture(scope="module")
def found() -> Found:
    found = Found(defaultdict(list), defaultdict(list), [])
    for seed in range(SEEDS):
        recording = simulate(replace(DESK, seed=seed))
        for scale in SCALES:
            done = run(recording, EstimatorSettings(association=GIVEN, covariance_scale=scale))
            found.positions[scale].append(position_nees_at_the_end(done))
            for span, nees in done.motion_nees().items():
                found.motions[scale, span].append(nees)
            found.quadrics += quadric_nees(done) if scale == 1.0 else []
    return found


@pytest.mark.parametrize("span", SPANS)
def test_motions_are_as_uncertain_as_they_say(found: Found, span: int) -> None:
    """Each run's mean over its motions is a sample: with the true covariances their mean over runs is 3 within a tenth
    and three standard errors, with half of the deviations it is more, with twice it is less (t-tests, 0.1 %)."""
    honest, overconfident, underconfident = (found.motions[scale, span] for scale in SCALES)
    assert np.mean(honest) == pytest.approx(3.0, abs=0.1 + 3.0 * stats.sem(honest))
    assert stats.ttest_1samp(overconfident, 3.0, alternative="greater").pvalue < 1e-3, np.mean(overconfident)
    assert stats.ttest_1samp(underconfident, 3.0, alternative="less").pvalue < 1e-3, np.mean(underconfident)


def test_positions_are_as_uncertain_as_they_say(found: Found) -> None:
    """The sum over 25 runs of one squared error each is chi-squared with 75 degrees of freedom: their mean lies within
    the 95 % interval with the true covariances of boxes, and above with half of the deviations."""
    low, high = nees_interval(3, SEEDS)
    assert low < np.mean(found.positions[1.0]) < high < np.mean(found.positions[0.5])


def test_positions_are_surer_than_underconfident_boxes_say(found: Found) -> None:
    """Twice the deviations: lower in the same runs (paired, one-sided, 1 %).

    Odometry, whose covariance is right, keeps the mean from falling far: to see it below the interval takes the 50
    seeds of the benchmark.
    """
    comparison = paired(found.positions[2.0], found.positions[1.0])
    assert comparison["mean_difference"] < 0.0 and comparison["p_value"] < 0.02, comparison


def test_centres_and_shapes_are_near_their_covariances(found: Found) -> None:
    """Of the 90 % regions of nine dimensions at least 70 % hold the truth.

    Not 90 %: the prior on proportions is narrower than the proportions of flat things differ, and shapes of which few
    boxes tell are no Gaussians. The benchmark measures the share.
    """
    covered = np.mean(np.array(found.quadrics) < stats.chi2.ppf(0.9, 9))
    assert 0.7 < covered < 0.95


def test_calibrated_covariances_pay_off_under_gross_errors() -> None:
    """5 % of the boxes are grossly wrong and nobody knows whose they are: lower ATE than with the other noise models,
    paired over eight recordings (one-sided t test, 5 %)."""
    errors: dict[str, list[float]] = {model: [] for model in (CALIBRATED, FIXED, QUADRICSLAM)}
    for seed in range(8):
        recording = simulate(replace(DESK, seed=seed, **SCENARIOS["desk_outliers"]))
        for model, values in errors.items():
            values.append(run(recording, EstimatorSettings(noise_model=model)).ate())
    for other in (FIXED, QUADRICSLAM):
        comparison = paired(errors[CALIBRATED], errors[other])
        assert comparison["mean_difference"] < 0.0 and comparison["p_value"] < 0.1, (other, comparison)
