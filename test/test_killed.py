"""The back end is killed at random moments, runs on a full disk, and ends well: nothing it took in is lost."""

from __future__ import annotations

import json
import random
import resource
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from calibslam_msgs.msg import BoundingBoxArray, RelativePose
from calibslam_msgs.srv import LoadMap
from geometry_msgs.msg import PoseWithCovarianceStamped
from live import Process, Watcher, asking_for_kept, random_domain, trajectory_of, wait_until
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.output.metrics import Trajectory, ate
from calibslam_msgs_py.conversions import (
    RosTypes,
    boxes_to_msg,
    camera_to_msg,
    motion_to_msg,
    pose_with_covariance_to_msg,
)
from calibslam_msgs_py.geometry_conversions import rotation_from_quaternion
from calibslam_msgs_py.measurements import Array, StampedPose
from calibslam_msgs_py.node import LATCHED

WORLD = SmallWorld(around(150), objects())
TYPES = RosTypes()
PACE = 0.015  # [s] between messages
# All of it is kept for a back end that was away.
KEPT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Robot:
    """Publishes a small world, whoever listens."""

    def __init__(self, watcher: Watcher) -> None:
        node = watcher.node
        self._camera = node.create_publisher(CameraInfo, "camera/camera_info", LATCHED)
        self._boxes = node.create_publisher(BoundingBoxArray, "detections", KEPT)
        self._motions = node.create_publisher(RelativePose, "relative_pose", KEPT)
        self.sent = 0

    def wait(self, process: Process) -> None:
        """Until the back end listens."""
        wait_until(lambda: self._camera.get_subscription_count() == 1, lambda: f"no back end: {process.output}")

    def camera(self) -> None:
        self._camera.publish(camera_to_msg(CAMERA, 0, TYPES))

    def drive(self, start: int = 0, end: int = 150) -> None:
        motions, boxes = WORLD.motions(), WORLD.boxes()
        for k in range(start, end):
            if k:
                self._motions.publish(motion_to_msg(motions[k - 1], TYPES))
            time.sleep(PACE)
            self.camera()
            self._boxes.publish(boxes_to_msg(boxes[k], TYPES))
            time.sleep(PACE)
            self.sent = k + 1


def backend(domain: int, journal: Path, *options: str) -> Process:
    # A refinement after a rest would come at other moments than without interruption.
    settings = ("-p", f"journal:={journal}", "-p", "refine_after:=1000.0", *options)
    return Process(domain, "calibslam_backend", "backend", *asking_for_kept("/detections", "/relative_pose"), *settings)


def undisturbed() -> Estimator:
    estimator = Estimator(CAMERA, np.eye(4), EstimatorSettings())
    for measurement in WORLD.measurements():
        estimator.add(measurement)
    return estimator


def test_killed_at_random_moments(tmp_path: Path) -> None:
    """Three times, at random images. In the end the trajectory is that of a run without interruption."""
    moments = sorted(random.SystemRandom().sample(range(1, 150), 3))
    print("killed after images", moments)
    domain = random_domain()
    with Watcher(domain) as watcher:
        watcher.listen(PathMessage, "/trajectory")
        robot = Robot(watcher)
        driving = threading.Thread(target=robot.drive, daemon=True)
        process = backend(domain, tmp_path / "journal")
        try:
            robot.wait(process)
            driving.start()
            for moment in moments:
                wait_until(lambda m=moment: robot.sent >= m, "the robot does not move")
                assert process.running, process.output
                assert process.end(signal.SIGKILL) == -signal.SIGKILL
                process.__exit__()
                process = backend(domain, tmp_path / "journal")
            driving.join()

            def all_used() -> bool:
                robot.camera()  # which goes on, for a back end that was killed before it knew it, and started slowly
                return {"images": "150", "motions": "149"}.items() <= watcher.counts("/backend").items()

            wait_until(
                all_used,
                lambda: f"not all was used: {watcher.counts('/backend')}, {process.output}",
            )
            expected = undisturbed()
            truth = Trajectory(np.array(expected.stamps), expected.trajectory())
            wait_until(
                lambda: (
                    len(watcher.last["/trajectory"].poses) == len(expected.stamps)
                    and ate(trajectory_of(watcher.last["/trajectory"]), truth) < 1e-6
                ),
                lambda: f"{ate(trajectory_of(watcher.last['/trajectory']), truth)} m from the undisturbed run",
            )
            counts = watcher.counts("/backend")
            assert not {"odometry_gap", "errors", "rejected_late", "rejected_overlap"} & counts.keys(), counts
            assert process.end() == 0, process.output
            assert "Traceback" not in process.output
        finally:
            process.__exit__()


