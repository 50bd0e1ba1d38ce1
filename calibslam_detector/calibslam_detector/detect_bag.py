"""`detect_bag BAG --out BAG2`: the detector on the images of a bag, without ROS.

BAG2 holds what BAG holds, with the detector's boxes on /detections instead of those that were there. No image is
dropped, and the same bag gives the same boxes each time.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_detector.images.image_conversion import OVERLAY_QUALITY, decode_image, encode_jpeg
from calibslam_detector.images.overlay import draw_overlay
from calibslam_detector.model.detector import Detector, DetectorSettings, DeviceError
from calibslam_detector.model.weights_file import SHIPPED, WeightsError
from calibslam_msgs_py import bags
from calibslam_msgs_py.bags import BagError, BagReader, BagWriter, refuse_to_replace
from calibslam_msgs_py.command import INTERRUPTED, ArgumentParser, command
from calibslam_msgs_py.conversions import boxes_to_msg, header_to_msg, stamp_from_msg, valid_boxes
from calibslam_msgs_py.measurements import Boxes, InvalidMeasurement
from calibslam_msgs_py.progress import Progress
from calibslam_msgs_py.settings import Settings, SettingsError, add_arguments, from_arguments, setting

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
USUAL_TOPICS = ("/camera/image_raw/compressed", "/camera/image_raw")  # as the node has them
OVERLAY = "/detector/overlay/compressed"  # as the node has it
BOXES = "calibslam_msgs/msg/BoundingBoxArray"
STRANGE_SHARE = 0.5  # of the images, above which a warning is due


@dataclass(frozen=True)
class DetectBagSettings(Settings):
    """What is read and written."""

    image_topic: str = setting("", f"images to detect on; none: {' or '.join(USUAL_TOPICS)}")
    topic: str = setting("/detections", "where the boxes go; what is there in BAG is left out")
    images: bool = setting(True, "copy the images, too")
    overlay: bool = setting(False, f"write images with the boxes drawn on them to {OVERLAY}")


@dataclass(frozen=True)
class Summary:
    """What was done.

    Attributes:
        images: detected on.
        boxes: found.
        strange: images unlike those that the detector has learnt from.
        left_out: why and how many images, boxes or topics were left out.
    """

    images: int
    boxes: int
    strange: int
    left_out: Counter[str]


def detect_bag(bag: Path, out: Path, detector: Detector, settings: DetectBagSettings, overwrite: bool) -> Summary:
    """Write `out`: `bag` with the boxes that the detector finds, at the log times of the images.

    Raises:
        BagError: the bag cannot be read, has no such images, or `out` exists or would replace it.
    """
    refuse_to_replace(out, bag)
    images, found, strange = 0, 0, 0
    left_out: Counter[str] = Counter()
    # One reader for what is copied as it is and one for the images: each has its own place in the file.
    with BagReader(bag) as reader, BagReader(bag) as image_reader, BagWriter(out, overwrite) as writer:
        image_topic = _image_topic(reader, settings.image_topic)
        copied = _copied_topics(reader, writer, settings, image_topic, left_out)
        writer.add_topic(settings.topic, BOXES)
        everything = merge(
            reader.raw_messages(copied), _marked(image_reader.messages([image_topic])), key=lambda item: item[1]
        )
        with Progress(reader.counts[image_topic], "detecting") as progress:
            for topic, time, content in everything:
                if topic:
                    writer.write_raw(topic, reader.topics[topic], content, time)
                    continue
                progress.step()
                try:
                    image = decode_image(content)
                    stamp, frame_id = stamp_from_msg(content.header.stamp), str(content.header.frame_id)
                    boxes, strangeness = detector(image, stamp, frame_id)
                except InvalidMeasurement as error:
                    left_out[f"image: {error.reason}"] += 1
                    continue
                boxes, rejected = valid_boxes(boxes)
                left_out.update({f"box: {reason}": count for reason, count in rejected.items()})
                writer.write(settings.topic, boxes_to_msg(boxes, bags.types), time)
                if settings.overlay:
                    writer.write(OVERLAY, _overlay(image, boxes), time)
                images, found, strange = images + 1, found + len(boxes), strange + (strangeness > 1.0)
        left_out["image: damaged message"] += image_reader.rejected[image_topic]
    return Summary(images, found, strange, +left_out)


def _image_topic(reader: BagReader, wanted: str) -> str:
    """The topic of the images.

    Raises:
        BagError: there is none, or one has to be chosen.
    """
    there = [name for name, kind in reader.topics.items() if kind in (RAW, COMPRESSED)]
    choice = (wanted,) if wanted else USUAL_TOPICS
    for name in choice:
        if name in there:
            return name
    if not there:
        raise BagError(f"{reader.path} has no images; a simulated recording has them with `simulate --images`")
    raise BagError(f"{reader.path} has no images on {' or '.join(choice)}; choose by --image-topic: {', '.join(there)}")


def _copied_topics(
    reader: BagReader, writer: BagWriter, settings: DetectBagSettings, image_topic: str, left_out: Counter[str]
) -> list[str]:
    """The topics that are copied as they are; they are made in the new bag."""
    replaced = {settings.topic} | ({OVERLAY} if settings.overlay else set())
    usable = writer.adopt(reader)
    copied = []
    for name, kind in reader.topics.items():
        if name in replaced or (name == image_topic and not settings.images):
            continue
        if name not in usable:
            left_out[f"topic {name}, whose type {kind} is not defined in the bag"] += reader.counts[name]
            continue
        writer.add_topic(name, kind)
        copied.append(name)
    return copied


def _marked(messages: Iterator[tuple[str, int, Any]]) -> Iterator[tuple[str, int, Any]]:
    """Images to detect on, told from what is copied by an empty name."""
    return (("", time, message) for _, time, message in messages)


def _overlay(image: np.ndarray, boxes: Boxes) -> Any:
    drawn = draw_overlay(image[..., ::-1], boxes)
    data = bags.types.octets(encode_jpeg(drawn, OVERLAY_QUALITY))
    header = header_to_msg(boxes.stamp, boxes.frame_id, bags.types)
    return bags.types(COMPRESSED)(header=header, format="jpeg", data=data)


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `detect_bag`; returns the exit code."""
    parser = ArgumentParser(
        prog="detect_bag", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 folder or .mcap file with images")
    parser.add_argument("--out", type=Path, required=True, metavar="BAG2", help="bag to write")
    parser.add_argument("--overwrite", action="store_true", help="replace the bag if it exists")
    parser.add_argument(
        "--weights",
        type=Path,
        default=SHIPPED,
        metavar="FILE",
        help="detector that `train` wrote (default: the shipped)",
    )
    add_arguments(parser, DetectBagSettings)
    parser.add_argument(
        "--image", dest="image_topic", default=argparse.SUPPRESS, metavar="TOPIC",
        help="the same as --image-topic, as `visual_odometry_bag` has it",
    )  # fmt: skip
    add_arguments(parser, DetectorSettings)
    arguments = parser.parse_args(argv)
    try:
        settings = from_arguments(arguments, DetectBagSettings)
        detector = Detector.from_file(arguments.weights, from_arguments(arguments, DetectorSettings))
        done = detect_bag(arguments.bag, arguments.out, detector, settings, arguments.overwrite)
    except (BagError, WeightsError, DeviceError, SettingsError) as error:
        print(f"detect_bag: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("detect_bag: interrupted; nothing was written", file=sys.stderr)
        return INTERRUPTED
    print(f"{arguments.out}: {done.boxes} boxes in {done.images} images on {settings.topic}")
    for reason, count in sorted(done.left_out.items()):
        print(f"left out: {reason} ({count})")
    if done.strange > STRANGE_SHARE * done.images:
        print(
            f"warning: {done.strange} of {done.images} images are unlike those the detector has learnt from: boxes may "
            "be missing, and covariances too small",
            file=sys.stderr,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
