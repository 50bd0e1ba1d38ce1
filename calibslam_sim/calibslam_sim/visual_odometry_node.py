"""Node `visual_odometry`: images and registered depth in, relative motions with covariance out.

The executor's thread joins images and depth; one worker thread follows. Of pairs that wait only the newest stays, the
others are counted as dropped: the next motion spans them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from calibslam_msgs.msg import RelativePose
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from calibslam_msgs_py.conversions import RosTypes, camera_from_msg, motion_to_msg, stamp_from_msg
from calibslam_msgs_py.measurements import InvalidMeasurement
from calibslam_msgs_py.node import IMAGES, MEASUREMENT, SECONDS_BETWEEN_WARNINGS, SENSOR, Counters, advertise, run
from calibslam_msgs_py.node_subscription import Subscription
from calibslam_msgs_py.node_worker import NewestWorker
from calibslam_msgs_py.settings import declare_parameters
from calibslam_sim.rendering.depth_camera import DepthCamera, DepthCameraSettings
from calibslam_sim.visual_odometry.frame_odometry import VisualOdometrySettings
from calibslam_sim.visual_odometry.image_pairs import Pair


class VisualOdometryNode(Node):
    """camera/image_raw and camera/depth/image_raw, or compressed, and camera/camera_info -> relative_pose."""

    def __init__(self) -> None:
        super().__init__("visual_odometry")
        settings = declare_parameters(self, DepthCameraSettings)
        self._camera = DepthCamera(settings, declare_parameters(self, VisualOdometrySettings))
        self._types = RosTypes()
        self._counters = Counters(self)
        self._publisher = advertise(self, RelativePose, "relative_pose", MEASUREMENT)
        self._worker = NewestWorker(self, self._counters, self._follow)
        Subscription(
            self, self._counters, CameraInfo, "camera/camera_info", self._receive_camera, SENSOR, follows=False
        )
        for kind, topic, receive in (
            (Image, "camera/image_raw", self._receive_image),
            (CompressedImage, "camera/image_raw/compressed", self._receive_image),
            (Image, "camera/depth/image_raw", self._receive_depth),
            (CompressedImage, "camera/depth/image_raw/compressedDepth", self._receive_depth),
        ):
            Subscription(self, self._counters, kind, topic, receive, IMAGES)

    # -- executor's thread --------------------------------------------------------------------------------------

    def _receive_camera(self, message: Any) -> None:
        try:
            self._camera.set_camera(camera_from_msg(message))
        except InvalidMeasurement as error:
            self._counters.reject(error)

    def _receive_image(self, message: Any) -> None:
        self._counters.arrived("images", stamp_from_msg(message.header.stamp))
        self._put(self._camera.add_image(message))

    def _receive_depth(self, message: Any) -> None:
        self._counters.arrived("depth", stamp_from_msg(message.header.stamp))
        self._put(self._camera.add_depth(message))

    def _put(self, pairs: list[Pair[Any, Any]]) -> None:
        for reason, count in self._camera.rejected.items():
            self._counters.count(f"rejected_{reason}", count)
        self._camera.rejected.clear()
        for pair in pairs:
            self._worker.put(pair)

    # -- worker's thread ----------------------------------------------------------------------------------------

    def _follow(self, pair: Pair[Any, Any]) -> None:
        began = time.monotonic()
        step = self._camera.step(pair)
        self._counters.count("images")
        self._counters.set("following_ms", f"{(time.monotonic() - began) * 1e3:.0f}")
        if step is None:
            return
        self._publisher.publish(motion_to_msg(step.motion, self._types))
        self._counters.count("motions")
        self._counters.set("corners", step.corners)
        self._counters.set("residual_px", f"{step.sigma:.2f}")
        if step.bridged:
            self._counters.count("bridged")
            self.get_logger().warning(
                "the camera was lost: too few corners with depth agree on a motion; its covariance says so",
                throttle_duration_sec=SECONDS_BETWEEN_WARNINGS,
            )

    def close(self) -> None:
        """Let the worker end its image."""
        self._worker.close()


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit code."""
    return run(VisualOdometryNode, args)


if __name__ == "__main__":
    sys.exit(main())
