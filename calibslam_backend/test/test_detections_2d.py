"""Boxes of vision_msgs: as messages, and in bags that somebody recorded with a detector of theirs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from calibslam_backend.recording import Recording
from calibslam_msgs_py import bags
from calibslam_msgs_py.bag_types import new_typestore
from calibslam_msgs_py.bags import BagError, BagReader, BagWriter
from calibslam_msgs_py.conversions import camera_to_msg, header_to_msg, motion_to_msg
from calibslam_msgs_py.detection_conversions import DETECTIONS_2D, boxes_from_detections_2d
from calibslam_msgs_py.measurements import SECOND, Boxes, Camera, InvalidMeasurement, RelativeMotion

CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]), np.zeros(5), "camera")
# The layout of ROS 2 Humble to Jazzy.
DEFINITIONS = {
    "Point2D": "float64 x\nfloat64 y",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id"
    ),
    "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
}


def types() -> Any:
    store = new_typestore()
    definitions: dict[str, Any] = {}
    for name, text in DEFINITIONS.items():
        definitions.update(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    store.register(definitions)
    return store


def detection(
    centre: tuple[float, float], size: tuple[float, float], theta: float, results: dict[str, float], identity: str = ""
) -> Message:
    return Message(
        bbox=Message(
            center=Message(position=Message(x=centre[0], y=centre[1]), theta=theta), size_x=size[0], size_y=size[1]
        ),
        results=[Message(hypothesis=Message(class_id=name, score=score)) for name, score in results.items()],
        id=identity,
    )


def array(*detections: Message) -> Message:
    header = Message(stamp=Message(sec=3, nanosec=5), frame_id="optical")
    return Message(header=header, detections=list(detections))


def test_centre_and_size_become_corners() -> None:
    message = array(
        detection((100.0, 80.0), (40.0, 20.0), 0.0, {"bowl": 0.2, "cup": 0.7, "vase": 0.1}, "17"),
        detection((10.5, 20.5), (1.0, 3.0), 0.0005, {"0": 0.9}),
    )
    boxes, rejected = boxes_from_detections_2d(message, CAMERA)
    np.testing.assert_array_equal(boxes.corners, [[80.0, 70.0, 120.0, 90.0], [10.0, 19.0, 11.0, 22.0]])
    assert (boxes.class_ids, boxes.object_ids, list(boxes.scores)) == (("cup", "0"), ("17", ""), [0.7, 0.9])
    assert (boxes.stamp, boxes.width, boxes.height, boxes.frame_id) == (3 * SECOND + 5, 640, 480, "optical")
    assert not boxes.has_covariance.any() and rejected == {}


def test_what_is_no_upright_box_of_a_class_is_counted() -> None:
    message = array(
        detection((9.0, 9.0), (4.0, 4.0), 0.5, {"cup": 0.9}),
        detection((9.0, 9.0), (4.0, 4.0), 0.0, {}),
        detection((9.0, 9.0), (4.0, 4.0), 0.0, {"cup": 0.9}),
    )
    boxes, rejected = boxes_from_detections_2d(message, CAMERA)
    assert len(boxes) == 1 and rejected == {"rotated": 1, "no_hypothesis": 1}
    assert len(boxes_from_detections_2d(array(), CAMERA)[0]) == 0


def test_an_older_layout_is_named() -> None:
    old = Message(bbox=Message(center=Message(x=1.0, y=2.0, theta=0.0), size_x=1.0, size_y=1.0), results=[1], id="")
    with pytest.raises(InvalidMeasurement) as refused:
        boxes_from_detections_2d(array(old), CAMERA)
    assert refused.value.reason == "layout"


def record(path: Path, *topics: str) -> Path:
    """A bag with boxes of vision_msgs, which neither ROS' standard types nor ours contain."""
    store = types()
    make = store.types
    header = header_to_msg(2 * SECOND, "camera", bags.types)
    pose = make["geometry_msgs/msg/PoseWithCovariance"](
        pose=motion_to_msg(RelativeMotion(0, 1, np.eye(4)), bags.types).motion.pose, covariance=np.zeros(36)
    )
    boxes = []
    for x, score in ((100.0, 0.9), (-500.0, 0.8)):
        hypothesis = make["vision_msgs/msg/ObjectHypothesis"](class_id="cup", score=score)
        centre = make["vision_msgs/msg/Pose2D"](position=make["vision_msgs/msg/Point2D"](x=x, y=80.0), theta=0.0)
        boxes.append(
            make["vision_msgs/msg/Detection2D"](
                header=header,
                results=[make["vision_msgs/msg/ObjectHypothesisWithPose"](hypothesis=hypothesis, pose=pose)],
                bbox=make["vision_msgs/msg/BoundingBox2D"](center=centre, size_x=40.0, size_y=20.0),
                id="",
            )
        )
    message = make[DETECTIONS_2D](header=header, detections=boxes)
    motion = motion_to_msg(RelativeMotion(SECOND, 2 * SECOND, np.eye(4)), bags.types)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for topic in topics:
            connection = bag.add_connection(topic, DETECTIONS_2D, typestore=store)
            bag.write(connection, 2 * SECOND, store.serialize_cdr(message, DETECTIONS_2D))
        for topic, other in (
            ("/camera/camera_info", camera_to_msg(CAMERA, SECOND, bags.types)),
            ("/relative_pose", motion),
        ):
            connection = bag.add_connection(topic, other.__msgtype__, typestore=store)
            bag.write(connection, 2 * SECOND, store.serialize_cdr(other, other.__msgtype__))
    return path