def test_a_full_disk_is_reported_and_the_graph_goes_on(tmp_path: Path) -> None:
    domain = random_domain()
    with Watcher(domain) as watcher, backend(domain, tmp_path / "journal") as process:
        robot = Robot(watcher)
        robot.wait(process)
        robot.drive(0, 40)
        wait_until(lambda: watcher.counts("/backend").get("images") == "40", lambda: process.output)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, ((tmp_path / "journal").stat().st_size + 3000,) * 2)
        robot.drive(40, 80)
        wait_until(lambda: watcher.counts("/backend").get("images") == "80", lambda: process.output)
        wait_until(lambda: "errors_journal" in watcher.counts("/backend"), lambda: f"{watcher.counts('/backend')}")
        counts = watcher.counts("/backend")
        assert counts["journal"] == "is not complete: File too large" and int(counts["objects"]) > 3
        assert "mapping goes on" in process.output and "errors" not in counts
        assert process.end() == 0, process.output


def test_the_map_is_saved_at_the_end_and_started_in_where_told(tmp_path: Path) -> None:
    """At SIGTERM; and the pose that is given on /initialpose is where the trajectory begins in that map."""
    domain = random_domain()
    inside = ("-p", f"map_folder:={tmp_path}")
    with (
        Watcher(domain) as watcher,
        backend(domain, tmp_path / "journal", *inside, "-p", "save_at_exit:=end/map.json") as process,
    ):
        robot = Robot(watcher)
        robot.wait(process)
        robot.drive()
        wait_until(lambda: watcher.counts("/backend").get("images") == "150", lambda: process.output)
        assert process.end(signal.SIGTERM) == 0, process.output
        assert "saved: " in process.output
    saved = json.loads((tmp_path / "end" / "map.json").read_text())
    assert len(saved["quadrics"]) == 9 and len(saved["keyframes"]) > 15
    pose = StampedPose(0, pose_of(saved["keyframes"][0]))
    pose.T[:3, 3] += [0.2, -0.2, 0.1]
    domain = random_domain()
    with Watcher(domain) as watcher, backend(domain, tmp_path / "new journal", *inside) as process:
        watcher.listen(PathMessage, "/trajectory")
        robot = Robot(watcher)
        start = watcher.node.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
        robot.wait(process)
        wait_until(lambda: start.get_subscription_count() == 1, "the back end does not subscribe")

        def is_loaded() -> bool:
            robot.camera()  # each time: a subscriber that has not found its publisher yet misses what is sent once
            return bool(watcher.call(LoadMap, "/backend/load_map", path="end/map.json").success)

        wait_until(is_loaded, "not loaded")
        start.publish(pose_with_covariance_to_msg(pose, None, "odom", TYPES))
        start.publish(pose_with_covariance_to_msg(pose, None, "map", TYPES))
        wait_until(lambda: "rejected_frame" in watcher.counts("/backend"), lambda: f"{watcher.counts('/backend')}")
        robot.drive()
        wait_until(lambda: watcher.counts("/backend").get("images") == "150", lambda: process.output)
        end = pose_of(saved["keyframes"][-1])[:3, 3]
        wait_until(
            lambda: np.linalg.norm(trajectory_of(watcher.last["/trajectory"]).poses[-1][:3, 3] - end) < 0.1,
            "the new trajectory does not end where the first one did",
        )
        assert process.end() == 0, process.output


def pose_of(keyframe: dict[str, Any]) -> Array:
    """(4, 4) of a keyframe in a map file."""
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(np.array(keyframe["orientation"]))
    T[:3, 3] = keyframe["position"]
    return T
