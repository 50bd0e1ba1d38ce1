"""Messages of a colour camera with registered depth -> steps of visual odometry, live and offline alike."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from calibslam_detector.images.image_conversion import decode_compressed_depth, decode_depth, decode_image
from calibslam_msgs_py.conversions import stamp_from_msg
from calibslam_msgs_py.measurements import Camera, InvalidMeasurement
from calibslam_msgs_py.settings import Settings, setting
from calibslam_sim.visual_odometry.frame_odometry import Step, VisualOdometry, VisualOdometrySettings
from calibslam_sim.visual_odometry.image_pairs import ImagePairs, Pair


@dataclass(frozen=True)
class DepthCameraSettings(Settings):
    """How images and depth images belong together."""

    tolerance: float = setting(0.02, "largest time between an image and its depth image", unit="s", low=0.0, high=1.0)
    any_depth_frame: bool = setting(
        False, "take depth as registered to the image, although its message names another frame"
    )


class DepthCamera:
    """One camera's images, depth images and camera_info; messages of rclpy or of bags.

    Attributes:
        rejected: how many messages were left out, by reason.
    """

    def __init__(self, settings: DepthCameraSettings, odometry: VisualOdometrySettings) -> None:
        self._settings, self._odometry_settings = settings, odometry
        self._pairs: ImagePairs[Any, Any] = ImagePairs(settings.tolerance)
        self._odometry: VisualOdometry | None = None
        self.rejected: Counter[str] = Counter()

    def set_camera(self, camera: Camera) -> None:
        """Of the colour images; the first one stays in use."""
        if self._odometry is None:
            self._odometry = VisualOdometry(camera, self._odometry_settings)

    def add_image(self, message: Any) -> list[Pair[Any, Any]]:
        """Image or CompressedImage; the pairs that are certain now."""
        return self._counted(self._pairs.add_image(stamp_from_msg(message.header.stamp), message))

    def add_depth(self, message: Any) -> list[Pair[Any, Any]]:
        """Image or CompressedImage with depth; the pairs that are certain now."""
        return self._counted(self._pairs.add_depth(stamp_from_msg(message.header.stamp), message))

    def finish(self) -> list[Pair[Any, Any]]:
        """The pairs of what still waits at the end of a recording."""
        return self._counted(self._pairs.finish())

    def step(self, pair: Pair[Any, Any]) -> Step | None:
        """The motion up to this pair, see `VisualOdometry.add`.

        Raises:
            InvalidMeasurement: `no_camera`, `depth_frame`, and those of decoding and of `VisualOdometry.add`.
        """
        if self._odometry is None:
            raise InvalidMeasurement("no_camera", "images came before camera_info")
        frame, depth_frame = str(pair.image.header.frame_id), str(pair.depth.header.frame_id)
        if frame != depth_frame and not self._settings.any_depth_frame:
            raise InvalidMeasurement(
                "depth_frame",
                f"depth is in frame '{depth_frame}', the image in '{frame}': it is not registered to the image. Have "
                "the driver align depth to colour; if it does and only names it otherwise, set any_depth_frame",
            )
        return self._odometry.add(pair.stamp, _grey(pair.image), _depth(pair.depth))

    def _counted(self, pairs: list[Pair[Any, Any]]) -> list[Pair[Any, Any]]:
        self.rejected.update(self._pairs.dropped)
        self._pairs.dropped.clear()
        return pairs


def _grey(message: Any) -> np.ndarray:
    return np.asarray(cv2.cvtColor(decode_image(message), cv2.COLOR_RGB2GRAY))


def _depth(message: Any) -> np.ndarray:
    data = np.frombuffer(message.data, np.uint8)
    if hasattr(message, "format"):
        return decode_compressed_depth(data, str(message.format))
    return decode_depth(data, message.height, message.width, message.step, message.encoding, bool(message.is_bigendian))
