"""`export_rerun RUN [--bag BAG] --out FILE.rrd`: a run for the Rerun viewer; with BAG also its images.

Rerun is no part of the installation: it is asked for where it is missing.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calibslam_backend.output.object_map import MapFileError, ObjectMap
from calibslam_backend.recording import CAMERA
from calibslam_detector.images.image_conversion import decode_image
from calibslam_detector.images.overlay import class_colour
from calibslam_msgs_py.bags import BagError, BagReader
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.conversions import camera_from_msg, stamp_from_msg
from calibslam_msgs_py.geometry_conversions import quaternion_from_rotation
from calibslam_msgs_py.measurements import SECOND, InvalidMeasurement
from calibslam_sim import topics

INSTALL = "rerun is not installed: .venv/bin/python -m pip install 'rerun-sdk>=0.23'"


class NoRerunError(RuntimeError):
    """Rerun is missing."""


def load_rerun() -> Any:
    """The module `rerun`.

    Raises:
        NoRerunError: with the command that installs it.
    """
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise NoRerunError(INSTALL) from None


def export(rerun: Any, run: Path, bag_path: Path | None, out: Path) -> None:
    """Write a recording of the Rerun viewer.

    Raises:
        MapFileError, BagError: the run or the bag cannot be read.
    """
    known = ObjectMap.load(run / "map.json")
    rerun.init("calibslam", recording_id=run.resolve().name)
    rerun.save(str(out))
    rerun.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    rerun.log("map/trajectory", rerun.LineStrips3D([known.poses[:, :3, 3]]), static=True)
    for quadric in known.quadrics:
        blue, green, red = class_colour(quadric.class_id)
        ellipsoid = rerun.Ellipsoids3D(
            centers=[quadric.T_map_object[:3, 3]],
            half_sizes=[quadric.radii],
            quaternions=[quaternion_from_rotation(quadric.T_map_object[:3, :3])],
            colors=[(red, green, blue)],
            labels=[f"{quadric.class_id} {quadric.id}"],
        )
        rerun.log(f"map/objects/{quadric.id}", ellipsoid, static=True)
    for stamp, T in zip(known.stamps, known.poses, strict=True):
        rerun.set_time("time", timestamp=stamp / SECOND)
        rerun.log("map/camera", rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    if bag_path is not None:
        _log_images(rerun, bag_path)


def _log_images(rerun: Any, path: Path) -> None:
    with BagReader(path) as bag:
        wanted = [name for name in (CAMERA, topics.IMAGE, topics.RAW_IMAGE) if name in bag.topics]
        for topic, _, message in bag.messages(wanted):
            rerun.set_time("time", timestamp=stamp_from_msg(message.header.stamp) / SECOND)
            try:
                if topic == CAMERA:
                    camera = camera_from_msg(message)
                    pinhole = rerun.Pinhole(image_from_camera=camera.K, resolution=[camera.width, camera.height])
                    rerun.log("map/camera", pinhole)
                else:
                    rerun.log("map/camera/image", rerun.Image(decode_image(message)).compress())
            except InvalidMeasurement as error:
                print(f"left out: {error}", file=sys.stderr)


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `export_rerun`; returns the exit code."""
    parser = ArgumentParser(
        prog="export_rerun", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder that slam_bag wrote")
    parser.add_argument("--bag", type=Path, metavar="BAG", help="its recording, for the images")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.rrd", help="file to write")
    arguments = parser.parse_args(argv)
    try:
        export(load_rerun(), arguments.run, arguments.bag, arguments.out)
    except (MapFileError, BagError, NoRerunError) as error:
        print(f"export_rerun: {error}", file=sys.stderr)
        return 1
    print(f"result: {arguments.out}; look at it with: rerun {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
