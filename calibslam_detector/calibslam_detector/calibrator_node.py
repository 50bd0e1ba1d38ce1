"""Node `calibrator`: gives the boxes of a foreign detector a covariance.

Boxes that have one keep it. Boxes that cannot be used are left out and counted; the stamp stays that of
the image.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from calibslam_msgs.msg import BoundingBoxArray
from rclpy.node import Node

from calibslam_detector.foreign_boxes.calibrator import CalibratorError, load
from calibslam_msgs_py.conversions import BeyondImage, RosTypes, boxes_from_msg, boxes_to_msg, valid_boxes
from calibslam_msgs_py.measurements import InvalidMeasurement
from calibslam_msgs_py.node import MEASUREMENT, MEASUREMENT_INPUT, Counters, advertise, run
from calibslam_msgs_py.node_subscription import Subscription
from calibslam_msgs_py.settings import Settings, SettingsError, declare_parameters, setting


@dataclass(frozen=True)
class CalibratorNodeSettings(Settings):
    """Parameters of the node."""

    calibrator: str = setting("", "calibrator file (JSON); empty: a stated error per box size")


class CalibratorNode(Node):
    """detections_raw -> detections."""

    def __init__(self) -> None:
        super().__init__("calibrator")
        settings = declare_parameters(self, CalibratorNodeSettings)
        try:
            self._calibrate = load(settings.calibrator or None)
        except CalibratorError as error:
            raise SettingsError(str(error)) from error
        self._types = RosTypes()
        self._counters = Counters(self)
        self._beyond = BeyondImage()
        self._publisher = advertise(self, BoundingBoxArray, "detections", MEASUREMENT)
        Subscription(self, self._counters, BoundingBoxArray, "detections_raw", self._receive, MEASUREMENT_INPUT)

    def _receive(self, message: Any) -> None:
        try:
            drawn = boxes_from_msg(message)
            boxes, rejected = valid_boxes(drawn)
        except InvalidMeasurement as error:
            self._counters.reject(error)
            return
        self._counters.arrived("detections_raw", boxes.stamp)
        if problem := self._beyond.news(drawn):  # the back end gets them cut
            self._counters.warn(problem)
        for reason, count in rejected.items():
            self._counters.reject(InvalidMeasurement(reason, f"{count} boxes: {reason}"), count)
        self._publisher.publish(boxes_to_msg(self._calibrate(boxes), self._types))
        self._counters.count("images")
        self._counters.count("boxes", len(boxes))


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit code."""
    return run(CalibratorNode, args)


if __name__ == "__main__":
    sys.exit(main())
