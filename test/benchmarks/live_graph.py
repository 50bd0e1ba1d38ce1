"""A back end in a process of its own, fed with a recording by this one: what the live benchmarks share."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import helpers_on_path
import numpy as np
from calibslam_msgs.msg import BoundingBoxArray, RelativePose
from live import Process, Watcher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo

from calibslam_backend.output.metrics import Trajectory
from calibslam_backend.recording import Recording
from calibslam_msgs_py.conversions import RosTypes, boxes_to_msg, camera_to_msg, motion_to_msg
from calibslam_msgs_py.measurements import SECOND, Boxes, Camera, RelativeMotion
from calibslam_sim import tum_to_bag

DATA = helpers_on_path.PROJECT.parent / "shared" / "data" / "tum"
TYPES = RosTypes()
TICKS = os.sysconf("SC_CLK_TCK")
# Publishers keep all of a recording for a back end that was away.
KEPT = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@contextmanager
def recording_of(source: Path) -> Iterator[Recording]:
    """A bag, or a folder in TUM format, as a recording."""
    with tempfile.TemporaryDirectory() as scratch:
        if (source / "groundtruth.txt").exists():
            bag = Path(scratch) / "bag"
            if tum_to_bag.main([str(source), "--out", str(bag)]) != 0:
                raise SystemExit(f"{source} cannot be made a bag")
            source = bag
        yield Recording.open(source)


def truth_of(recording: Recording) -> Trajectory:
    """Its true trajectory."""
    truth = recording.ground_truth()
    if truth is None:
        raise SystemExit(f"{recording.path} has no ground truth")
    return truth


def time_of(measurement: Boxes | RelativeMotion) -> int:
    """When it can be known [ns]."""
    return measurement.stamp if isinstance(measurement, Boxes) else measurement.end


class Player:
    """Publishes measurements at the times they have, `rate` times as fast.

    Attributes:
        share: of the measurements that have been published.
        published: when each image was (monotonic [s]), by its stamp [ns].
        known: stamps [ns] of the images whose odometry was published before.
    """

    def __init__(self, watcher: Watcher, camera: Camera) -> None:
        node = watcher.node
        self._camera_message = camera_to_msg(camera, 0, TYPES)
        self._camera = node.create_publisher(CameraInfo, "camera/camera_info", 10)
        self._boxes = node.create_publisher(BoundingBoxArray, "detections", KEPT)
        self._motions = node.create_publisher(RelativePose, "relative_pose", KEPT)
        self.share = 0.0
        self.published: dict[int, float] = {}
        self.known: set[int] = set()

    def play(self, measurements: list[Boxes | RelativeMotion], rate: float) -> None:
        messages = [
            (time_of(m), boxes_to_msg(m, TYPES) if isinstance(m, Boxes) else motion_to_msg(m, TYPES))
            for m in measurements
        ]
        begin, first, odometry = time.monotonic(), messages[0][0], -1
        for n, (stamp, message) in enumerate(messages, start=1):
            due = begin + (stamp - first) / SECOND / rate
            if (rest := due - time.monotonic()) > 0.0:
                time.sleep(rest)
            if isinstance(message, BoundingBoxArray):
                self._camera.publish(self._camera_message)
                self.published[stamp] = time.monotonic()
                if stamp <= odometry:
                    self.known.add(stamp)
                self._boxes.publish(message)
            else:
                self._motions.publish(message)
                odometry = stamp
            self.share = n / len(messages)


def backend(domain: int, *parameters: str) -> Process:
    """A back end with these parameters, `name:=value`."""
    options = [part for parameter in parameters for part in ("-p", parameter)]
    return Process(domain, "calibslam_backend", "backend", "--ros-args", *options)


def cpu_seconds(pid: int) -> float:
    """That a process has used so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def quantiles(numbers: list[float]) -> str:
    """Median, 99 % and largest, for a person."""
    p50, p99 = np.percentile(numbers, [50, 99])
    return f"median {p50:.1f}, 99 % {p99:.1f}, longest {max(numbers):.1f}"
