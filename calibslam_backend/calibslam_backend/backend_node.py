"""Node `backend`: boxes and motions in, trajectory, pose and quadrics out.

The executor's thread only takes messages in; one worker thread owns the estimator, so that a slow update never
makes a measurement wait in the network. Results depend on the measurements, not on when they come.
"""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from calibslam_msgs.msg import BoundingBoxArray, RelativePose
from calibslam_msgs.srv import LoadMap, SaveMap
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import SetBool, Trigger

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.kernels import load_kernels
from calibslam_backend.map_to_odom_node import MapToOdom
from calibslam_backend.object_map import MapFileError, ObjectMap
from calibslam_backend.published import MAP, POSE, TOPICS, map_messages, pose_message
from calibslam_backend.relocalisation import FOUND
from calibslam_backend.transform import transform_from_text
from calibslam_msgs_py.conversions import (
    RosTypes,
    boxes_from_msg,
    camera_from_msg,
    motion_from_msg,
    valid_boxes,
)
from calibslam_msgs_py.measurements import Boxes, Camera, InvalidMeasurement, RelativeMotion
from calibslam_msgs_py.node import LATCHED, MEASUREMENT_INPUT, SENSOR, Counters, run
from calibslam_msgs_py.settings import Settings, SettingsError, declare_parameters, setting

SECONDS_BETWEEN_WARNINGS = 5.0
Measurement = Boxes | RelativeMotion


@dataclass(frozen=True)
class NodeSettings(Settings):
    """Parameters of the node beside those of the estimator."""

    camera_in_body: str = setting("0 0 0 0 0 0 1", "camera's optical frame in odometry's body: x y z qx qy qz qw")
    map_period: float = setting(1.0, "least wall time between two messages of the map", unit="s", low=0.0)
    refine_after: float = setting(1.0, "wall time without measurements after which all is refined", unit="s", low=0.1)
    queue_size: int = setting(10_000, "measurements that may wait; further ones are dropped and counted", low=10)


