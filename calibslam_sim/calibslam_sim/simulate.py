"""`simulate`: a recording of a simulated desk, as a bag with ground truth."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_msgs_py import bags
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.conversions import (
    boxes_to_msg,
    camera_to_msg,
    header_to_msg,
    quadrics_to_msg,
    stamped_pose_to_msg,
)
from calibslam_msgs_py.measurements import QuadricEstimate, StampedPose
from calibslam_msgs_py.progress import Progress
from calibslam_msgs_py.settings import add_arguments, from_arguments
from calibslam_sim import topics
from calibslam_sim.rendering.coco_writer import IMAGES, CocoError, CocoWriter
from calibslam_sim.rendering.looks import FAMILIES
from calibslam_sim.rendering.render import RenderedImage, Renderer
from calibslam_sim.simulation.recording import SCENARIOS, Simulation, SimulationSettings, simulate

SCENARIO_HELP = "which defaults the other options have (default: desk); " + "; ".join(
    f"{name}: {', '.join(f'{option} {value:g}' for option, value in changes.items()) or 'as stated here'}"
    for name, changes in SCENARIOS.items()
)


def write_bag(
    simulation: Simulation,
    path: Path,
    overwrite: bool = False,
    render: Callable[[int], RenderedImage] | None = None,
    coco: CocoWriter | None = None,
    image_every: int = 1,
) -> None:
    """Write what was measured and the truth.

    Topics: /odom, /detections, /camera/camera_info and /ground_truth for every image, /ground_truth_quadrics
    once. The identity of a box is the id of the true quadric.

    Args:
        render: makes the image of a time; then there is /camera/image_raw/compressed as well.
        coco: takes these images and their boxes, too.
        image_every: only the first of so many times has an image.
    """
    types = bags.types
    T_odom_camera = [np.eye(4)]
    for motion in simulation.odometry:
        T_odom_camera.append(T_odom_camera[-1] @ motion.T_start_end)
    times = [int(stamp) for stamp in simulation.times]
    poses = [StampedPose(stamp, T) for stamp, T in zip(times, T_odom_camera, strict=True)]
    step_covariance = simulation.odometry[0].covariance if simulation.odometry else None
    quadrics = [
        QuadricEstimate(
            id=thing.id,
            class_id=thing.class_id,
            T_map_object=thing.ellipsoid.T_world_object,
            radii=thing.ellipsoid.radii,
            covariance=np.zeros((9, 9)),
            observations=sum(str(thing.id) in boxes.object_ids for boxes in simulation.boxes),
        )
        for thing in simulation.world
    ]
    with bags.BagWriter(path, overwrite) as bag, Progress(len(times), f"writing {path}") as progress:
        bag.write(topics.GROUND_TRUTH_QUADRICS, quadrics_to_msg(times[0], quadrics, types, topics.WORLD), times[0])
        for k, odometry in enumerate(topics.odometry_msgs(poses, step_covariance, types)):
            stamp = times[k]
            truth = StampedPose(stamp, simulation.T_world_camera[k])
            bag.write(topics.ODOMETRY, odometry, stamp)
            bag.write(topics.CAMERA_INFO, camera_to_msg(simulation.camera, stamp, types), stamp)
            bag.write(topics.GROUND_TRUTH, stamped_pose_to_msg(truth, topics.WORLD, types), stamp)
            bag.write(topics.DETECTIONS, boxes_to_msg(simulation.boxes[k], types), stamp)
            if render is not None and k % image_every == 0:
                image = render(stamp)
                bag.write(topics.IMAGE, _image(stamp, simulation.camera.frame_id, image), stamp)
                if coco is not None:
                    coco.add(image, simulation.world)
            progress.step()


def _image(stamp: int, frame_id: str, image: RenderedImage) -> Any:
    return bags.types("sensor_msgs/msg/CompressedImage")(
        header=header_to_msg(stamp, frame_id, bags.types), format="jpeg", data=bags.types.octets(image.jpeg())
    )


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `simulate`; returns the exit code."""
    # The scenario decides the defaults of the other options.
    first = ArgumentParser(add_help=False)
    first.add_argument("--scenario", choices=sorted(SCENARIOS), default="desk", help=SCENARIO_HELP)
    scenario = first.parse_known_args(argv)[0].scenario
    parser = ArgumentParser(prog="simulate", description=__doc__, parents=[first])
    parser.add_argument("--out", type=Path, required=True, metavar="BAG", help="folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace the bag if it exists")
    parser.add_argument("--images", action="store_true", help="render the images, too (about 0.1 s each)")
    parser.add_argument(
        "--image-every", type=int, default=1, metavar="N", help="render the first of every N images only (default: all)"
    )
    parser.add_argument(
        "--looks", choices=FAMILIES, default=FAMILIES[0], help="of rendered images (default: %(default)s)"
    )
    parser.add_argument(
        "--coco", type=Path, metavar="DIR", help="folder for the rendered images with their boxes as COCO json"
    )
    add_arguments(parser, SimulationSettings)
    parser.set_defaults(**SCENARIOS[scenario])
    arguments = parser.parse_args(argv)
    if arguments.coco is not None and not arguments.images:
        parser.error("--coco needs --images")
    if arguments.coco is not None and arguments.out.resolve() in (arguments.coco / IMAGES).resolve().parents:
        parser.error(f"--coco {arguments.coco} lies in the bag {arguments.out}: choose another folder")
    if arguments.image_every < 1:
        parser.error(f"--image-every must be 1 or more, not {arguments.image_every}")
    settings = from_arguments(arguments, SimulationSettings)
    start = time.monotonic()
    try:
        simulation = simulate(settings)
        render, coco = None, None
        if arguments.images:
            render = Renderer(simulation.world, simulation.camera, settings.seed, settings.pace, arguments.looks).render
        if arguments.coco is not None:
            coco = CocoWriter(arguments.coco, arguments.overwrite)
        try:
            write_bag(simulation, arguments.out, arguments.overwrite, render, coco, arguments.image_every)
        finally:  # images without annotations are worth nothing
            if coco is not None:
                coco.close()
    except (bags.BagError, CocoError) as error:
        print(f"simulate: {error}", file=sys.stderr)
        return 1
    rendered = -(-len(simulation.times) // arguments.image_every)
    pictures = f"{rendered} images" if arguments.images else "without images (--images)"
    print(
        f"{arguments.out}: {len(simulation.times)} frames, {pictures}, {sum(map(len, simulation.boxes))} boxes of "
        f"{len(simulation.world)} objects, scenario {scenario}, seed {settings.seed} "
        f"({time.monotonic() - start:.1f} s)"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
