"""Covariances of the back end against the truth of simulated desks, where the noise is Gaussian and known.

Association given, everything else as it is by default. What the benchmark measures on longer recordings.
"""

from __future__ import annotations

from dataclasses import replace

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
Found = tuple[dict[float, list[float]], list[float]]


@pytest.fixture(scope="module")
def found() -> Found:
    """For each scale NEES of the last position of each run; for the right one that of each quadric."""
    positions: dict[float, list[float]] = {scale: [] for scale in SCALES}
    quadrics: list[float] = []
    for seed in range(SEEDS):
        recording = simulate(replace(DESK, seed=seed))
        for scale in SCALES:
            done = run(recording, EstimatorSettings(association=GIVEN, covariance_scale=scale))
            positions[scale].append(position_nees_at_the_end(done))
            quadrics += quadric_nees(done) if scale == 1.0 else []
    return positions, quadrics


def test_positions_are_as_uncertain_as_they_say(found: Found) -> None:
    """The sum over 25 runs of one squared error each is chi-squared with 75 degrees of freedom: their mean lies within
    the 95 % interval with the true covariances of boxes, and above with half of the deviations."""
    positions, _ = found
    low, high = nees_interval(3, SEEDS)
    assert low < np.mean(positions[1.0]) < high < np.mean(positions[0.5])


def test_positions_are_surer_than_underconfident_boxes_say(found: Found) -> None:
    """Twice the deviations: lower in the same runs (paired, one-sided, 1 %).

    Odometry, whose covariance is right, keeps the mean from falling far: to see it below the interval takes the 50
    seeds of the benchmark.
    """
    positions, _ = found
    comparison = paired(positions[2.0], positions[1.0])
    assert comparison["mean_difference"] < 0.0 and comparison["p_value"] < 0.02, comparison


def test_centres_and_shapes_are_near_their_covariances(found: Found) -> None:
    """Of the 90 % regions of nine dimensions at least 70 % hold the truth.

    Not 90 %: the prior on proportions is narrower than the proportions of flat things differ, and shapes of which few
    boxes tell are no Gaussians. The benchmark measures the share.
    """
    covered = np.mean(np.array(found[1]) < stats.chi2.ppf(0.9, 9))
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
