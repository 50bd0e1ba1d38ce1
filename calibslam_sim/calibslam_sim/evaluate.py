"""`evaluate`: how good a run is, against the truth in a bag or a TUM folder.

Reads map.json of the run; writes the result into its metrics.json, and trajectory.tum and trajectory.png anew. Of a
map file instead of a folder the result is printed only: what lies beside it may be of another run.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_backend.odometry.motion_chain import MotionChain, dead_reckoning
from calibslam_backend.odometry.motion_noise import MotionNoise
from calibslam_backend.output.metrics import NoGroundTruth, Trajectory, alignment
from calibslam_backend.output.object_map import MapFileError, ObjectMap, tum_lines
from calibslam_backend.output.plots import plot_run
from calibslam_backend.output.run_folder import accuracy, coverage
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.measurements import Array, RelativeMotion
from calibslam_sim.accuracy.objects import map_objects, object_accuracy
from calibslam_sim.accuracy.reference import NoReference, Reference, read_reference


class MetricsError(ValueError):
    """A metrics.json that cannot be used; the text names it and the next step."""


def evaluate(run: Path, reference: Reference) -> dict[str, Any]:
    """Metrics of a RUN folder, or of a map file; writes metrics.json and the trajectory into the folder.

    Raises:
        MapFileError: the run has no readable map.json.
        MetricsError: its metrics.json is damaged.
        NoGroundTruth: fewer than three keyframes have ground truth.
    """
    result = ObjectMap.load(run if run.is_file() else run / "map.json")
    before = {} if run.is_file() else _metrics(run / "metrics.json")
    before.pop("no_accuracy", None)  # there is one now
    odometry = odometry_at(result, reference.motions)
    found = _measured(result, reference, odometry)
    if not run.is_file():
        _write(run, result, reference, odometry, {**before, **found})
    return found


def _measured(result: ObjectMap, reference: Reference, odometry: tuple[Array, Array] | None) -> dict[str, Any]:
    truth = reference.truth
    T_world_map = alignment(Trajectory(np.array(result.stamps), result.poses), truth)
    found: dict[str, Any] = accuracy(result.stamps, result.poses, result.covariances, truth)
    found |= {"keyframes": len(result.stamps), "objects": len(result.quadrics)}
    found |= coverage(result.stamps, result.poses, truth)
    if odometry is not None:
        found |= accuracy(result.stamps, *odometry, truth, "odometry_")
    if reference.objects is not None:
        estimated = map_objects(result.quadrics, T_world_map)
        compared = asdict(object_accuracy(estimated, reference.objects))
        # JSON knows no NaN.
        found["object_accuracy"] = {name: None if np.isnan(value) else value for name, value in compared.items()}
    return found


def _write(
    folder: Path,
    result: ObjectMap,
    reference: Reference,
    odometry: tuple[Array, Array] | None,
    metrics: dict[str, Any],
) -> None:
    (folder / "trajectory.tum").write_text(tum_lines(result.stamps, result.poses), encoding="utf-8")
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=1) + "\n", encoding="utf-8")
    if odometry is not None:
        objects = [thing.ellipsoid for thing in reference.objects or ()]
        plot_run(folder / "trajectory.png", folder.name, result, odometry[0], reference.truth, objects)


def _metrics(path: Path) -> dict[str, Any]:
    """What a run knows of itself; nothing where it has written nothing."""
    try:
        content = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except ValueError as error:
        raise MetricsError(f"{path} is damaged: {error}; remove it, and it is written anew") from None
    if not isinstance(content, dict):
        raise MetricsError(f"{path} holds no metrics; remove it, and it is written anew")
    return content


def odometry_at(result: ObjectMap, motions: Sequence[RelativeMotion]) -> tuple[Array, Array] | None:
    """Poses (N, 4, 4) of the keyframes by odometry alone, from the first one on, with covariances (N, 6, 6).

    None where odometry does not cover the keyframes, or moves another body than the camera.
    """
    if not motions or any(motion.frame_id != result.camera for motion in motions):
        return None
    if motions[0].start > result.stamps[0] or motions[-1].end < result.stamps[-1]:
        return None
    chain = MotionChain(MotionNoise(), np.eye(4))
    for motion in motions:
        chain.add(motion)
    steps = [(chain.measured(*pair), chain.between(*pair)[1]) for pair in pairwise(result.stamps)]
    return dead_reckoning(result.poses[0], result.covariances[0], steps)


def table(metrics: dict[str, Any]) -> str:
    """The metrics for a person."""
    some, keyframes = metrics["keyframes_with_truth"], metrics["keyframes"]
    lines = [
        *([f"ATE over {some} of {keyframes} keyframes: the others have no ground truth"] if some < keyframes else []),
        f"{'':24}{'estimate':>12}{'odometry alone':>16}",
        _row("ATE [m]", metrics, "ate_m", "{:.3f}"),
        _row("RPE [m]", metrics, "rpe_m", "{:.4f}"),
        _row("NEES (3 is honest)", metrics, "nees_position", "{:.2f}"),
        f"{'keyframes':24}{metrics['keyframes']:>12}",
        f"{'objects':24}{metrics['objects']:>12}",
    ]
    objects = metrics.get("object_accuracy")
    if objects:
        lines.append(f"{'  of true ones':24}{found_objects(objects):>12}")
    if objects and objects["matched"]:
        lines += [
            f"{'  centre error [m]':24}{objects['centre_m']:>12.3f}",
            f"{'  error of radii':24}{objects['radii']:>12.0%}",
            f"{'  3-D IoU':24}{objects['iou']:>12.2f}",
        ]
    return "\n".join(lines)


def found_objects(objects: dict[str, Any]) -> str:
    """How many of the true objects a map has, and how many of its own are none."""
    none = objects["estimated"] - objects["matched"]
    found = f"{objects['matched']} of {objects['true']}"
    return f"{found}, {none} that {'is' if none == 1 else 'are'} none" if none else found


def _row(name: str, metrics: dict[str, Any], key: str, style: str) -> str:
    values = [metrics.get(prefix + key) for prefix in ("", "odometry_")]
    texts = ["-" if value is None else style.format(value) for value in values]
    return f"{name:24}{texts[0]:>12}{texts[1]:>16}"


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `evaluate`; returns the exit code."""
    parser = ArgumentParser(prog="evaluate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder that slam_bag wrote, or a map file")
    parser.add_argument(
        "--reference",
        type=Path,
        required=True,
        metavar="BAG_OR_TUM",
        help="bag with /ground_truth, folder in TUM format, or file of poses in TUM format",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    arguments = parser.parse_args(argv)
    try:
        metrics = evaluate(arguments.run, read_reference(arguments.reference))
    except (MapFileError, MetricsError, NoGroundTruth, NoReference) as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    print(json.dumps(metrics, indent=1) if arguments.json else table(metrics))
    return 0


if __name__ == "__main__":
    sys.exit(main())
