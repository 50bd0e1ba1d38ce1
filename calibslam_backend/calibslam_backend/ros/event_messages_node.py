"""Messages as they come over the network, and as a journal holds them, made events of a session."""

from __future__ import annotations

from typing import Any

from calibslam_msgs.msg import BoundingBoxArray, RelativePose
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo

from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.session.intake import Content, Event, Kind, Report
from calibslam_backend.session.journal import Record
from calibslam_msgs_py.conversions import (
    BeyondImage,
    boxes_from_msg,
    camera_from_msg,
    motion_from_msg,
    pose_from_msg,
    stamp_from_msg,
    valid_boxes,
)
from calibslam_msgs_py.measurements import InvalidMeasurement, StampedPose

LARGEST = 1 << 20  # [bytes] of a message: thousands of boxes
TYPES = {
    Kind.CAMERA: CameraInfo,
    Kind.BOXES: BoundingBoxArray,
    Kind.MOTION: RelativePose,
    Kind.START: PoseWithCovarianceStamped,
}


class Decoder:
    """Serialised messages -> events. What is left out of an image is reported.

    Args:
        map_frame: that start poses must be given in.
        report: who is told.
    """

    def __init__(self, map_frame: str, report: Report) -> None:
        self._map_frame, self._report = map_frame, report
        self._beyond = BeyondImage()

    def event(self, kind: Kind, data: bytes, arrived: float) -> Event:
        """The event of a message (CDR) that came at a time (monotonic [s]).

        Raises:
            InvalidMeasurement: it is too large, cannot be decoded, or what it says cannot be.
        """
        if len(data) > LARGEST:
            raise InvalidMeasurement("message_size", f"a message of {len(data)} bytes")
        try:
            message = deserialize_message(data, TYPES[kind])
        except Exception as error:  # whatever the middleware's C code finds wrong with it
            raise InvalidMeasurement("undecodable", f"a message cannot be decoded: {error}") from None
        return Event(kind, self._content(kind, message), data, arrived)

    def recorded(self, record: Record) -> Event:
        """The event of a record.

        Raises:
            ValueError: it cannot be read.
        """
        kind = Kind(record.kind)
        if kind in TYPES:
            return self.event(kind, record.payload, 0.0)
        content = ObjectMap.from_json(record.payload.decode(), "in the journal") if kind == Kind.MAP else None
        return Event(kind, content, record.payload)

    def _content(self, kind: Kind, message: Any) -> Content:
        if kind == Kind.CAMERA:
            return camera_from_msg(message)
        if kind == Kind.MOTION:
            return motion_from_msg(message)
        if kind == Kind.START:
            if message.header.frame_id != self._map_frame:
                raise InvalidMeasurement(
                    "frame", f"a start pose in frame '{message.header.frame_id}' instead of '{self._map_frame}'"
                )
            return StampedPose(stamp_from_msg(message.header.stamp), pose_from_msg(message.pose.pose))
        drawn = boxes_from_msg(message)
        if problem := self._beyond.news(drawn):
            self._report.say(problem)
        boxes, dropped = valid_boxes(drawn)
        for reason, count in dropped.items():
            self._report.reject(InvalidMeasurement(f"box_{reason}", f"{count} boxes: {reason}"), count)
        return boxes
