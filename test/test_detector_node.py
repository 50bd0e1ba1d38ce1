"""The detector's node as a real process: images of a bag in, boxes out, and what is wrong is counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from calibslam_msgs.msg import BoundingBoxArray
from live import Process, Watcher, random_domain, wait_until
from sensor_msgs.msg import CompressedImage, Image

from calibslam_detector.images.image_conversion import decode_compressed
from calibslam_detector.model import weights_file
from calibslam_detector.model.detector import Detector, DetectorSettings
from calibslam_detector.model.network import CalibratedDetector
from calibslam_msgs_py.bags import BagReader
from calibslam_msgs_py.conversions import RosTypes, boxes_from_msg, header_to_msg, stamp_from_msg, valid_boxes
from calibslam_msgs_py.node import LATCHED, MEASUREMENT, SENSOR
from calibslam_sim import simulate, topics

TYPES = RosTypes()
CLASSES = ("cup", "book")
THRESHOLD = 0.2  # random weights are not surer than that


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(4)
    path = tmp_path_factory.mktemp("weights") / "weights.pt"
    weights_file.save(CalibratedDetector("compact", CLASSES), path)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("images") / "bag"
    assert simulate.main(["--out", str(path), "--images", "--duration", "0.2", "--frame-rate", "10"]) == 0
    return path


def arguments(weights: Path) -> list[str]:
    parameters = {"weights": str(weights), "score_threshold": str(THRESHOLD), "device": "cpu", "threads": "1"}
    # The bag has boxes of its own on `detections`.
    return [
        "--ros-args",
        "-r",
        "detections:=found",
        *(part for item in parameters.items() for part in ("-p", ":=".join(item))),
    ]


@pytest.fixture(scope="module")
def live(weights: Path) -> Iterator[tuple[int, Watcher, Process]]:
    domain = random_domain()
    with Watcher(domain) as watcher, Process(domain, "calibslam_detector", "detector", *arguments(weights)) as process:
        watcher.listen(BoundingBoxArray, "/found", MEASUREMENT)
        watcher.listen(CompressedImage, "/detector/overlay/compressed", SENSOR)
        wait_until(lambda: watcher.counts("/detector"), lambda: f"no diagnostics; it says: {process.output}")
        yield domain, watcher, process


def test_images_of_a_bag_become_boxes(live: tuple[int, Watcher, Process], bag: Path, weights: Path) -> None:
    domain, watcher, process = live
    with BagReader(bag) as reader:
        images = {stamp_from_msg(message.header.stamp): message for _, _, message in reader.messages([topics.IMAGE])}

    def found() -> bool:
        return bool(watcher.received["/found"] and watcher.received["/detector/overlay/compressed"])

    # The bag is short: while subscriber and publisher find each other and agree on reliability, all of it may be over.
    for _ in range(10):
        if not found():
            with Process(domain, "calibslam_sim", "play", str(bag), "--rate", "0.1") as player:
                assert player.wait() == 0
    wait_until(found, lambda: f"{watcher.received} {process.output}")
    boxes = boxes_from_msg(watcher.last["/found"])
    image = images[boxes.stamp]  # one of them: a busy machine drops others
    assert (boxes.width, boxes.height, boxes.frame_id) == (640, 480, image.header.frame_id)
    # What comes out is what the detector says, with covariances that can be used.
    expected, _ = Detector.from_file(weights, DetectorSettings(THRESHOLD, "cpu"))(decode_compressed(image.data))
    expected, _ = valid_boxes(expected)
    assert len(expected) > 0
    np.testing.assert_allclose(boxes.corners, expected.corners, atol=0.01)
    np.testing.assert_allclose(boxes.covariances, expected.covariances, rtol=1e-3, atol=1e-3)
    assert boxes.class_ids == expected.class_ids and valid_boxes(boxes)[1] == {}
    overlay = watcher.last["/detector/overlay/compressed"]
    assert cv2.imdecode(np.frombuffer(overlay.data, np.uint8), cv2.IMREAD_COLOR).shape == (480, 640, 3)


def test_bad_images_are_counted_and_old_ones_dropped(live: tuple[int, Watcher, Process]) -> None:
    _, watcher, process = live
    before = watcher.received["/found"]
    raw = watcher.node.create_publisher(Image, "/camera/image_raw", SENSOR)
    compressed = watcher.node.create_publisher(CompressedImage, "/camera/image_raw/compressed", LATCHED)
    for publisher in (raw, compressed):
        wait_until(lambda p=publisher: p.get_subscription_count() == 1, "the detector does not subscribe")

    def counts() -> dict[str, str]:
        return watcher.counts("/detector")

    def send(stamp: int, encoding: str, step: int) -> None:
        data = TYPES.octets(bytes(120 * 160 * 3))
        header = header_to_msg(stamp, "camera", TYPES)
        raw.publish(Image(header=header, height=120, width=160, encoding=encoding, step=step, data=data))

    broken = CompressedImage(header=header_to_msg(1, "camera", TYPES), format="jpeg", data=TYPES.octets(b"no image"))

    def rejected(name: str, publish: Callable[[], None]) -> bool:
        """Published again and again: a best-effort subscriber may not have heard of its new publisher yet."""
        publish()
        time.sleep(0.2)
        return int(counts().get(name, 0)) > 0

    for name, publish in (
        ("rejected_corrupt_image", lambda: compressed.publish(broken)),
        ("rejected_encoding", lambda: send(2, "16UC1", 480)),
        ("rejected_image_size", lambda: send(3, "rgb8", 481)),
    ):
        wait_until(lambda n=name, p=publish: rejected(n, p), lambda: f"{counts()}")
    # It goes on; of many at once the newest counts, and none gets lost without being counted.
    for stamp in range(10, 40):
        send(stamp, "bgr8", 480)
    wait_until(
        lambda: watcher.received["/found"] and watcher.last["/found"].header.stamp.nanosec == 39,
        lambda: f"{counts()} {watcher.received}",
    )
    wait_until(lambda: int(counts().get("dropped", 0)) > 0, lambda: f"{counts()}")
    wait_until(lambda: int(counts()["images"]) == watcher.received["/found"], lambda: f"{counts()}")
    assert int(counts()["images"]) - before + int(counts()["dropped"]) <= 30
    assert process.end() == 0


def test_weights_that_cannot_be_used_are_refused_at_start(tmp_path: Path) -> None:
    (tmp_path / "w.pt").write_text("hello")
    options = ["--ros-args", "-p", f"weights:={tmp_path / 'w.pt'}"]
    with Process(random_domain(), "calibslam_detector", "detector", *options) as process:
        assert process.wait() == 2
        assert "is damaged or not written by torch" in process.output
