"""Rows of the benchmark from simulated desks: long runs, honest covariances, gross errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from benchmark_table import AnyRow, Row, Within
from scipy import stats
from simulated_runs import position_nees_at_the_end, quadric_nees, run

from calibslam_backend.association.matching import ESTIMATED, GIVEN
from calibslam_backend.estimator import EstimatorSettings
from calibslam_backend.graph.noise import CALIBRATED, FIXED, QUADRICSLAM
from calibslam_msgs_py.progress import Progress
from calibslam_sim.experiments.statistics import nees_interval, paired
from calibslam_sim.simulation.recording import SCENARIOS, SimulationSettings, simulate

OBJECTS = 15
LONG = 1000  # keyframes
IMAGE_RATE = 10.0  # [Hz]; keyframes are rarer, and what lies between two tells nothing but odometry
COVERAGE = 0.9
HONEST = 0.1  # as far from 3 NEES of motions may be, beside chance (two standard errors)


def long_run_rows(keyframes: int) -> list[AnyRow]:
    """Time of an update as the map is gone through again and again: does it grow?"""
    # A keyframe every 0.37 s at this pace; more than enough is simulated, and the rest not used.
    recording = simulate(SimulationSettings(seed=1, duration=0.45 * keyframes, frame_rate=IMAGE_RATE))
    chosen = {str(thing.id) for thing in recording.world[:OBJECTS]}
    boxes = [b.select(np.array([i for i, n in enumerate(b.object_ids) if n in chosen], int)) for b in recording.boxes]
    done = run(replace(recording, boxes=boxes), EstimatorSettings(), keyframes)
    milliseconds = 1e3 * np.array([max(keyframe.seconds, keyframe.between) for keyframe in done.keyframes])
    second, last = (np.median(np.array_split(milliseconds, 4)[i]) for i in (1, 3))
    what = f"simulation, {len(milliseconds)} keyframes x {OBJECTS} objects"
    note = f"max {milliseconds.max():.0f} ms, {done.estimator.objects} objects, ATE {done.ate():.3f} m"
    return [
        Row(f"{what}: update, p99", float(np.percentile(milliseconds, 99)), 50.0, 10.0, "ms", note=note),
        Row(
            f"{what}: p50 of last quarter over second",
            float(last / second),
            1.5,
            1.1,
            note=f"{second:.1f} and {last:.1f} ms",
        ),
    ]


def honesty_rows(seeds: int, duration: float) -> list[AnyRow]:
    """NEES of the last position of each run and of motions, coverage of quadrics; boxes' covariances right and wrong.

    Association given, everything else as it is by default.
    """
    positions: dict[float, list[float]] = {1.0: [], 0.5: [], 2.0: []}
    motions: dict[int, list[float]] = {}
    quadrics: list[float] = []
    with Progress(seeds * len(positions), "covariances") as progress:
        for seed in range(seeds):
            recording = simulate(SimulationSettings(seed=seed, duration=duration, frame_rate=IMAGE_RATE))
            for scale, found in positions.items():
                done = run(recording, EstimatorSettings(association=GIVEN, covariance_scale=scale))
                found.append(position_nees_at_the_end(done))
                if scale == 1.0:
                    quadrics += quadric_nees(done)
                    for span, nees in done.motion_nees().items():
                        motions.setdefault(span, []).append(nees)
                progress.step()
    low, high = nees_interval(3, seeds)
    rows: list[AnyRow] = [
        Within(
            f"simulation, {seeds} seeds: position NEES, sigma x {scale:g}",
            float(np.mean(found)),
            low,
            high,
            inside=scale == 1.0,
            note="last pose of each run; 3 is honest",
        )
        for scale, found in positions.items()
    ]
    for span, values in motions.items():
        chance = 2.0 * float(np.std(values)) / np.sqrt(len(values))
        rows.append(
            Within(
                f"simulation, {seeds} seeds: NEES of motions over {span} keyframe{'s' * (span > 1)}",
                float(np.mean(values)),
                3.0 - HONEST - chance,
                3.0 + HONEST + chance,
                note="mean of runs; 3 is honest",
            )
        )
    covered = float(np.mean(np.array(quadrics) < stats.chi2.ppf(COVERAGE, 9)))
    note = f"{len(quadrics)} quadrics, (t, L) in their {COVERAGE:.0%} region; wished, not demanded"
    return [*rows, Within(f"simulation, {seeds} seeds: coverage of 9-DoF quadrics", covered, 0.87, 0.93, note=note)]


def outlier_rows(seeds: int, duration: float, association: str) -> list[AnyRow]:
    """ATE under each noise model with 5 % of gross errors, the same recordings for all; paired t test."""
    models = (CALIBRATED, FIXED, QUADRICSLAM)
    errors: dict[str, list[float]] = {model: [] for model in models}
    with Progress(seeds * len(models), f"gross errors, association {association}") as progress:
        for seed in range(seeds):
            recording = simulate(
                SimulationSettings(seed=seed, duration=duration, frame_rate=IMAGE_RATE, **SCENARIOS["desk_outliers"])
            )
            for model in models:
                done = run(recording, EstimatorSettings(noise_model=model, association=association))
                errors[model].append(done.ate())
                progress.step()
    mean = {model: float(np.mean(errors[model])) for model in models}
    rows: list[AnyRow] = []
    for other in (FIXED, QUADRICSLAM):
        p = paired(errors[CALIBRATED], errors[other])["p_value"]
        assert p is not None
        what = f"simulation, 5 % gross errors, association {association}: {CALIBRATED} against {other}"
        note = f"mean ATE {mean[CALIBRATED]:.4f} and {mean[other]:.4f} m, {seeds} seeds"
        rows.append(Row(f"{what}: ratio of ATE", mean[CALIBRATED] / mean[other], 1.0, 0.7, note=note))
        rows.append(Row(f"{what}: p", p, 0.01, note="paired t test, two-sided"))
    return rows


ASSOCIATIONS = (GIVEN, ESTIMATED)
