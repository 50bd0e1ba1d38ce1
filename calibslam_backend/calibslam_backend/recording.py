"""A bag as the measurements the estimator takes, in the order of their log times: what the nodes see, without ROS."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.odometry.motion_chain import OdometryDifferencer
from calibslam_backend.output.metrics import Trajectory
from calibslam_msgs_py.bags import BagError, BagReader
from calibslam_msgs_py.conversions import (
    BeyondImage,
    boxes_from_msg,
    camera_from_msg,
    motion_from_msg,
    odometry_from_msg,
    quadrics_from_msg,
    stamped_pose_from_msg,
    valid_boxes,
)
from calibslam_msgs_py.detection_conversions import DETECTIONS_2D, boxes_from_detections_2d
from calibslam_msgs_py.measurements import Boxes, Camera, InvalidMeasurement, RelativeMotion

log = logging.getLogger(__name__)

BOXES, RAW_BOXES, CAMERA = "/detections", "/detections_raw", "/camera/camera_info"
MOTIONS, ODOMETRY, GROUND_TRUTH = "/relative_pose", "/odom", "/ground_truth"
TRUE_OBJECTS, TRUE_OBJECTS_TYPE = "/ground_truth_quadrics", "calibslam_msgs/msg/QuadricArray"
BOXES_TYPE, MOTION_TYPE, ODOMETRY_TYPE, CAMERA_TYPE = (
    "calibslam_msgs/msg/BoundingBoxArray",
    "calibslam_msgs/msg/RelativePose",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/CameraInfo",
)
# What can be named of a recording, and the types that a topic of it may have.
NAMEABLE = {
    "detections": (BOXES_TYPE, DETECTIONS_2D),
    "odom": (ODOMETRY_TYPE, MOTION_TYPE),
    "camera_info": (CAMERA_TYPE,),
}

Calibrator = Callable[[Boxes], Boxes]


def load_calibrator(path: str | None) -> Calibrator:
    """The installed calibrator of boxes without covariance, with the model of a file or its default one.

    Raises:
        BagError: no package offers one.
    """
    found = list(entry_points(group="calibslam.calibrators", name="default"))
    if not found:
        raise BagError("no calibrator is installed: build calibslam_detector, or choose --noise-model fixed")
    calibrator: Calibrator = found[0].load()(path)
    return calibrator


@dataclass
class Recording:
    """The measurements of a bag.

    Attributes:
        path: of the bag.
        camera: from its camera_info.
        rejected: why and how many messages or boxes were left out.
        valid: how many boxes were not.
        beyond: of boxes that go beyond the image.
        topics: where boxes, odometry and camera come from, by the names of `NAMEABLE`.
    """

    path: Path
    camera: Camera
    rejected: Counter[str]
    topics: dict[str, str]
    _calibrator: Calibrator | None
    valid: int = 0
    beyond: BeyondImage = field(default_factory=BeyondImage)

    @classmethod
    def open(cls, path: str | Path, calibrator: str | None = None, named: Mapping[str, str] | None = None) -> Recording:
        """A bag with boxes, a camera and odometry.

        Args:
            path: rosbag2 folder or .mcap file.
            calibrator: file with the model for boxes without covariance; None: the default one.
            named: topics by the names of `NAMEABLE`, instead of the usual ones.

        Raises:
            BagError: it cannot be read, or misses a topic; the text says which and what is there.
        """
        named = named or {}
        with BagReader(path) as bag:
            cls._check(bag, named)
            foreign = [topic for topic, kind in bag.topics.items() if kind == DETECTIONS_2D]
            sources = [topic for topic in (BOXES, RAW_BOXES) if topic in bag.topics] or foreign
            sources = [named["detections"]] if "detections" in named else sources
            if len(foreign) > 1 and sources == foreign:
                raise BagError(
                    f"{path} has boxes on {' and '.join(foreign)}: keep one of them only, or name it (--detections)"
                )
            motions = named.get("odom", MOTIONS if MOTIONS in bag.topics else ODOMETRY)
            camera_info = named.get("camera_info", CAMERA)
            wanted = {f"{BOXES} or {RAW_BOXES} or any of {DETECTIONS_2D}": bool(sources)}
            wanted |= {f"{MOTIONS} or {ODOMETRY}": motions in bag.topics, camera_info: camera_info in bag.topics}
            missing = [names for names, there in wanted.items() if not there]
            if missing:
                there = ", ".join(f"{name} ({bag.counts[name]})" for name in bag.topics) or "nothing"
                raise BagError(f"{path} has no topic {' and no topic '.join(missing)}; it has: {there}")
            camera = cls._camera(bag, camera_info)
        model = load_calibrator(calibrator) if sources[0] != BOXES or calibrator else None
        used = {"detections": sources[0], "odom": motions, "camera_info": camera_info}
        return cls(Path(path), camera, Counter(), used, model)

    @staticmethod
    def _check(bag: BagReader, named: Mapping[str, str]) -> None:
        """Topics that were named are there, and of a type that can be used."""
        for name, topic in named.items():
            kinds = NAMEABLE[name]
            if bag.topics.get(topic) not in kinds:
                fitting = ", ".join(other for other, kind in bag.topics.items() if kind in kinds) or "none"
                what = f"is {bag.topics[topic]}" if topic in bag.topics else "is not there"
                raise BagError(f"{bag.path}: {topic} {what}; topics of {' or '.join(kinds)}: {fitting}")

    @staticmethod
    def _camera(bag: BagReader, topic: str) -> Camera:
        for _, _, message in bag.messages([topic]):
            try:
                return camera_from_msg(message)
            except InvalidMeasurement as error:
                raise BagError(f"{bag.path}: {topic}: {error}") from error
        raise BagError(f"{bag.path} has no message on {topic}")

    def measurements(self) -> Iterator[Boxes | RelativeMotion]:
        """Boxes and motions in the order of their log times; what is invalid is counted in `rejected`."""
        boxes, motions = self.topics["detections"], self.topics["odom"]
        differencer = OdometryDifferencer()
        with BagReader(self.path) as bag:
            for topic, _, message in bag.messages([boxes, motions]):
                try:
                    if topic == boxes:
                        measured = self._boxes(message, bag.topics[topic])
                        yield self._calibrator(measured) if self._calibrator else measured
                    elif bag.topics[topic] == MOTION_TYPE:
                        yield motion_from_msg(message)
                    else:
                        pose, covariance = odometry_from_msg(message)
                        motion = differencer.add(pose.stamp, pose.T, covariance, message.child_frame_id)
                        if motion is not None:
                            yield motion
                except InvalidMeasurement as error:
                    self.reject(error)
            self.rejected.update({f"undecodable{topic}": n for topic, n in bag.rejected.items()})

    def _boxes(self, message: Any, kind: str) -> Boxes:
        """The usable boxes of one image; the others are counted."""
        if kind == DETECTIONS_2D:
            found, left_out = boxes_from_detections_2d(message, self.camera)
        else:
            found, left_out = boxes_from_msg(message), {}
        self.beyond.see(found)
        boxes, dropped = valid_boxes(found)
        self.valid += len(boxes)
        self.rejected.update({f"box_{reason}": n for reason, n in {**left_out, **dropped}.items()})
        return boxes

    def reject(self, error: InvalidMeasurement) -> None:
        """Count a measurement that cannot be used, and say the first of each kind."""
        if not self.rejected[error.reason]:
            log.warning("rejected (%s, further ones are only counted): %s", error.reason, error)
        self.rejected[error.reason] += 1

    def ground_truth(self) -> Trajectory | None:
        """The true trajectory, if the bag has one."""
        with BagReader(self.path) as bag:
            if GROUND_TRUTH not in bag.topics:
                return None
            poses = {}
            for _, _, message in bag.messages([GROUND_TRUTH]):
                try:
                    pose = stamped_pose_from_msg(message)
                except InvalidMeasurement as error:
                    self.reject(error)
                    continue
                poses[pose.stamp] = pose.T
        if len(poses) < 2:
            return None
        stamps = sorted(poses)
        return Trajectory(np.array(stamps), np.stack([poses[stamp] for stamp in stamps]))

    def true_objects(self) -> tuple[Ellipsoid, ...] | None:
        """The true objects in the frame of the true trajectory, if the bag has them."""
        with BagReader(self.path) as bag:
            if bag.topics.get(TRUE_OBJECTS) != TRUE_OBJECTS_TYPE:
                return None
            for _, _, message in bag.messages([TRUE_OBJECTS]):
                try:
                    return tuple(Ellipsoid(each.T_map_object, each.radii) for each in quadrics_from_msg(message))
                except InvalidMeasurement as error:
                    self.reject(error)
        return None
