"""Real recordings in TUM format: bags of them, and the back end on these bags as `slam_bag` runs it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from benchmark_table import AnyRow, Row

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.graph.keys import x
from calibslam_backend.recording import Recording
from calibslam_backend.slam_bag import slam_bag
from calibslam_msgs_py.measurements import InvalidMeasurement
from calibslam_sim import tum_to_bag
from calibslam_sim.tum_folder import TumError

OFFICE, DESK = "fr3_office", "fr1_desk"
REPETITIONS = 5  # of what is timed


def bag_of(folder: Path, scratch: Path) -> Path:
    """The bag of a recording.

    Raises:
        TumError: it is not there, or not complete.
    """
    missing = [n for n in ("odometry.txt", "detections.csv", "groundtruth.txt") if not (folder / n).is_file()]
    if missing:
        raise TumError(f"{folder.name} lacks {', '.join(missing)}")
    bag = scratch / folder.name
    if not bag.exists():
        tum_to_bag.convert(folder, bag)
    return bag


def office_rows(folder: Path, scratch: Path, repetitions: int) -> list[AnyRow]:
    """Accuracy, association and speed on fr3_office."""
    bag = bag_of(folder, scratch)
    runs = [slam_bag(bag, scratch / f"{OFFICE} run {n}", EstimatorSettings()) for n in range(repetitions)]
    found: dict[str, Any] = runs[0]
    batch: dict[str, Any] = slam_bag(bag, scratch / f"{OFFICE} batch", EstimatorSettings(), batch=True)
    association = found["association"]
    # What a keyframe leaves to be done is done with the images after it: neither may stall.
    fastest = {
        name: min(max(run[kind][name] for kind in ("update_ms", "between_ms")) for run in runs)  # type: ignore[index]
        for name in ("p50", "p99", "max")
    }
    speed = max(run["sequence_s"] / run["wall_s"] for run in runs)  # type: ignore[operator]
    note = f"best of {repetitions} runs" if repetitions > 1 else ""
    return [
        *_accuracy_rows(OFFICE, found, (0.085, 0.050), (0.105, 0.070)),
        _precision(OFFICE, association["precision"]),
        _recall(OFFICE, association["recall"]),
        _against_batch(OFFICE, found, batch),
        Row(f"{OFFICE}: update, p50", fastest["p50"], unit="ms", note=note),
        Row(f"{OFFICE}: update, p99", fastest["p99"], 33.0, 10.0, "ms", note=note),
        Row(f"{OFFICE}: update, max", fastest["max"], 100.0, 33.0, "ms", note=note),
        Row(f"{OFFICE}: whole run, times real time", speed, 10.0, 40.0, higher_is_better=True, note=note),
    ]


def desk_rows(folder: Path, scratch: Path) -> list[AnyRow]:
    """Accuracy under fast motion, on fr1_desk."""
    bag = bag_of(folder, scratch)
    found: dict[str, Any] = slam_bag(bag, scratch / f"{DESK} run", EstimatorSettings())
    batch: dict[str, Any] = slam_bag(bag, scratch / f"{DESK} batch", EstimatorSettings(), batch=True)
    return [*_accuracy_rows(DESK, found, (0.15, 0.08), None), _against_batch(DESK, found, batch)]


def _accuracy_rows(
    name: str, found: dict[str, Any], final: tuple[float, float], online: tuple[float, float] | None
) -> list[AnyRow]:
    note = f"{found['keyframes']} keyframes, {found['objects']} objects; odometry alone {found['odometry_ate_m']:.3f}"
    return [
        Row(f"{name}: ATE, final", found["ate_m"], *final, "m", note=note),
        Row(f"{name}: ATE, online", found["online_ate_m"], *(online or (None, None)), "m"),
    ]


def _precision(name: str, value: float) -> Row:
    return Row(f"{name}: association, precision", value, 0.95, 0.99, higher_is_better=True)


def _recall(name: str, value: float) -> Row:
    return Row(f"{name}: association, recall", value, 0.90, 0.95, higher_is_better=True)


def _against_batch(name: str, found: dict[str, Any], batch: dict[str, Any]) -> Row:
    """A batch result that is worse than the incremental one counts as no difference."""
    worse = 100.0 * max(found["ate_m"] / batch["ate_m"] - 1.0, 0.0)
    return Row(
        f"{name}: ATE above batch LM's", worse, 5.0, 1.0, "%", note=f"{found['ate_m']:.4f} and {batch['ate_m']:.4f} m"
    )


def solver_rows(folder: Path, scratch: Path) -> list[AnyRow]:
    """Time of a box factor's linearisation and of an iteration of Levenberg-Marquardt on fr3_office's graph."""
    estimator = _estimator(bag_of(folder, scratch))
    smoother = estimator._graph._smoother  # what is timed is inside
    values = smoother.values
    factors = [factor for name, factor in smoother._factors.items() if name[0] == "box"]
    per_factor = []
    for _ in range(REPETITIONS):
        began = time.perf_counter()
        for factor in factors:
            factor.linearize(values)
        per_factor.append((time.perf_counter() - began) / len(factors))
    graph = smoother._graph(smoother._factors)
    # The first iteration from the estimate of odometry alone, where there is something to do.
    start = gtsam.Values(values)
    for k, pose in enumerate(estimator.odometry()[0]):
        start.update(x(k), gtsam.Pose3(pose))
    per_iteration = []
    for _ in range(REPETITIONS):
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, gtsam.LevenbergMarquardtParams())
        began, before, tries = time.perf_counter(), optimiser.error(), 3
        for _ in range(tries):
            optimiser.iterate()
        per_iteration.append((time.perf_counter() - began) / tries)
        assert optimiser.error() < before
    note = f"fastest of {REPETITIONS}; {len(factors)} box factors, {graph.size()} in all"
    return [
        Row("box factor: linearisation", 1e6 * min(per_factor), 12.0, 5.0, "us", note=note),
        Row(f"Levenberg-Marquardt on {OFFICE}: iteration", min(per_iteration), 0.2, 0.08, "s", note=note),
    ]


def _estimator(bag: Path) -> Estimator:
    """The estimator after a bag."""
    recording = Recording.open(bag)
    estimator = Estimator(recording.camera, np.eye(4), EstimatorSettings())
    for measurement in recording.measurements():
        try:
            estimator.add(measurement)
        except InvalidMeasurement as error:
            recording.reject(error)
    estimator.finish()
    return estimator
