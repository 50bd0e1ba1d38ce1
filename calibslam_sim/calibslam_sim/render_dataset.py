"""`render_dataset`: images of many simulated desks with exact boxes, for training and testing a detector.

Every world has its own seed, layout, textures, light and camera; its images are spread over one walk around it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibslam_msgs_py.command import INTERRUPTED, ArgumentParser, command
from calibslam_msgs_py.measurements import SECOND
from calibslam_msgs_py.progress import Progress
from calibslam_msgs_py.settings import Settings, add_arguments, from_arguments, setting
from calibslam_sim.rendering.coco_writer import CocoError, CocoWriter
from calibslam_sim.rendering.looks import FAMILIES
from calibslam_sim.rendering.render import Renderer
from calibslam_sim.simulation.camera_path import LAP, START
from calibslam_sim.simulation.random_streams import stream
from calibslam_sim.simulation.recording import CAMERA
from calibslam_sim.simulation.world import desk_world

PACES = (0.3, 2.5)  # between a slow and a hasty walk


@dataclass(frozen=True)
class DatasetSettings(Settings):
    """What is rendered."""

    worlds: int = setting(100, "number of desks", low=1)
    images_per_world: int = setting(20, "images of each", low=1)
    first_seed: int = setting(1000, "seed of the first desk; the others follow", low=0)
    looks: str = setting(FAMILIES[0], "family of appearances", choices=FAMILIES)


def render_dataset(settings: DatasetSettings, writer: CocoWriter) -> None:
    """Render all images into a data set."""
    total = settings.worlds * settings.images_per_world
    with Progress(total, f"rendering {total} images") as progress:
        for seed in range(settings.first_seed, settings.first_seed + settings.worlds):
            world = desk_world(seed)
            rng = stream(seed, "data set")
            pace = float(rng.uniform(*PACES))
            renderer = Renderer(world, CAMERA, seed, pace, settings.looks)
            seconds = (np.arange(settings.images_per_world) + rng.random()) / settings.images_per_world * LAP / pace
            for time in START + np.round(seconds * SECOND).astype(np.int64):
                writer.add(renderer.render(int(time)), world)
                progress.step()


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `render_dataset`; returns the exit code."""
    parser = ArgumentParser(prog="render_dataset", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace a data set that is there")
    add_arguments(parser, DatasetSettings)
    arguments = parser.parse_args(argv)
    settings = from_arguments(arguments, DatasetSettings)
    try:
        writer = CocoWriter(arguments.out, arguments.overwrite)
    except CocoError as error:
        print(f"render_dataset: {error}", file=sys.stderr)
        return 1
    try:
        render_dataset(settings, writer)
    except KeyboardInterrupt:
        print("render_dataset: interrupted; the images that there are have their annotations", file=sys.stderr)
        return INTERRUPTED
    finally:  # images without annotations are worth nothing
        images = writer.close()
    print(f"{arguments.out}: {images} images")
    return 0


if __name__ == "__main__":
    sys.exit(main())
