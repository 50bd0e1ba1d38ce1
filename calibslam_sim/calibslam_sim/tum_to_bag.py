"""`tum_to_bag`: a recording in the format of the TUM RGB-D benchmark, as a bag.

Files in the folder, each optional but the camera: camera_info.yaml, odometry.txt, detections.csv,
groundtruth.txt, rgb.txt with colour images, depth.txt with depth images.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibslam_msgs_py import bags
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.conversions import boxes_to_msg, camera_to_msg, header_to_msg, stamped_pose_to_msg
from calibslam_msgs_py.measurements import Boxes, Camera
from calibslam_msgs_py.progress import Progress
from calibslam_sim import topics
from calibslam_sim.tum_folder import (
    FRAME_ID,
    PRESETS,
    TumError,
    preset_camera,
    read_camera,
    read_class_names,
    read_detections,
    read_image_list,
    read_trajectory,
)

TUM_DEPTH_UNITS = 5000.0  # per metre
ROS_DEPTH_UNITS = 1000.0  # per metre, REP 118
WRONG_BOXES = 0.1  # share that is no mere error of the detector
IMAGE_FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}

# Of messages with the same stamp: first what explains the others.
ORDER = (
    topics.CAMERA_INFO,
    topics.GROUND_TRUTH,
    topics.ODOMETRY,
    topics.IMAGE,
    topics.DEPTH,
    topics.DETECTIONS_WITHOUT_COVARIANCE,
)
# A message to write: time [ns], topic, and how to make it. Images are read when their turn comes.
Item = tuple[int, str, Callable[[], Any]]


def items(
    folder: Path, camera_name: str | None, detections: Path | None, class_names: Path | None = None
) -> tuple[list[Item], list[str]]:
    """What the folder holds, in order of time, and notes for the user on what it does not hold.

    Args:
        folder: in TUM format.
        camera_name: a key of `PRESETS`; None: camera_info.yaml of the folder.
        detections: another file of boxes than detections.csv of the folder.
        class_names: file with the names of the classes that the boxes have numbers of.

    Raises:
        TumError: naming the file, and what to do.
    """
    if not folder.is_dir():
        raise TumError(f"{folder} is no folder")
    camera = _camera(folder, camera_name)
    found: list[Item] = []
    notes: list[str] = []
    image_stamps: set[int] = set()

    def add(stamp: int, topic: str, make: Callable[..., Any], *arguments: Any) -> None:
        found.append((stamp, topic, lambda: make(*arguments)))

    if (folder / "odometry.txt").exists():
        poses = read_trajectory(folder / "odometry.txt")
        image_stamps.update(pose.stamp for pose in poses)
        for message, pose in zip(topics.odometry_msgs(poses, None, bags.types), poses, strict=True):
            add(pose.stamp, topics.ODOMETRY, _ready, message)
    else:
        notes.append("no odometry.txt: no odometry; a back end needs relative motions from elsewhere")
    boxes_file = detections or folder / "detections.csv"
    if detections is not None or boxes_file.exists():
        names = None if class_names is None else read_class_names(class_names)
        images = read_detections(boxes_file, camera)
        notes += doubts(boxes_file, images)
        for boxes in images:
            image_stamps.add(boxes.stamp)
            if names is not None:
                boxes = replace(boxes, class_ids=tuple(_name(each, names, boxes_file) for each in boxes.class_ids))
            add(boxes.stamp, topics.DETECTIONS_WITHOUT_COVARIANCE, _boxes, boxes)
    else:
        notes.append("no detections.csv: no boxes; run a detector, or name a file with --detections")
        if class_names is not None:
            notes.append(f"{class_names} is not used: no boxes, so no numbers of classes")
    if (folder / "rgb.txt").exists():
        for stamp, file in read_image_list(folder / "rgb.txt"):
            image_stamps.add(stamp)
            add(stamp, topics.IMAGE, _image, stamp, file)
    else:
        notes.append("no rgb.txt: no images")
    if (folder / "depth.txt").exists():
        for stamp, file in read_image_list(folder / "depth.txt"):
            add(stamp, topics.DEPTH, _depth_image, stamp, file)
    if (folder / "groundtruth.txt").exists():
        for pose in read_trajectory(folder / "groundtruth.txt"):
            add(pose.stamp, topics.GROUND_TRUTH, stamped_pose_to_msg, pose, topics.WORLD, bags.types)
    else:
        notes.append("no groundtruth.txt: nothing to evaluate against")
    if not image_stamps:
        raise TumError(f"{folder} holds neither odometry.txt nor detections.csv nor rgb.txt: nothing to convert")
    for stamp in image_stamps:
        add(stamp, topics.CAMERA_INFO, camera_to_msg, camera, stamp, bags.types)
    found.sort(key=lambda item: (item[0], ORDER.index(item[1])))
    return found, notes


def doubts(file: Path, images: Sequence[Boxes]) -> list[str]:
    """Notes on boxes that can hardly be meant as they are written."""
    if not images:
        return [f"{file} names columns, but holds no boxes"]
    corners = np.concatenate([boxes.corners for boxes in images])
    if (np.abs(corners) <= 1.0).all():
        return [f"{file}: no corner is above 1: are they shares of the image (normalised)? They must be pixels"]
    wrong = int((corners[:, 2] <= corners[:, 0]).sum())
    if wrong > WRONG_BOXES * len(corners):
        return [
            f"{file}: xmax is not above xmin in {wrong} of {len(corners)} boxes: are they x, y, width, height (xywh)? "
            "They must be xmin, ymin, xmax, ymax"
        ]
    return []


def _camera(folder: Path, name: str | None) -> Camera:
    if name is not None:
        return preset_camera(name)
    path = folder / "camera_info.yaml"
    if path.exists():
        return read_camera(path)
    raise TumError(
        f"{path} is missing. For a recording of the TUM benchmark say which camera it is: --camera fr1, fr2 "
        "or fr3 (the number in its name). For your own camera write that file, as ROS' camera_calibration "
        "does, with the keys image_width, image_height, camera_matrix, distortion_model (plumb_bob) and "
        "distortion_coefficients"
    )


def _name(class_id: str, names: Sequence[str], boxes_file: Path) -> str:
    if not class_id.isdecimal() or int(class_id) >= len(names):
        raise TumError(
            f"{boxes_file}: class {class_id} is not one of the {len(names)} of --class-names, which count from 0"
        )
    return names[int(class_id)]


def _ready(message: Any) -> Any:
    return message


def _boxes(boxes: Boxes) -> Any:
    return boxes_to_msg(boxes, bags.types)


def _image(stamp: int, file: Path) -> Any:
    """The file as it is."""
    if file.suffix.lower() not in IMAGE_FORMATS:
        raise TumError(f"{file}: images must be {', '.join(IMAGE_FORMATS)}")
    return bags.types("sensor_msgs/msg/CompressedImage")(
        header=header_to_msg(stamp, FRAME_ID, bags.types),
        format=IMAGE_FORMATS[file.suffix.lower()],
        data=bags.types.octets(file.read_bytes()),
    )


def _depth_image(stamp: int, file: Path) -> Any:
    """16-bit depth in mm, 0 where unknown (REP 118)."""
    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
        raise TumError(f"{file}: not a 16-bit PNG of one channel")
    millimetres = np.rint(depth * (ROS_DEPTH_UNITS / TUM_DEPTH_UNITS)).astype("<u2")
    height, width = depth.shape
    return bags.types("sensor_msgs/msg/Image")(
        header=header_to_msg(stamp, FRAME_ID, bags.types),
        height=height,
        width=width,
        encoding="16UC1",
        is_bigendian=0,
        step=2 * width,
        data=bags.types.octets(millimetres.tobytes()),
    )


def convert(
    folder: Path,
    out: Path,
    camera: str | None = None,
    detections: Path | None = None,
    overwrite: bool = False,
    class_names: Path | None = None,
) -> tuple[dict[str, int], list[str]]:
    """Write the bag; returns the number of messages of each topic, and notes for the user."""
    found, notes = items(folder, camera, detections, class_names)
    counts: dict[str, int] = {}
    with bags.BagWriter(out, overwrite) as bag, Progress(len(found), f"writing {out}") as progress:
        for stamp, topic, make in found:
            bag.write(topic, make(), stamp)
            counts[topic] = counts.get(topic, 0) + 1
            progress.step()
    return counts, notes


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `tum_to_bag`; returns the exit code."""
    parser = ArgumentParser(
        prog="tum_to_bag", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder in the format of the TUM benchmark")
    parser.add_argument("--out", type=Path, required=True, metavar="BAG", help="folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace the bag if it exists")
    parser.add_argument(
        "--camera", choices=sorted(PRESETS), help="published intrinsics instead of DIR/camera_info.yaml"
    )
    parser.add_argument(
        "--detections", type=Path, metavar="FILE", help="boxes (default: DIR/detections.csv where it exists)"
    )
    parser.add_argument(
        "--class-names",
        type=Path,
        metavar="FILE",
        help="names instead of the numbers in class_id: a line for each class, from 0 on, as YOLO's coco.names",
    )
    arguments = parser.parse_args(argv)
    try:
        counts, notes = convert(
            arguments.folder,
            arguments.out,
            arguments.camera,
            arguments.detections,
            arguments.overwrite,
            arguments.class_names,
        )
    except (TumError, bags.BagError) as error:
        print(f"tum_to_bag: {error}", file=sys.stderr)
        return 1
    for note in notes:
        print(f"note: {note}")
    for topic, count in sorted(counts.items()):
        print(f"{count:7d}  {topic}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
