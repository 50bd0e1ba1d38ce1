"""A RUN folder with what its recording adds: truth, odometry, boxes and images."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.output.metrics import NoGroundTruth, Trajectory, alignment, interpolated
from calibslam_backend.output.object_map import MapFileError, ObjectMap
from calibslam_backend.output.run_folder import accuracy
from calibslam_backend.recording import Recording
from calibslam_msgs_py.bags import BagError
from calibslam_msgs_py.measurements import SECOND, Array, Boxes, Camera, RelativeMotion
from calibslam_sim.evaluate import odometry_at


class ReportError(ValueError):
    """A folder or recording that no report can be made of; the text says why and what to do."""


@dataclass(frozen=True)
class Recorded:
    """What the recording of a run tells.

    Attributes:
        path: of the bag.
        camera: that took the images.
        boxes: of the run's keyframes, as many as have any; with the covariances that the run was told.
        truth: the camera's true poses, in their own frame; None where there is none.
        objects: the true objects in that frame; None where they are not known.
        odometry: (N, 4, 4) the keyframes by odometry alone, from the first one on; None where it does not cover them.
    """

    path: Path
    camera: Camera
    boxes: tuple[Boxes, ...]
    truth: Trajectory | None
    objects: tuple[Ellipsoid, ...] | None
    odometry: Array | None


@dataclass(frozen=True)
class Run:
    """A run as the report shows it.

    Attributes:
        name: different from that of other runs.
        map: what was estimated.
        metrics: content of metrics.json, and what follows from the recording where that is missing there.
        recorded: None where the recording is not at hand.
        missing: why it is not; "" where it is.
    """

    name: str
    map: ObjectMap
    metrics: dict[str, Any]
    recorded: Recorded | None
    missing: str = ""

    @property
    def seconds(self) -> Array:
        """(N,) of the keyframes, since the first."""
        return np.asarray([(stamp - self.map.stamps[0]) / SECOND for stamp in self.map.stamps])

    def keyframe(self, stamp: int) -> int:
        """Its number."""
        return self.map.stamps.index(stamp)

    def best_fit(self) -> Array | None:
        """(4, 4) T_map_world as for ATE; None without enough truth."""
        truth = self.recorded.truth if self.recorded else None
        try:
            return None if truth is None else np.asarray(np.linalg.inv(alignment(self._trajectory(), truth)))
        except NoGroundTruth:
            return None

    def true_poses(self) -> tuple[Array, Array] | None:
        """Which keyframes (N,) the truth covers, and their M true poses in the map, tied to the estimate at the first
        of these as for NEES; None where it covers fewer than two.
        """
        truth = self.recorded.truth if self.recorded else None
        if truth is None:
            return None
        covered, poses = interpolated(truth, np.array(self.map.stamps))
        if np.count_nonzero(covered) < 2:
            return None
        return covered, self.map.poses[covered][0] @ np.linalg.inv(poses[0]) @ poses

    def position_covariances(self) -> Array:
        """(N, 3, 3) of the keyframes' positions in the map [m^2]."""
        R = self.map.poses[:, :3, :3]
        return np.asarray(R @ self.map.covariances[:, 3:, 3:] @ R.transpose(0, 2, 1))

    def _trajectory(self) -> Trajectory:
        return Trajectory(np.array(self.map.stamps), self.map.poses)


def load_runs(folders: Sequence[Path], recording: Path | None = None, calibrator: str | None = None) -> list[Run]:
    """Runs in the order of their folders.

    Args:
        folders: that `slam_bag` or `save_map` wrote.
        recording: bag of all of them; None: the one that each run names, where it is still there.
        calibrator: file for boxes without covariance; None: what each run names, or the default one.

    Raises:
        ReportError: a folder is no run, or the recording cannot be used.
    """
    return [load_run(folder, name, recording, calibrator) for folder, name in zip(folders, names(folders), strict=True)]


def names(folders: Sequence[Path]) -> list[str]:
    """Names of folders, with as many parents as tell them apart; the same folder twice is numbered."""
    parts = [folder.resolve().parts for folder in folders]
    depth = 1
    while len({each[-depth:] for each in parts}) < len(set(parts)):
        depth += 1
    short = ["/".join(each[-depth:]) for each in parts]
    return [
        name if short.count(name) == 1 else f"{name} ({short[: i + 1].count(name)})" for i, name in enumerate(short)
    ]


def load_run(folder: Path, name: str, recording: Path | None, calibrator: str | None) -> Run:
    """One run; arguments as of `load_runs`."""
    if not (folder / "map.json").is_file():
        what = "holds no map.json" if folder.is_dir() else "is no folder"
        raise ReportError(
            f"{folder} {what}, so it is no RUN; make one: ./calibslam run calibslam_backend slam_bag BAG --out RUN"
        )
    try:
        known = ObjectMap.load(folder / "map.json")
    except MapFileError as error:
        raise ReportError(str(error)) from error
    if not known.stamps:
        raise ReportError(f"{folder} holds no keyframe: there is nothing to show")
    metrics = read_metrics(folder / "metrics.json")
    source = recording or own_recording(metrics)
    if source is None:
        named = metrics.get("recording")
        return Run(
            name, known, metrics, None, f"its recording {named} is gone" if named else "metrics.json names no recording"
        )
    try:
        recorded = _recorded(source, known, calibrator or metrics.get("calibrator"), metrics.get("topics"))
    except (BagError, ValueError) as error:
        raise ReportError(f"recording of {folder}: {error}") from error
    if recorded is None:
        raise ReportError(f"{source} is not the recording of {folder}: they have no time in common")
    found = accuracy(known.stamps, known.poses, known.covariances, recorded.truth)
    return Run(
        name, known, {**found, "keyframes": len(known.stamps), "objects": len(known.quadrics)} | metrics, recorded
    )


def read_metrics(path: Path) -> dict[str, Any]:
    """Content of a metrics.json; empty where there is none.

    Raises:
        ReportError: it holds something else.
    """
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReportError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise ReportError(f"{path} holds no metrics of a run")
    return content


def own_recording(metrics: dict[str, Any]) -> Path | None:
    """The recording that a run names, if it is still there."""
    path = Path(metrics.get("recording") or "")
    return path if metrics.get("recording") and path.exists() else None


def _recorded(path: Path, known: ObjectMap, calibrator: str | None, named: dict[str, str] | None) -> Recorded | None:
    """The recording of a map; None if it is of another time."""
    recording = Recording.open(path, calibrator, named)
    motions: list[RelativeMotion] = []
    boxes: dict[int, Boxes] = {}
    first, last = known.stamps[0], known.stamps[-1]
    wanted, in_common = set(known.stamps), False
    for measurement in recording.measurements():
        if isinstance(measurement, RelativeMotion):
            motions.append(measurement)
            continue
        in_common = in_common or first <= measurement.stamp <= last
        if measurement.stamp in wanted and len(measurement):
            boxes[measurement.stamp] = measurement
    if not in_common:
        return None
    odometry = odometry_at(known, motions)
    return Recorded(
        path,
        recording.camera,
        tuple(boxes[stamp] for stamp in sorted(boxes)),
        recording.ground_truth(),
        recording.true_objects(),
        None if odometry is None else odometry[0],
    )
