"""`draw_run RUN BAG --out DIR`: what the map says an image shows, drawn on the images of a recording.

Each keyframe's image with the boxes that the run was given (thin, with ellipses of 2 sigma) and the outlines of the
quadrics (thick), as JPEG named by its time. Where an object lies beside its outline, the map or the pose is wrong.
The boxes come from the recording that metrics.json of the run names, or from BAG where that is not there any more.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from calibslam_backend.output.object_map import MapFileError, ObjectMap
from calibslam_backend.recording import Recording
from calibslam_detector.images.image_conversion import decode_image, encode_jpeg
from calibslam_detector.images.overlay import class_colour, draw_label, draw_overlay
from calibslam_msgs_py.bags import BagError, BagReader
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.conversions import stamp_from_msg
from calibslam_msgs_py.measurements import SECOND, Array, Boxes, Camera, InvalidMeasurement
from calibslam_msgs_py.progress import Progress
from calibslam_sim import topics
from calibslam_sim.run_report.loading import ReportError, own_recording, read_metrics

POINTS = 64  # of an outline
JPEG_QUALITY = 90


def outline(T_camera_object: Array, radii: Array) -> Array | None:
    """(POINTS, 2) points of an ellipsoid's outline in normalised image coordinates; None if part is not in front.

    The dual conic of an ellipse with centre m and half axes L is that of [[L L' - m m', -m], [-m', -1]].

    Args:
        T_camera_object: (4, 4).
        radii: (3,) semi-axes [m].
    """
    B, centre = T_camera_object[:3, :3], T_camera_object[:3, 3]
    dual = (B * radii**2) @ B.T - np.outer(centre, centre)
    if centre[2] <= 0.0 or dual[2, 2] >= 0.0:
        return None
    dual = dual / -dual[2, 2]
    middle = -dual[:2, 2]
    L = np.linalg.cholesky(dual[:2, :2] + np.outer(middle, middle))
    angles = np.linspace(0.0, 2.0 * np.pi, POINTS, endpoint=False)
    return np.asarray(middle + np.column_stack([np.cos(angles), np.sin(angles)]) @ L.T)


def draw(image: np.ndarray, boxes: Boxes | None, known: ObjectMap, T_map_camera: Array, camera: Camera) -> np.ndarray:
    """A copy of an image (H, W, 3) uint8 BGR with boxes and outlines."""
    drawn = image.copy() if boxes is None else draw_overlay(image, boxes)
    for quadric in known.quadrics:
        points = outline(np.linalg.inv(T_map_camera) @ quadric.T_map_object, quadric.radii)
        if points is None:
            continue
        rays = np.column_stack([points, np.ones(len(points))])
        pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.distortion)[0].reshape(-1, 2)
        inside = (pixels >= 0.0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
        # Distortion is a polynomial fitted to the image: far outside it is anything.
        if not inside.any() or np.abs(points).max() > 2.0:
            continue
        colour = class_colour(quadric.class_id)
        cv2.polylines(drawn, [np.rint(pixels).astype(np.int32)], True, colour, 2, cv2.LINE_AA)
        draw_label(drawn, f"{quadric.class_id} {quadric.id}", pixels.mean(axis=0), colour)
    return drawn


def boxes_of(run: Path, bag_path: Path) -> Recording:
    """The recording whose boxes are drawn: the run's own, as the run used it, or the bag of the images.

    Raises:
        ReportError, BagError: metrics.json or the recording cannot be read.
    """
    metrics = read_metrics(run / "metrics.json")
    return Recording.open(own_recording(metrics) or bag_path, metrics.get("calibrator"), metrics.get("topics"))


def draw_run(run: Path, recording: Recording, bag_path: Path, out: Path) -> int:
    """Write the images; returns how many.

    Args:
        run: folder with the map.
        recording: of the boxes.
        bag_path: of the images.
        out: folder for the pictures.

    Raises:
        MapFileError, BagError: the run or the bag cannot be read, or has no images.
    """
    known = ObjectMap.load(run / "map.json")
    poses = dict(zip(known.stamps, known.poses, strict=True))
    boxes = {item.stamp: item for item in recording.measurements() if isinstance(item, Boxes)}
    count = 0
    with BagReader(bag_path) as bag:
        topic = next((name for name in (topics.IMAGE, topics.RAW_IMAGE) if name in bag.topics), None)
        if topic is None:
            raise BagError(f"{bag_path} has no images: neither {topics.IMAGE} nor {topics.RAW_IMAGE}")
        out.mkdir(parents=True, exist_ok=True)
        with Progress(len(poses), f"drawing into {out}") as progress:
            for _, _, message in bag.messages([topic]):
                stamp = stamp_from_msg(message.header.stamp)
                if stamp not in poses:
                    continue
                try:
                    rgb = decode_image(message)
                except InvalidMeasurement as error:
                    print(f"left out: {error}", file=sys.stderr)
                    continue
                image = np.ascontiguousarray(rgb[..., ::-1])
                drawn = draw(image, boxes.get(stamp), known, poses[stamp], recording.camera)
                (out / f"{stamp / SECOND:.6f}.jpg").write_bytes(encode_jpeg(drawn, JPEG_QUALITY))
                count += 1
                progress.step()
    return count


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `draw_run`; returns the exit code."""
    parser = ArgumentParser(prog="draw_run", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder that slam_bag wrote")
    parser.add_argument("bag", type=Path, metavar="BAG", help="recording with the images")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the pictures")
    arguments = parser.parse_args(argv)
    try:
        recording = boxes_of(arguments.run, arguments.bag)
        count = draw_run(arguments.run, recording, arguments.bag, arguments.out)
    except (MapFileError, BagError, ReportError, ValueError) as error:
        print(f"draw_run: {error}", file=sys.stderr)
        return 1
    if not count:
        print(f"draw_run: no image of {arguments.bag} was taken at a keyframe of {arguments.run}", file=sys.stderr)
        return 1
    print(f"{count} pictures: {arguments.out}; boxes: {recording.topics['detections']} of {recording.path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
