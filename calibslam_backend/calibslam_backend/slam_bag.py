"""`slam_bag BAG --out RUN`: the back end on a bag, without ROS; the same bag gives the same result, byte for byte."""

from __future__ import annotations

import dataclasses
import logging
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.geometry.transform import transform_from_text
from calibslam_backend.keyframe import Keyframe
from calibslam_backend.output.doubts import Course, doubts
from calibslam_backend.output.metrics import Trajectory
from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.output.published import POSE, TRANSFORM, camera_transform_message, map_messages, pose_message
from calibslam_backend.output.run_folder import RunRecord, write_run
from calibslam_backend.recording import BOXES, CAMERA, MOTIONS, NAMEABLE, ODOMETRY, RAW_BOXES, Recording
from calibslam_msgs_py import bags
from calibslam_msgs_py.bags import BagError, BagReader, BagWriter, refuse_to_replace
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.measurements import SECOND, Boxes, InvalidMeasurement, RelativeMotion
from calibslam_msgs_py.progress import Progress
from calibslam_msgs_py.settings import SettingsError, add_arguments, from_arguments

log = logging.getLogger(__name__)

OF_BOXES = ("double_box", "misfit", "no_identity")  # reasons of single boxes, beside `box_...`
MAP_PERIOD = 5.0  # [s] of recorded time between two maps in run.mcap


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of the executable; returns the exit code."""
    parser = ArgumentParser(prog="slam_bag", description=__doc__)
    parser.add_argument("bag", help="rosbag2 folder or .mcap file with boxes, odometry and camera_info")
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="RUN",
        help="folder for the result; that of an earlier run is replaced",
    )
    parser.add_argument("--calibrator", metavar="FILE", help="model for boxes without covariance")
    parser.add_argument("--map", type=Path, metavar="FILE", help="map.json to go on with")
    parser.add_argument("--batch", action="store_true", help="optimise the whole graph once more at the end")
    parser.add_argument(
        "--camera-in-body",
        default="0 0 0 0 0 0 1",
        metavar='"X Y Z QX QY QZ QW"',
        help="pose of the camera's optical frame in the body that odometry moves (default: %(default)s)",
    )
    boxes, odometry = f"boxes (default: {BOXES}, or {RAW_BOXES})", f"odometry (default: {MOTIONS}, or {ODOMETRY})"
    for name, meaning in (("detections", boxes), ("odom", odometry), ("camera_info", f"camera (default: {CAMERA})")):
        parser.add_argument(f"--{name.replace('_', '-')}", metavar="TOPIC", help=f"topic of the {meaning}")
    add_arguments(parser, EstimatorSettings)
    parsed = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    replaces = (parsed.out / "metrics.json").exists()
    try:
        settings = from_arguments(parsed, EstimatorSettings)
        named = {name: topic for name in NAMEABLE if (topic := getattr(parsed, name)) is not None}
        metrics = slam_bag(
            parsed.bag, parsed.out, settings, parsed.calibrator, parsed.batch, parsed.camera_in_body, parsed.map, named
        )
    except (BagError, SettingsError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    warnings = metrics["warnings"]
    if not metrics["keyframes"] and isinstance(warnings, list) and warnings:
        print(f"error: {parsed.bag}: {warnings[0]}", file=sys.stderr)
        return 1
    if not metrics["keyframes"]:
        counts = metrics["counts"]
        why = (
            f"the camera was not found in {parsed.map}: does it show objects of that map? If it starts where that map "
            "was begun, say --start-in-map begin"
            if isinstance(counts, dict) and "images_not_found" in counts
            else "no image lies within the time of the odometry: do their clocks agree?"
        )
        print(f"error: {parsed.bag}: {why}", file=sys.stderr)
        return 1
    _summary(parsed.out, metrics, replaces)
    return 0


def slam_bag(
    bag: str | Path,
    out: Path,
    settings: EstimatorSettings,
    calibrator: str | None = None,
    batch: bool = False,
    camera_in_body: str = "0 0 0 0 0 0 1",
    known: Path | None = None,
    named: Mapping[str, str] | None = None,
) -> dict[str, object]:
    """Run the estimator over a bag and write a RUN folder; returns its metrics."""
    refuse_to_replace(out / "run.mcap", bag)
    recording = Recording.open(bag, calibrator, named)
    estimator = Estimator(recording.camera, transform_from_text(camera_in_body), settings)
    if known is not None:
        estimator.load(ObjectMap.load(known))
    out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    keyframes: list[Keyframe] = []
    motions: list[int] = []
    first, last = 0, 0
    with BagReader(bag) as reader:
        length = (reader.end - reader.start) / SECOND
    with BagWriter(out / "run.mcap", overwrite=True) as writer, Progress(length, Path(bag).name) as progress:
        next_map = 0
        for measurement in recording.measurements():
            stamp = measurement.stamp if isinstance(measurement, Boxes) else measurement.end
            first, last = first or stamp, max(last, stamp)
            try:
                new = estimator.add(measurement)
            except InvalidMeasurement as error:
                recording.reject(error)
                continue
            except Exception as error:
                _failed(estimator, error)
                continue
            if isinstance(measurement, RelativeMotion):
                motions.append(stamp)
            for keyframe in new:
                keyframes.append(keyframe)
                writer.write(f"/{POSE}", pose_message(estimator, bags.types), keyframe.stamp)
                transform = camera_transform_message(estimator, recording.camera.frame_id, bags.types)
                writer.write(f"/{TRANSFORM}", transform, keyframe.stamp)
                if keyframe.stamp >= next_map:
                    next_map = keyframe.stamp + int(MAP_PERIOD * SECOND)
                    for topic, message in map_messages(estimator, bags.types):
                        writer.write(f"/{topic}", message, keyframe.stamp)
            progress.note = f"{len(keyframes)} keyframes, {estimator.objects} objects"
            progress.at((last - first) / SECOND)
        try:
            estimator.finish()
            if batch:
                estimator.optimise()
        except Exception as error:
            _failed(estimator, error)
        if estimator.stamps:
            for topic, message in map_messages(estimator, bags.types):
                writer.write(f"/{topic}", message, estimator.stamps[-1])
    recording.rejected["without_odometry"] += estimator.waiting
    record = run_record(
        estimator, keyframes, dict(+recording.rejected), time.perf_counter() - began, (last - first) / SECOND
    )
    course = Course(
        keyframes=len(estimator.stamps),
        objects=estimator.objects,
        boxes=len(record.associations),
        used=record.boxes_used,
        valid=recording.valid,
        rejected=recording.rejected,
        counts=estimator.counts,
        beyond=recording.beyond.problem,
        motions=motions,
    )
    record.warnings = doubts(course)
    record.recording = str(Path(bag).resolve())
    record.topics = recording.topics
    record.calibrator = None if calibrator is None else str(Path(calibrator).resolve())
    truth, objects = recording.ground_truth(), recording.true_objects() or ()
    if truth is not None:  # nothing else to compare them with, and they take time
        record.motions = estimator.motion_covariances()
    return write_run(out, Path(bag).name, estimator.object_map(), record, truth, objects)


def _failed(estimator: Estimator, error: Exception) -> None:
    """Count it, as a live session does, and say the first: the map as it was is gone on with."""
    if not estimator.counts["errors"]:
        log.warning("estimator (further errors are only counted): %s: %s", type(error).__name__, error)
    estimator.counts["errors"] += 1


def run_record(
    estimator: Estimator,
    keyframes: Sequence[Keyframe],
    rejected: dict[str, int],
    wall_s: float,
    sequence_s: float,
) -> RunRecord:
    """What the run folder wants to know beside the map."""
    counts = {**estimator.counts}
    rejections = {
        **rejected,
        **{k.removeprefix("rejected_"): n for k, n in counts.items() if k.startswith("rejected_")},
    }
    return RunRecord(
        odometry=estimator.odometry(),
        online=Trajectory(
            np.array([keyframe.stamp for keyframe in keyframes]),
            np.reshape([keyframe.T_map_camera for keyframe in keyframes], (-1, 4, 4)),
        ),
        seconds=np.array([keyframe.seconds for keyframe in keyframes]),
        between=np.array([keyframe.between for keyframe in keyframes]),
        boxes_used=estimator.boxes_used,
        boxes_rejected=sum(n for reason, n in rejections.items() if reason.startswith("box_") or reason in OF_BOXES),
        box_correlation=estimator.box_correlation,
        rejected=rejections,
        counts={k: n for k, n in counts.items() if not k.startswith("rejected_")},
        associations=estimator.associations(),
        wall_s=wall_s,
        sequence_s=sequence_s,
        settings=dataclasses.asdict(estimator.settings),
    )


def _summary(out: Path, metrics: dict[str, object], replaces: bool) -> None:
    def metre(value: object) -> str:
        return f"{value:.3f} m" if isinstance(value, float) else "no ground truth"

    all_keyframes, with_truth = metrics["keyframes"], metrics["keyframes_with_truth"]
    of = "" if with_truth == all_keyframes else f" over {with_truth} of {all_keyframes} keyframes"
    accuracy = f"ATE {metre(metrics['ate_m'])}{of} (odometry alone: {metre(metrics['odometry_ate_m'])})"
    if metrics["ate_m"] is None:
        accuracy = f"no ATE: {metrics['no_accuracy']}"
    print(
        f"{metrics['keyframes']} keyframes, {metrics['objects']} objects, "
        f"{metrics['boxes_used']} boxes used, {metrics['boxes_rejected']} rejected\n"
        f"{accuracy}\n"
        f"result: {out}{' (instead of the run that was there)' if replaces else ''}, picture: {out / 'trajectory.png'}"
    )
    warnings = metrics["warnings"]
    for warning in warnings if isinstance(warnings, list) else []:
        print(f"warning: {warning}")


if __name__ == "__main__":
    sys.exit(main())
