"""A RUN folder: `trajectory.tum`, `map.json`, `metrics.json`, `trajectory.png`; `run.mcap` is written beside them."""

from __future__ import annotations

import json
import resource
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.output.metrics import (
    NoGroundTruth,
    Trajectory,
    association_scores,
    ate,
    keyframes_with_truth,
    motion_nees,
    position_nees,
    rpe,
)
from calibslam_backend.output.object_map import MotionCovariances, ObjectMap, tum_lines
from calibslam_backend.output.plots import plot_run
from calibslam_msgs_py.measurements import Array


@dataclass
class RunRecord:
    """What happened in a run, beside its result.

    Attributes:
        odometry: poses (N, 4, 4) of the keyframes by odometry alone, and covariances (N, 6, 6).
        online: each keyframe as known right after it; without those in which the estimator failed.
        seconds: each keyframe's update.
        between: the longest that an image since the keyframe before took.
        boxes_used, boxes_rejected: numbers.
        box_correlation: of the errors of an object's boxes in consecutive keyframes.
        rejected: what was left out, by reason.
        counts: of all else that happened, such as images, motions, and quadrics that were merged.
        associations: quadric and true identity of each box of a keyframe.
        wall_s, sequence_s: duration of the run and of the recording.
        warnings: what a person should look at.
        recording: absolute path of the bag.
        topics: its topics that were used, as `Recording` has them.
        calibrator: file that gave boxes their covariances; None: the default, or the boxes had them.
        settings: that were used, for the record.
        motions: what is known of those between keyframes; None: not asked for.
    """

    odometry: tuple[Array, Array]
    online: Trajectory
    seconds: Array
    between: Array
    boxes_used: int
    boxes_rejected: int
    box_correlation: float
    rejected: dict[str, int]
    counts: dict[str, int]
    associations: Sequence[tuple[int | None, str]]
    wall_s: float
    sequence_s: float
    warnings: list[str] = field(default_factory=list)
    recording: str = ""
    topics: dict[str, str] = field(default_factory=dict)
    calibrator: str | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    motions: MotionCovariances | None = None


def accuracy(
    stamps: Sequence[int], poses: Array, covariances: Array, truth: Trajectory | None, prefix: str = ""
) -> dict[str, float | None]:
    """ATE, RPE and NEES of a trajectory as entries of metrics.json; None where there is no ground truth."""
    estimate = Trajectory(np.array(stamps), poses)
    absolute = _error(ate, estimate, truth)
    return {
        f"{prefix}ate_m": absolute,
        f"{prefix}rpe_m": None if absolute is None else _error(rpe, estimate, truth),
        f"{prefix}nees_position": None
        if absolute is None or truth is None
        else position_nees(estimate, covariances, truth),
    }


def honesty_of_motions(
    result: ObjectMap, motions: MotionCovariances | None, truth: Trajectory | None
) -> dict[str, float] | None:
    """NEES of motions by how many keyframes they span, as an entry of metrics.json; None without ground truth."""
    if truth is None or motions is None:
        return None
    found = motion_nees(Trajectory(np.array(result.stamps), result.poses), motions, truth)
    return {str(span): nees for span, nees in found.items()} or None


def _error(
    metric: Callable[[Trajectory, Trajectory], float], estimate: Trajectory, truth: Trajectory | None
) -> float | None:
    try:
        return None if truth is None else metric(estimate, truth)
    except NoGroundTruth:
        return None


def coverage(stamps: Sequence[int], poses: Array, truth: Trajectory | None) -> dict[str, int | str]:
    """How many keyframes the accuracy is of, as an entry of metrics.json; and if there is none, why."""
    if truth is None:
        return {"keyframes_with_truth": 0, "no_accuracy": "no ground truth"}
    estimate = Trajectory(np.array(stamps), poses)
    found: dict[str, int | str] = {"keyframes_with_truth": keyframes_with_truth(estimate, truth)}
    try:
        ate(estimate, truth)
    except NoGroundTruth as error:
        found["no_accuracy"] = str(error)
    return found


def milliseconds(seconds: Array) -> dict[str, float | None]:
    """Median, 99th percentile and maximum [ms]; None of nothing."""
    if not len(seconds):
        return dict.fromkeys(("p50", "p99", "max"))
    p50, p99, longest = np.percentile(np.asarray(seconds) * 1e3, [50, 99, 100])
    return {"p50": float(p50), "p99": float(p99), "max": float(longest)}


def metrics_of(result: ObjectMap, record: RunRecord, truth: Trajectory | None) -> dict[str, Any]:
    """The content of metrics.json."""
    scores = association_scores(record.associations)
    return {
        **accuracy(result.stamps, result.poses, result.covariances, truth),
        "nees_motion": honesty_of_motions(result, record.motions, truth),
        **accuracy(result.stamps, *record.odometry, truth, "odometry_"),
        "online_ate_m": _error(ate, record.online, truth),
        "keyframes": len(result.stamps),
        **coverage(result.stamps, result.poses, truth),
        "objects": len(result.quadrics),
        "boxes_used": record.boxes_used,
        "boxes_rejected": record.boxes_rejected,
        "box_correlation": record.box_correlation,
        "rejected": record.rejected,
        "counts": record.counts,
        "warnings": record.warnings,
        "update_ms": milliseconds(record.seconds),
        "between_ms": milliseconds(record.between),
        "wall_s": record.wall_s,
        "sequence_s": record.sequence_s,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        **({"association": vars(scores)} if scores else {}),
        "recording": record.recording,
        "topics": record.topics,
        "calibrator": record.calibrator,
        "settings": record.settings,
    }


def write_run(
    folder: Path,
    title: str,
    result: ObjectMap,
    record: RunRecord,
    truth: Trajectory | None,
    objects: Sequence[Ellipsoid] = (),
) -> dict[str, Any]:
    """Write everything but `run.mcap`; returns the metrics. `objects` are the true ones, in the frame of `truth`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "trajectory.tum").write_text(tum_lines(result.stamps, result.poses), encoding="utf-8")
    result.save(folder / "map.json")
    metrics = metrics_of(result, record, truth)
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=1) + "\n", encoding="utf-8")
    if result.stamps:
        plot_run(folder / "trajectory.png", title, result, record.odometry[0], truth, objects)
    return metrics
