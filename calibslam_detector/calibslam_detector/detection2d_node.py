"""Node `detection2d`: boxes of a detector that publishes vision_msgs, as ours.

For installations that have vision_msgs; it is not among the wheels.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from calibslam_msgs.msg import BoundingBoxArray
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from calibslam_msgs_py.conversions import BeyondImage, RosTypes, boxes_to_msg, camera_from_msg, valid_boxes
from calibslam_msgs_py.detection_conversions import DETECTIONS_2D, boxes_from_detections_2d
from calibslam_msgs_py.measurements import Camera, InvalidMeasurement
from calibslam_msgs_py.node import MEASUREMENT, MEASUREMENT_INPUT, SENSOR, Counters, advertise, run
from calibslam_msgs_py.node_subscription import Subscription
from calibslam_msgs_py.settings import SettingsError


class Detection2DNode(Node):
    """detections_2d (vision_msgs/Detection2DArray) and camera/camera_info -> detections_raw."""

    def __init__(self) -> None:
        super().__init__("detection2d")
        self._types = RosTypes()
        try:
            kind = self._types(DETECTIONS_2D)
        except ImportError:
            raise SettingsError(
                "the package vision_msgs is not installed: sudo apt-get install ros-jazzy-vision-msgs, and source ROS"
            ) from None
        self._camera: Camera | None = None
        self._counters = Counters(self)
        self._beyond = BeyondImage()
        self._publisher = advertise(self, BoundingBoxArray, "detections_raw", MEASUREMENT)
        Subscription(
            self, self._counters, CameraInfo, "camera/camera_info", self._receive_camera, SENSOR, follows=False
        )
        Subscription(self, self._counters, kind, "detections_2d", self._receive, MEASUREMENT_INPUT)

    def _receive_camera(self, message: Any) -> None:
        try:
            self._camera = camera_from_msg(message)
        except InvalidMeasurement as error:
            self._counters.reject(error)

    def _receive(self, message: Any) -> None:
        if self._camera is None:
            error = InvalidMeasurement("no_camera", "boxes came before camera_info, which tells the image's size")
            self._counters.reject(error)
            return
        try:
            found, left_out = boxes_from_detections_2d(message, self._camera)
        except InvalidMeasurement as error:
            self._counters.reject(error)
            return
        if problem := self._beyond.news(found):
            self._counters.warn(problem)
        boxes, rejected = valid_boxes(found)
        for reason, count in {**left_out, **rejected}.items():
            self._counters.reject(InvalidMeasurement(f"box_{reason}", f"{count} boxes: {reason}"), count)
        self._publisher.publish(boxes_to_msg(boxes, self._types))
        self._counters.count("images")
        self._counters.count("boxes", len(boxes))


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit code."""
    return run(Detection2DNode, args)


if __name__ == "__main__":
    sys.exit(main())