class BackendNode(Node):
    """detections, relative_pose, camera/camera_info -> trajectory, pose, quadrics, quadric_markers."""

    def __init__(self) -> None:
        super().__init__("backend")
        self._settings = declare_parameters(self, NodeSettings)
        self._estimator_settings = declare_parameters(self, EstimatorSettings)
        try:
            self._T_body_camera = transform_from_text(self._settings.camera_in_body)
        except ValueError as error:
            raise SettingsError(f"camera_in_body: {error}") from None
        self._types = RosTypes()
        self._counters = Counters(self)
        self._map_publishers = {
            topic: self.create_publisher(self._types(kind), topic, LATCHED) for topic, kind in TOPICS.items()
        }
        self._map_to_odom = MapToOdom(self, MAP)
        load_kernels()  # before anything can come in and wait
        self._estimator: Estimator | None = None
        self._camera: Camera | None = None
        self._paused = False
        self._reported: Counter[str] = Counter()
        self._lock = threading.Lock()  # around the estimator
        self._queue: queue.Queue[Measurement] = queue.Queue(self._settings.queue_size)
        self._stop = threading.Event()
        self._worker = threading.Thread(target=self._work, name="estimator", daemon=True)
        self._worker.start()
        self.create_subscription(CameraInfo, "camera/camera_info", self._receive_camera, SENSOR)
        self.create_subscription(RelativePose, "relative_pose", self._receive_motion, MEASUREMENT_INPUT)
        self.create_subscription(BoundingBoxArray, "detections", self._receive_boxes, MEASUREMENT_INPUT)
        self.create_service(Trigger, "~/reset", self._reset)
        self.create_service(SetBool, "~/pause", self._pause)
        self.create_service(SaveMap, "~/save_map", self._save)
        self.create_service(LoadMap, "~/load_map", self._load)

    # -- executor's thread --------------------------------------------------------------------------------------

    def _receive_camera(self, message: Any) -> None:
        try:
            camera = camera_from_msg(message)
        except InvalidMeasurement as error:
            self._reject(error)
            return
        if self._camera is None:
            with self._lock:
                self._camera = camera
                self._estimator = Estimator(camera, self._T_body_camera, self._estimator_settings)
            self.get_logger().info(f"camera {camera.frame_id}: {camera.width} x {camera.height} pixels")
        elif not np.allclose(camera.K, self._camera.K) or (camera.width, camera.height) != (
            self._camera.width,
            self._camera.height,
        ):
            self._reject(InvalidMeasurement("camera_changed", "camera_info changed; the first one stays in use"))

    def _receive_motion(self, message: Any) -> None:
        self._take(lambda: motion_from_msg(message))

    def _receive_boxes(self, message: Any) -> None:
        def convert() -> Boxes:
            boxes, dropped = valid_boxes(boxes_from_msg(message))
            for reason, count in dropped.items():
                self._reject(InvalidMeasurement(f"box_{reason}", f"{count} boxes: {reason}"), count)
            return boxes

        self._take(convert)

    def _take(self, convert: Callable[[], Measurement]) -> None:
        if self._paused:
            self._counters.count("ignored_while_paused")
            return
        try:
            self._queue.put_nowait(convert())
        except InvalidMeasurement as error:
            self._reject(error)
        except queue.Full:
            self._reject(InvalidMeasurement("queue_full", "measurements come faster than they can be used"))

    def _reject(self, error: InvalidMeasurement, count: int = 1) -> None:
        self._counters.count(f"rejected_{error.reason}", count)
        self.get_logger().warning(f"left out: {error}", throttle_duration_sec=SECONDS_BETWEEN_WARNINGS)

    # -- services -----------------------------------------------------------------------------------------------

    def _reset(self, _: Any, response: Any) -> Any:
        with self._lock:
            while not self._queue.empty():
                self._queue.get_nowait()
            if self._estimator is not None:
                self._estimator.reset()
                self._reported.clear()  # the estimator counts from zero again
        response.success, response.message = True, "map and trajectory are empty"
        return response

    def _pause(self, request: Any, response: Any) -> Any:
        self._paused = bool(request.data)
        response.success = True
        response.message = "paused: measurements are ignored" if self._paused else "running"
        return response

    def _save(self, request: Any, response: Any) -> Any:
        """Uses what has come in, refines, and writes: the best map there is now."""
        path = Path(request.path)
        with self._lock:
            try:
                while self._estimator is not None and not self._queue.empty():
                    self._use(self._queue.get_nowait())
                if self._estimator is None or not self._estimator.stamps:
                    response.success, response.message = False, "nothing to save: there is no keyframe yet"
                    return response
                self._estimator.finish()
                path.parent.mkdir(parents=True, exist_ok=True)
                self._estimator.object_map().save(path)
            except OSError as error:
                response.success, response.message = False, f"cannot write {path}: {error.strerror or error}"
                return response
            except RuntimeError as error:
                response.success, response.message = False, f"the estimate cannot be used: {error}"
                return response
            response.success = True
            response.message = (
                f"{self._estimator.objects} objects and {len(self._estimator.stamps)} keyframes in {path}"
            )
        return response

    def _load(self, request: Any, response: Any) -> Any:
        with self._lock:
            if self._estimator is None:
                response.success, response.message = (
                    False,
                    "no camera_info yet: publish it, then load the map",
                )
                return response
            try:
                known = ObjectMap.load(Path(request.path))
                self._estimator.load(known)
                self._reported.clear()
            except (MapFileError, ValueError) as error:
                response.success, response.message = False, str(error)
                return response
        response.success = True
        start = (
            "the camera is looked for by the objects it sees"
            if self._estimator_settings.start_in_map == FOUND
            else "the robot must be where that map was begun"
        )
        response.message = f"{len(known.quadrics)} objects; {start}"
        return response

    # -- worker's thread ----------------------------------------------------------------------------------------

    def _work(self) -> None:
        map_is_new = refined = True
        published = measured = 0.0
        while not self._stop.is_set():
            if self._estimator is None:  # measurements wait for the camera
                time.sleep(0.02)
                continue
            try:
                measurement = self._queue.get(timeout=0.05)
            except queue.Empty:
                measurement = None
            now = time.monotonic()
            with self._lock:
                try:
                    if measurement is not None:
                        measured = now
                        if self._use(measurement):
                            map_is_new, refined = False, False
                    elif not refined and now - measured > self._settings.refine_after:
                        self._estimator.finish()
                        self._publish_pose()
                        map_is_new, refined = False, True
                    due = now - published >= self._settings.map_period * (1.0 if self._queue.empty() else 2.0)
                    if not map_is_new and (due or refined):
                        self._publish_map()
                        published, map_is_new = now, True
                except Exception as error:  # the node goes on; the map as it was stays published
                    self._counters.count("errors")
                    self.get_logger().error(f"estimator: {type(error).__name__}: {error}")

    def _use(self, measurement: Measurement) -> bool:
        """Give a measurement to the estimator; whether it brought keyframes."""
        assert self._estimator is not None
        try:
            keyframes = self._estimator.add(measurement)
        except InvalidMeasurement as error:
            self._reject(error)
            return False
        for keyframe in keyframes:
            self._counters.count("keyframes")
            self._counters.set("update_ms", f"{keyframe.seconds * 1e3:.1f}")
            if keyframe.repaired:
                self.get_logger().warning(f"repaired: {keyframe.repaired}")
        if keyframes:
            self._publish_pose()
        self._report()
        return bool(keyframes)

    def _publish_pose(self) -> None:
        assert self._estimator is not None
        if not self._estimator.stamps:
            return
        self._map_publishers[POSE].publish(pose_message(self._estimator, self._types))
        self._map_to_odom.publish(self._estimator.stamps[-1], self._estimator.body_pose())

    def _publish_map(self) -> None:
        assert self._estimator is not None
        if self._estimator.stamps:
            for topic, message in map_messages(self._estimator, self._types):
                self._map_publishers[topic].publish(message)

    def _report(self) -> None:
        """The estimator's own counts, as they grow, and its state."""
        assert self._estimator is not None
        counts = Counter(self._estimator.counts)
        for name, count in (counts - self._reported).items():
            self._counters.count(name, count)
        self._reported = counts
        self._counters.set("objects", self._estimator.objects)
        self._counters.set("images waiting for odometry", self._estimator.waiting)
        self._counters.set("measurements in queue", self._queue.qsize())

    def close(self) -> None:
        """Let the worker end its update."""
        self._stop.set()
        self._worker.join(timeout=10.0)


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit code."""
    return run(BackendNode, args)


if __name__ == "__main__":
    sys.exit(main())