def test_bags_are_read_whatever_the_topic_is_called(tmp_path: Path) -> None:
    recording = Recording.open(record(tmp_path / "bag", "/yolo/boxes"))
    found = list(recording.measurements())
    boxes = next(item for item in found if isinstance(item, Boxes))
    assert any(isinstance(item, RelativeMotion) for item in found)
    np.testing.assert_array_equal(boxes.corners, [[80.0, 70.0, 120.0, 90.0]])
    assert boxes.has_covariance.all()  # of the calibrator
    assert recording.rejected == {"box_outside": 1}


def test_bags_with_two_of_them_or_none(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="boxes on /a and /b: keep one"):
        Recording.open(record(tmp_path / "two", "/a", "/b"))
    boxes = [
        item
        for item in Recording.open(tmp_path / "two", named={"detections": "/b"}).measurements()
        if isinstance(item, Boxes)
    ]
    np.testing.assert_array_equal(boxes[0].corners, [[80.0, 70.0, 120.0, 90.0]])
    with pytest.raises(BagError, match="no topic /detections or /detections_raw or any of vision_msgs/msg/Detection2D"):
        Recording.open(record(tmp_path / "none"))


def test_types_of_other_packages_are_copied(tmp_path: Path) -> None:
    with BagReader(record(tmp_path / "bag", "/boxes")) as source, BagWriter(tmp_path / "copy") as copy:
        with pytest.raises(BagError, match="unknown message type"):
            copy.add_topic("/boxes", DETECTIONS_2D)
        assert copy.adopt(source) == sorted(source.topics)
        for topic, stamp, data in source.raw_messages(list(source.topics)):
            copy.write_raw(topic, source.topics[topic], data, stamp)
    with BagReader(tmp_path / "copy") as copied:
        ((_, _, message),) = copied.messages(["/boxes"])
    assert message.detections[0].results[0].hypothesis.class_id == "cup"


def test_a_type_that_contradicts_ours_is_not_copied(tmp_path: Path) -> None:
    store = new_typestore()
    name = "std_msgs/msg/Bool"
    store.fielddefs.pop(name)
    store.types.pop(name)
    store.register(get_types_from_msg("int64 data", name))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/b", name, typestore=store)
        bag.write(connection, 1, store.serialize_cdr(store.types[name](data=1), name))
    with BagReader(tmp_path / "bag") as source, BagWriter(tmp_path / "copy") as copy:
        assert copy.adopt(source) == []
