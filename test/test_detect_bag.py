"""The shipped detector on the images of a rendered recording: offline, without ROS, and the same each time."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibslam_detector import detect_bag, evaluate_detector
from calibslam_detector.model.detector import Detector, DetectorSettings
from calibslam_detector.model.weights_file import SHIPPED
from calibslam_detector.training.matching import match
from calibslam_msgs_py import bags
from calibslam_msgs_py.bags import BagReader, BagWriter
from calibslam_msgs_py.conversions import boxes_from_msg, header_to_msg, stamp_from_msg
from calibslam_msgs_py.measurements import Boxes
from calibslam_sim import simulate, topics
from calibslam_sim.rendering.coco_writer import CLASSES

TIMES, IMAGE_EVERY = 31, 6


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A second of the desk, every sixth image rendered; and these images in COCO format."""
    folder = tmp_path_factory.mktemp("recording")
    options = ["--images", "--image-every", str(IMAGE_EVERY), "--duration", "1", "--coco", str(folder / "coco")]
    assert simulate.main(["--out", str(folder / "bag"), *options]) == 0
    return folder / "bag", folder / "coco"


@pytest.fixture(scope="module")
def detected(recording: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("detected") / "bag"
    assert detect_bag.main([str(recording[0]), "--out", str(out), "--device", "cpu", "--overlay"]) == 0
    return out


def boxes_in(bag: Path, topic: str = topics.DETECTIONS) -> list[tuple[int, Boxes]]:
    with BagReader(bag) as reader:
        return [(time, boxes_from_msg(message)) for _, time, message in reader.messages([topic])]


def raw(bag: Path, topic: str) -> list[tuple[str, int, bytes]]:
    with BagReader(bag) as reader:
        return list(reader.raw_messages([topic]))


def test_only_every_so_many_th_image_is_rendered(recording: tuple[Path, Path]) -> None:
    with BagReader(recording[0]) as reader:
        assert reader.counts[topics.DETECTIONS] == TIMES
        stamps = [stamp_from_msg(message.header.stamp) for _, _, message in reader.messages([topics.IMAGE])]
    assert stamps == [boxes.stamp for _, boxes in boxes_in(recording[0])][::IMAGE_EVERY]


def test_boxes_replace_those_that_were_there(recording: tuple[Path, Path], detected: Path) -> None:
    bag = recording[0]
    with BagReader(bag) as before, BagReader(detected) as after:
        assert set(after.topics) == {*before.topics, detect_bag.OVERLAY}
        images = {time for _, time, _ in before.messages([topics.IMAGE])}
        pictures = [message for _, _, message in after.messages([detect_bag.OVERLAY])]
    for topic in (topics.IMAGE, topics.ODOMETRY, topics.GROUND_TRUTH, topics.GROUND_TRUTH_QUADRICS):
        assert raw(detected, topic) == raw(bag, topic)
    found = boxes_in(detected)
    assert {time for time, _ in found} == images and len(found) == len(images)
    assert [boxes.stamp for _, boxes in found] == [time for time, _ in found]
    assert all(boxes.frame_id == "camera" and (boxes.width, boxes.height) == (640, 480) for _, boxes in found)
    assert len(pictures) == len(found)
    assert cv2.imdecode(np.asarray(pictures[0].data), cv2.IMREAD_COLOR).shape == (480, 640, 3)


def test_the_shipped_detector_finds_objects_and_knows_their_errors(
    recording: tuple[Path, Path], detected: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a desk it has not learnt from, against the simulated boxes: neither loose nor blind."""
    truth = {boxes.stamp: boxes for _, boxes in boxes_in(recording[0])}
    errors = []
    for _, boxes in boxes_in(detected):
        true = truth[boxes.stamp]
        labels = [np.array([CLASSES.index(name) for name in b.class_ids]) for b in (boxes, true)]
        assert boxes.has_covariance.all()
        found, of = match(boxes.corners, labels[0], true.corners, labels[1])
        assert len(found) > 0.4 * len(true)
        errors.append(true.corners[of] - boxes.corners[found])
    assert np.median(np.abs(np.concatenate(errors))) < 8.0  # px
    assert evaluate_detector.main([str(recording[1]), "--out", str(tmp_path / "evaluation")]) == 0
    numbers = dict(line.split() for line in capsys.readouterr().out.splitlines() if len(line.split()) == 2)
    assert float(numbers["map_50"]) > 0.5


def test_the_same_bag_gives_the_same_bytes(recording: tuple[Path, Path], tmp_path: Path) -> None:
    for name in ("a", "b"):
        options = ["--device", "cpu", "--no-images", "--topic", "/found"]
        assert detect_bag.main([str(recording[0]), "--out", str(tmp_path / name / "bag"), *options]) == 0
    first, second = (tmp_path / name / "bag" / "bag.mcap" for name in ("a", "b"))  # a bag knows its own name
    assert first.read_bytes() == second.read_bytes()
    with BagReader(first) as reader:
        assert topics.IMAGE not in reader.topics
        assert (reader.counts[topics.DETECTIONS], reader.counts["/found"]) == (TIMES, TIMES // IMAGE_EVERY + 1)


def test_images_that_cannot_be_decoded_are_left_out_and_counted(tmp_path: Path) -> None:
    types = bags.types
    image = types("sensor_msgs/msg/Image")
    with BagWriter(tmp_path / "bag") as bag:
        for stamp, encoding, height, width in (
            (10, "16UC1", 120, 160),
            (20, "bgr8", 120, 160),
            (30, "yuv422", 120, 161),
            (40, "mono8", 1, 1000),
            (50, "mono8", 5000, 3),
        ):
            data = types.octets(bytes(height * width * 3))
            header = header_to_msg(stamp, "camera", types)
            message = image(
                header=header, height=height, width=width, encoding=encoding, is_bigendian=0, step=3 * width, data=data
            )
            bag.write("/camera/image_raw", message, stamp)
    detector = Detector.from_file(SHIPPED, DetectorSettings(device="cpu"))
    settings = detect_bag.DetectBagSettings()
    done = detect_bag.detect_bag(tmp_path / "bag", tmp_path / "out", detector, settings, overwrite=False)
    assert done.images == 1 and done.left_out == {"image: encoding": 1, "image: image_size": 3}
    assert done.strange == 1  # black images are not what it has learnt from
    assert [time for time, _ in boxes_in(tmp_path / "out")] == [20]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--image", "/nowhere"], "no images on /nowhere; choose by --image-topic"),
        (["--image-topic", "/nowhere"], "choose by --image-topic: /camera/image_raw/compressed"),
        (["--weights", "nothing.pt"], "weights file nothing.pt cannot be read"),
    ],
)
def test_what_cannot_be_done_is_said_and_leaves_nothing_behind(
    recording: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert detect_bag.main([str(recording[0]), "--out", str(tmp_path / "out"), *options]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_bags_without_images_and_the_bag_itself_are_refused(
    recording: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate.main(["--out", str(tmp_path / "bag"), "--duration", "0.1"]) == 0
    assert detect_bag.main([str(tmp_path / "bag"), "--out", str(tmp_path / "out")]) == 1
    assert "has no images; a simulated recording has them with `simulate --images`" in capsys.readouterr().err
    for read in (recording[0], recording[0] / "bag.mcap"):
        assert detect_bag.main([str(read), "--out", str(recording[0]), "--overwrite"]) == 1
        assert "choose another path" in capsys.readouterr().err
    assert (recording[0] / "bag.mcap").exists()
