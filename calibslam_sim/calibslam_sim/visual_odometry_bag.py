"""`visual_odometry_bag BAG --out OTHER`: the bag with /relative_pose added, found from its images and depth images.

Depth has to be registered to the colour image: of the same size, in the same frame. Everything else of the bag is
copied. The same bag gives the same result.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_backend.output.metrics import NoGroundTruth, Trajectory, ate
from calibslam_backend.recording import MOTIONS
from calibslam_msgs_py import bags
from calibslam_msgs_py.bags import BagError, BagReader, BagWriter, refuse_to_replace
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.conversions import camera_from_msg, motion_to_msg, stamped_pose_from_msg
from calibslam_msgs_py.measurements import Camera, InvalidMeasurement, RelativeMotion
from calibslam_msgs_py.progress import Progress
from calibslam_msgs_py.settings import SettingsError, add_arguments, from_arguments
from calibslam_sim import topics
from calibslam_sim.accuracy.motions import motion_accuracy, trajectory_of, truth_noise
from calibslam_sim.rendering.depth_camera import DepthCamera, DepthCameraSettings
from calibslam_sim.visual_odometry.frame_odometry import Step, VisualOdometrySettings
from calibslam_sim.visual_odometry.image_pairs import Pair

# The first of each that the bag has.
IMAGES = (topics.IMAGE, topics.RAW_IMAGE)
DEPTHS = (topics.DEPTH, topics.COMPRESSED_DEPTH)
SPANS = (1, 5, 15, 30)  # steps over which covariances are judged


@dataclass
class Result:
    """What was found.

    Attributes:
        steps: log time at which it was known [ns], and the step.
        seconds: for each pair of images.
        rejected: messages left out, by reason.
    """

    steps: list[tuple[int, Step]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    rejected: Counter[str] = field(default_factory=Counter)

    @property
    def motions(self) -> list[RelativeMotion]:
        """Of all steps."""
        return [step.motion for _, step in self.steps]


def odometry(bag: BagReader, image: str, depth: str, camera: DepthCamera) -> Result:
    """All steps of a bag; what cannot be used is counted."""
    result = Result()

    def take(time_known: int, pairs: list[Pair[Any, Any]]) -> None:
        for pair in pairs:
            began = time.perf_counter()
            try:
                step = camera.step(pair)
            except InvalidMeasurement as error:
                if not result.rejected[error.reason]:
                    print(f"left out (further ones are only counted): {error}", file=sys.stderr)
                result.rejected[error.reason] += 1
                continue
            result.seconds.append(time.perf_counter() - began)
            if step is not None:
                result.steps.append((time_known, step))

    with Progress((bag.end - bag.start) * 1e-9, f"following {image}") as progress:
        stamp = bag.end
        for topic, stamp, message in bag.messages([image, depth]):
            take(stamp, camera.add_image(message) if topic == image else camera.add_depth(message))
            progress.at((stamp - bag.start) * 1e-9)
        take(stamp, camera.finish())
    result.rejected.update(camera.rejected)
    result.rejected.update({f"undecodable{topic}": count for topic, count in bag.rejected.items()})
    return result


def write(bag: BagReader, out: Path, result: Result, overwrite: bool) -> list[str]:
    """The bag with the motions; returns the topics that could not be copied."""
    with BagWriter(out, overwrite) as writer:
        known = [topic for topic in writer.adopt(bag) if topic != MOTIONS]
        motions = iter(result.steps)
        due = next(motions, None)
        for topic, stamp, data in bag.raw_messages(known):
            while due is not None and due[0] < stamp:
                writer.write(MOTIONS, motion_to_msg(due[1].motion, bags.types), due[0])
                due = next(motions, None)
            writer.write_raw(topic, bag.topics[topic], data, stamp)
        while due is not None:
            writer.write(MOTIONS, motion_to_msg(due[1].motion, bags.types), due[0])
            due = next(motions, None)
    return [topic for topic in bag.topics if topic not in known]


def _topic(bag: BagReader, given: str | None, candidates: Sequence[str], option: str) -> str:
    found = next((topic for topic in ([given] if given else candidates) if topic in bag.topics), None)
    if found is None:
        there = "\n".join(f"  {name}  ({kind})" for name, kind in bag.topics.items())
        wanted = given or " or ".join(candidates)
        raise BagError(f"{bag.path} has no topic {wanted}; name another with {option}. It has:\n{there or '  none'}")
    return found


def _camera(bag: BagReader, topic: str) -> Camera:
    for _, _, message in bag.messages([topic]):
        try:
            return camera_from_msg(message)
        except InvalidMeasurement as error:
            raise BagError(f"{bag.path}: {topic}: {error}") from error
    raise BagError(f"{bag.path} has no message on {topic}")


def _truth(bag: BagReader) -> Trajectory | None:
    if topics.GROUND_TRUTH not in bag.topics:
        return None
    poses = {}
    for _, _, message in bag.messages([topics.GROUND_TRUTH]):
        try:
            pose = stamped_pose_from_msg(message)
        except InvalidMeasurement:
            continue
        poses[pose.stamp] = pose.T
    stamps = sorted(poses)
    return Trajectory(np.array(stamps), np.stack([poses[stamp] for stamp in stamps])) if len(stamps) > 1 else None


def report(result: Result, truth: Trajectory | None) -> Iterator[str]:
    """Lines for the user."""
    bridged = sum(step.bridged for _, step in result.steps)
    milliseconds = np.array(result.seconds) * 1e3
    yield (
        f"{len(result.steps)} motions, {bridged} of them bridged (camera lost); per image "
        f"{np.median(milliseconds):.0f} ms (median), {np.percentile(milliseconds, 99):.0f} ms (99 %)"
    )
    if result.rejected:
        yield "left out: " + ", ".join(f"{reason} {count}" for reason, count in sorted(result.rejected.items()))
    if truth is None:
        return
    try:
        yield f"ATE {ate(trajectory_of(result.motions), truth):.4f} m"
    except NoGroundTruth as error:
        yield f"ATE: {error}"
    noise = truth_noise(truth)
    yield (
        f"white noise of the ground truth, added to the covariances below: {np.linalg.norm(noise[:3]) * 1e3:.1f} mrad, "
        f"{np.linalg.norm(noise[3:]) * 1e3:.1f} mm"
    )
    yield "steps  motions  rotation  translation   NEES (6)  inside 50 %  inside 90 %"
    for span in SPANS:
        found = motion_accuracy(result.motions, truth, span, noise)
        if found is not None:
            yield (
                f"{span:5d}  {found.count:7d}  {found.rotation_rms * 1e3:4.1f} mrad  "
                f"{found.translation_rms * 1e3:8.1f} mm  {found.nees:9.1f}  "
                f"{found.covered_50:11.0%}  {found.covered_90:11.0%}"
            )


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `visual_odometry_bag`; returns the exit code."""
    parser = ArgumentParser(
        prog="visual_odometry_bag", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 folder or .mcap file with images and depth")
    parser.add_argument("--out", type=Path, required=True, metavar="OTHER", help="bag to write")
    parser.add_argument("--overwrite", action="store_true", help="replace OTHER if it exists")
    parser.add_argument("--image", metavar="TOPIC", help=f"colour images (default: {' or '.join(IMAGES)})")
    parser.add_argument("--depth", metavar="TOPIC", help=f"registered depth (default: {' or '.join(DEPTHS)})")
    parser.add_argument(
        "--camera-info", metavar="TOPIC", default=topics.CAMERA_INFO, help="of the images (default: %(default)s)"
    )
    add_arguments(parser, DepthCameraSettings)
    add_arguments(parser, VisualOdometrySettings)
    parsed = parser.parse_args(argv)
    try:
        refuse_to_replace(parsed.out, parsed.bag)
        camera = DepthCamera(
            from_arguments(parsed, DepthCameraSettings), from_arguments(parsed, VisualOdometrySettings)
        )
        with BagReader(parsed.bag) as bag:
            image = _topic(bag, parsed.image, IMAGES, "--image")
            depth = _topic(bag, parsed.depth, DEPTHS, "--depth")
            camera.set_camera(_camera(bag, _topic(bag, parsed.camera_info, (), "--camera-info")))
            result = odometry(bag, image, depth, camera)
            if not result.steps:
                counts = ", ".join(f"{reason} {count}" for reason, count in sorted(result.rejected.items()))
                raise BagError(
                    f"{parsed.bag}: no motion was found; left out: {counts or 'nothing, there are too few images'}"
                )
            left = write(bag, parsed.out, result, parsed.overwrite)
            truth = _truth(bag)
    except (BagError, SettingsError) as error:
        print(f"visual_odometry_bag: {error}", file=sys.stderr)
        return 1
    for topic in left:
        print(f"note: {topic} is not copied")
    for line in report(result, truth):
        print(line)
    print(f"result: {parsed.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
