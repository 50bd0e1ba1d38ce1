"""The toy world has the document's geometry and noise; its graph is what a condition says."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy import stats

from calibslam_sim import experiment
from calibslam_sim.experiments import toy
from calibslam_sim.experiments.design import repetition_seed
from calibslam_sim.experiments.statistics import nees_interval, paired
from calibslam_sim.experiments.toy_world import (
    FIRST_LANDMARK,
    ToySettings,
    World,
    figure_eight,
    landmark_grid,
    make_world,
    problem,
    solve,
)

# Two circles of 5 m instead of 20 m: a fifth of the time.
SMALL = ToySettings(poses=60, turn_rate=0.2)


def world(number: int = 0, settings: ToySettings = SMALL) -> World:
    return make_world(settings, repetition_seed(0, number))


def truth(found: World) -> gtsam.Values:
    values = gtsam.Values()
    for k, pose in enumerate(found.poses):
        values.insert(k, pose)
    for j, landmark in enumerate(found.landmarks):
        values.insert(FIRST_LANDMARK + j, landmark)
    return values


def test_the_figure_eight_by_hand() -> None:
    """Circles of v / w = 20 m radius around (0, 20) and, after 126 steps of 0.05 rad, on the other side."""
    poses = figure_eight(ToySettings())
    assert len(poses) == 252
    for k in (0, 1, 63, 126):
        angle = 0.05 * k
        assert (poses[k].x(), poses[k].y()) == pytest.approx((20 * math.sin(angle), 20 * (1 - math.cos(angle))))
        assert math.remainder(poses[k].theta() - angle, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    # The second centre lies 20 m to the right of pose 126.
    centre = poses[126].transformFrom(np.array([0.0, -20.0]))
    assert centre == pytest.approx((40 * math.sin(6.3), 20 - 40 * math.cos(6.3)))
    distances = [np.linalg.norm(poses[k].translation() - centre) for k in range(126, 252)]
    assert distances == pytest.approx([20.0] * 126)


def test_one_landmark_in_each_cell() -> None:
    positions = np.array([[-20.0, -40.0], [20.0, 40.0]])
    landmarks = landmark_grid(positions, 5.0, np.random.default_rng(0))
    assert landmarks.shape == (16 * 16, 2)
    assert len({tuple(cell) for cell in np.floor((landmarks + 40.0) / 5.0).astype(int)}) == 256
    assert np.abs(landmarks).max() <= 40.0
    inside = (landmarks + 40.0) / 5.0 % 1.0
    assert stats.kstest(inside.ravel(), "uniform").pvalue > 0.01


def test_landmarks_are_seen_within_reach_only() -> None:
    found = make_world(ToySettings(), repetition_seed(0, 0))
    assert found.ranges.min() >= 0.5 and found.ranges.max() <= 5.0
    assert set(found.seen[:, 1]) == set(range(len(found.landmarks)))
    # About pi 5^2 / 5^2 landmarks around every pose that is not at the edge of the square.
    assert 2.0 < len(found.seen) / 252 < math.pi
    assert np.all(np.diff(found.seen[:, 0]) >= 0)
    for i in (0, 100, len(found.seen) - 1):
        k, j = found.seen[i]
        assert found.ranges[i] == pytest.approx(found.poses[k].range(found.landmarks[j]))
        bearing = found.poses[k].bearing(found.landmarks[j]).theta()
        assert math.remainder(found.bearings[i] - bearing, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_the_same_seed_is_the_same_world() -> None:
    a, b, c = world(3), world(3), world(4)
    np.testing.assert_array_equal(a.landmarks, b.landmarks)
    np.testing.assert_array_equal(a.measurement_noise, b.measurement_noise)
    assert a.landmarks.shape != c.landmarks.shape or not np.array_equal(a.landmarks, c.landmarks)


def test_noise_and_factors_have_their_distributions() -> None:
    found = make_world(ToySettings(), repetition_seed(0, 1))
    assert stats.kstest(found.odometry_noise.ravel(), "norm").pvalue > 0.01
    assert stats.kstest(found.measurement_noise.ravel(), "norm").pvalue > 0.01
    share = (np.log(found.factors) / math.log(4.0) + 1.0) / 2.0
    assert stats.kstest(share, "uniform").pvalue > 0.01
    assert toy.rms_factor(4.0) == pytest.approx(math.sqrt((16 - 1 / 16) / (2 * math.log(16))))
    drawn = np.exp(np.random.default_rng(0).uniform(-math.log(4.0), math.log(4.0), 1_000_000))
    assert toy.rms_factor(4.0) == pytest.approx(np.sqrt(np.mean(drawn**2)), rel=2e-3)
    assert toy.rms_factor(1.0) == 1.0


def test_errors_of_the_truth_are_the_noise() -> None:
    """At the true values, half the sum of squares is that of the unit noise, whatever the condition makes of it."""
    found = world()
    values = truth(found)
    odometry, measurements = np.sum(found.odometry_noise**2) / 2, np.sum(found.measurement_noise**2) / 2
    expected = {
        "calibrated": odometry + measurements,
        "direct_overconfident": odometry + 4 * measurements,
        "underconfident": odometry + measurements / 4,
        "odometry_scale_0.5": 4 * odometry + measurements,
        "varying_calibrated": odometry + measurements,
        "varying_scale_2": odometry + np.sum((found.measurement_noise * found.factors[:, None]) ** 2) / 8,
    }
    for condition, error in expected.items():
        noise = toy.noise_of(found, SMALL, condition)
        assert problem(found, SMALL, noise).graph.error(values) == pytest.approx(error), condition


def test_only_the_ratio_of_the_scales_counts_for_the_estimate() -> None:
    """Odometry believed twice as noisy as it is, and landmarks half as noisy: the same estimate."""
    a, b = (toy.run(SMALL, name, repetition_seed(0, 0)) for name in ("odometry_scale_2", "overconfident"))
    assert a["ate_m"] == pytest.approx(b["ate_m"], rel=1e-3)
    assert a["nees_pose"] == pytest.approx(b["nees_pose"] / 4.0, rel=1e-3)


def test_without_noise_the_truth_comes_out() -> None:
    found = world()
    exact = replace(
        found,
        odometry_noise=np.zeros_like(found.odometry_noise),
        measurement_noise=np.zeros_like(found.measurement_noise),
    )
    _, estimate = toy.optimise(exact, SMALL, toy.noise_of(exact, SMALL, "calibrated"))
    for k, pose in enumerate(found.poses):
        assert estimate.atPose2(k).equals(pose, 1e-6)


def test_widening_finds_the_minimum_near_the_truth() -> None:
    """In repetition 6 optimisation straight from odometry ends elsewhere."""
    settings, worse = ToySettings(), 0
    for number in (5, 6):
        found = world(number, settings)
        noise = toy.noise_of(found, settings, "scale_0.125")
        posed, estimate = toy.optimise(found, settings, noise)
        _, direct = toy.optimise(found, settings, noise, is_direct=True)
        from_truth = solve(posed.graph, truth(found))
        assert posed.graph.error(estimate) == pytest.approx(posed.graph.error(from_truth), rel=1e-6)
        worse += posed.graph.error(direct) > 1.01 * posed.graph.error(estimate)
    assert worse > 0


def test_rms_by_hand() -> None:
    assert toy.rms([np.array([3.0, 4.0]), np.array([0.0, 1.0])]) == pytest.approx(math.sqrt(26.0 / 2.0))


def test_calibrated_is_best_and_honest() -> None:
    """RPE below x1/2 and x2 (paired t, p < 0.001), NEES inside its 95 % interval for calibrated only."""
    runs = {
        name: [toy.run(SMALL, name, repetition_seed(0, k)) for k in range(40)]
        for name in ("overconfident", "calibrated", "underconfident")
    }
    rpe = {name: [metrics["rpe_m"] for metrics in found] for name, found in runs.items()}
    for other in ("overconfident", "underconfident"):
        found = paired(rpe["calibrated"], rpe[other])
        assert found["mean_difference"] < 0.0 and found["p_value"] < 1e-3
    low, high = nees_interval(3, 40)
    nees = [float(np.mean([metrics["nees_pose"] for metrics in found])) for found in runs.values()]
    assert [low <= value <= high for value in nees] == [False, True, False]


def test_the_command(tmp_path: Path) -> None:
    assert (
        experiment.main(["toy", "--quick", "--poses", "20", "--seeds", "2", "--jobs", "1", "--out", str(tmp_path)]) == 0
    )
    result = json.loads((tmp_path / "result.json").read_text())
    assert {"ate_m", "rpe_m", "landmark_rmse_m", "nees_pose"} == set(result["conditions"]["calibrated"])
    assert {"calibrated_vs_overconfident", "varying_calibrated_vs_varying_rms"} <= set(result["paired"])
    assert (tmp_path / "toy.png").exists() and (tmp_path / "toy_trajectories.png").exists()
