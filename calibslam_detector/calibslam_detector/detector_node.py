"""Node `detector`: images in, boxes with covariances out.

The executor's thread keeps the newest image only; one worker thread detects. Images that a newer one replaces before
it is their turn are counted as dropped: a late box is worth less than a new one.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from calibslam_msgs.msg import BoundingBoxArray
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from calibslam_detector.images.image_conversion import OVERLAY_QUALITY, decode_image, encode_jpeg
from calibslam_detector.images.overlay import draw_overlay
from calibslam_detector.model.detector import Detector, DetectorSettings, DeviceError
from calibslam_detector.model.weights_file import SHIPPED, WeightsError
from calibslam_msgs_py.conversions import RosTypes, boxes_to_msg, header_to_msg, stamp_from_msg, valid_boxes
from calibslam_msgs_py.node import IMAGES, MEASUREMENT, SECONDS_BETWEEN_WARNINGS, SENSOR, Counters, advertise, run
from calibslam_msgs_py.node_subscription import Subscription
from calibslam_msgs_py.node_worker import NewestWorker
from calibslam_msgs_py.settings import Settings, SettingsError, declare_parameters, setting

# Of images like those learnt from, 5 % are strange; of 20 independent ones more than half once in 10^9 times.
STRANGE_WINDOW, STRANGE_SHARE = 20, 0.5


@dataclass(frozen=True)
class DetectorNodeSettings(Settings):
    """Parameters of the node beside those of the detector."""

    weights: str = setting("", "file that `train` wrote; none: the weights that come with this package")


@dataclass(frozen=True)
class Waiting:
    """An image that came: how to decode it, stamp [ns], frame."""

    decode: Callable[[], np.ndarray]
    stamp: int
    frame_id: str


class DetectorNode(Node):
    """camera/image_raw or camera/image_raw/compressed -> detections, ~/overlay/compressed."""

    def __init__(self) -> None:
        super().__init__("detector")
        settings = declare_parameters(self, DetectorNodeSettings)
        detector_settings = declare_parameters(self, DetectorSettings)
        weights = Path(settings.weights) if settings.weights else SHIPPED
        try:
            self._detector = Detector.from_file(weights, detector_settings)
        except (WeightsError, DeviceError) as error:
            raise SettingsError(str(error)) from error
        self._detector(np.zeros((480, 640, 3), np.uint8))  # the first image takes longer; no camera shall wait for it
        self._types = RosTypes()
        self._counters = Counters(self)
        self._counters.set("device", self._detector.device)
        self._boxes = advertise(self, BoundingBoxArray, "detections", MEASUREMENT)
        self._overlay = advertise(self, CompressedImage, "~/overlay/compressed", SENSOR)
        self._strange: deque[bool] = deque(maxlen=STRANGE_WINDOW)
        self._worker = NewestWorker(self, self._counters, self._detect)
        for kind, topic in ((Image, "camera/image_raw"), (CompressedImage, "camera/image_raw/compressed")):
            Subscription(self, self._counters, kind, topic, self._receive, IMAGES)
        self.get_logger().info(f"detecting {', '.join(self._detector.class_names)} on {self._detector.device}")

    # -- executor's thread --------------------------------------------------------------------------------------

    def _receive(self, message: Any) -> None:
        stamp, frame_id = stamp_from_msg(message.header.stamp), str(message.header.frame_id)
        self._counters.arrived("images", stamp)
        self._worker.put(Waiting(partial(decode_image, message), stamp, frame_id))

    # -- worker's thread ----------------------------------------------------------------------------------------

    def _detect(self, waiting: Waiting) -> None:
        start = time.monotonic()
        image = waiting.decode()
        found, strangeness = self._detector(image, waiting.stamp, waiting.frame_id)
        boxes, rejected = valid_boxes(found)
        for reason, count in rejected.items():
            self._counters.count(f"rejected_box_{reason}", count)
        self._boxes.publish(boxes_to_msg(boxes, self._types))
        self._counters.count("images")
        self._counters.count("boxes", len(boxes))
        self._watch(strangeness)
        self._counters.set("detection_ms", f"{(time.monotonic() - start) * 1e3:.0f}")
        if self._overlay.get_subscription_count():
            drawn = draw_overlay(image[..., ::-1], boxes)
            data = self._types.octets(encode_jpeg(drawn, OVERLAY_QUALITY))
            header = header_to_msg(waiting.stamp, waiting.frame_id, self._types)
            self._overlay.publish(CompressedImage(header=header, format="jpeg", data=data))

    def _watch(self, strangeness: float) -> None:
        """Say where images are no longer like those that covariances were learnt from."""
        self._strange.append(strangeness > 1.0)
        share = sum(self._strange) / len(self._strange)
        self._counters.set("strange_images", f"{share:.0%} of the last {len(self._strange)}")
        if len(self._strange) == STRANGE_WINDOW and share > STRANGE_SHARE:
            self._counters.count("images_outside_what_is_known")
            self.get_logger().warning(
                f"{share:.0%} of the last images are unlike those learnt from: covariances may be too small",
                throttle_duration_sec=SECONDS_BETWEEN_WARNINGS,
            )

    def close(self) -> None:
        """Let the worker end its image."""
        self._worker.close()


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit code."""
    return run(DetectorNode, args)


if __name__ == "__main__":
    sys.exit(main())
