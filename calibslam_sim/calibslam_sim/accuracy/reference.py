"""What a run is compared to: the true trajectory, and where known odometry and true objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from calibslam_backend.odometry.motion_chain import OdometryDifferencer
from calibslam_backend.output.metrics import Trajectory
from calibslam_msgs_py.bags import BagError, BagReader
from calibslam_msgs_py.conversions import odometry_from_msg, quadrics_from_msg, stamped_pose_from_msg
from calibslam_msgs_py.measurements import InvalidMeasurement, RelativeMotion, StampedPose
from calibslam_sim import topics
from calibslam_sim.accuracy.objects import MapObject, map_objects
from calibslam_sim.tum_folder import TumError, read_trajectory

# By which a folder in TUM format is told from a bag.
TUM_FILES = {"camera_info.yaml", "odometry.txt", "detections.csv", "rgb.txt"}


class NoReference(ValueError):
    """A reference that cannot be used; the text says why."""


@dataclass(frozen=True)
class Reference:
    """The truth about a recording.

    Attributes:
        truth: true poses of the camera.
        motions: what odometry measured, in order; empty where there is none.
        objects: the true objects, in the frame of `truth`; None where they are not known.
    """

    truth: Trajectory
    motions: list[RelativeMotion]
    objects: list[MapObject] | None


def read_reference(path: Path) -> Reference:
    """The reference in a bag, a folder in TUM format, or a file of poses in TUM format.

    Raises:
        NoReference: there is no true trajectory, or the bag or file cannot be read.
    """
    there = {file.name for file in path.iterdir()} if path.is_dir() else set()
    if there & TUM_FILES and not there & {"groundtruth.txt", "metadata.yaml"}:
        raise NoReference(f"{path} has no groundtruth.txt: nothing to compare with")
    try:
        if path.suffix == ".mcap" or (path.is_dir() and not (path / "groundtruth.txt").exists()):
            return _from_bag(path)
        return _from_tum(path)
    except (BagError, TumError) as error:
        raise NoReference(str(error)) from error


def _from_tum(path: Path) -> Reference:
    if path.is_file():
        return Reference(Trajectory.of(read_trajectory(path)), [], None)
    motions: list[RelativeMotion] = []
    if (path / "odometry.txt").exists():
        differencer = OdometryDifferencer()
        for pose in read_trajectory(path / "odometry.txt"):
            motion = differencer.add(pose.stamp, pose.T)
            if motion is not None:
                motions.append(motion)
    return Reference(Trajectory.of(read_trajectory(path / "groundtruth.txt")), motions, None)


def _from_bag(path: Path) -> Reference:
    poses: dict[int, StampedPose] = {}
    motions: list[RelativeMotion] = []
    objects: list[MapObject] | None = None
    differencer = OdometryDifferencer()
    with BagReader(path) as bag:
        wanted = {topics.GROUND_TRUTH, topics.ODOMETRY, topics.GROUND_TRUTH_QUADRICS} & set(bag.topics)
        if topics.GROUND_TRUTH not in wanted:
            raise NoReference(f"{path} has no {topics.GROUND_TRUTH}: nothing to compare with")
        for topic, _, message in bag.messages(wanted):
            try:
                if topic == topics.GROUND_TRUTH:
                    pose = stamped_pose_from_msg(message)
                    poses[pose.stamp] = pose
                elif topic == topics.ODOMETRY:
                    pose, covariance = odometry_from_msg(message)
                    motion = differencer.add(pose.stamp, pose.T, covariance, message.child_frame_id)
                    if motion is not None:
                        motions.append(motion)
                else:
                    objects = map_objects(quadrics_from_msg(message))
            except InvalidMeasurement:
                continue  # the back end has counted and reported it
    if len(poses) < 2:
        raise NoReference(f"{path}: {topics.GROUND_TRUTH} holds {len(poses)} usable poses")
    return Reference(Trajectory.of([poses[stamp] for stamp in sorted(poses)]), motions, objects)
