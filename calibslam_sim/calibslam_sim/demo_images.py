"""The part of the demo that begins with images: rendered ones become boxes, and a picture for a person to look at."""

from __future__ import annotations

from pathlib import Path

import cv2

from calibslam_detector.detect_bag import DetectBagSettings, detect_bag
from calibslam_detector.images.image_conversion import decode_image
from calibslam_detector.images.overlay import draw_overlay
from calibslam_detector.model.detector import Detector, DetectorSettings
from calibslam_detector.model.weights_file import SHIPPED
from calibslam_msgs_py.bags import BagReader
from calibslam_msgs_py.conversions import boxes_from_msg, stamp_from_msg
from calibslam_sim import topics
from calibslam_sim.rendering.looks import FAMILIES
from calibslam_sim.rendering.render import Renderer
from calibslam_sim.simulate import write_bag
from calibslam_sim.simulation.recording import SimulationSettings, simulate

DETECTED = "/detections_from_images"
IMAGE_EVERY = 6  # of the simulated times: at 30 Hz five images per second, several for each keyframe


def record(settings: SimulationSettings, bag: Path) -> None:
    """Simulate a recording with simulated boxes and rendered images."""
    simulation = simulate(settings)
    renderer = Renderer(simulation.world, simulation.camera, settings.seed, settings.pace, FAMILIES[0])
    write_bag(simulation, bag, overwrite=True, render=renderer.render, image_every=IMAGE_EVERY)


def detect(bag: Path, out: Path) -> int:
    """Write `out`: `bag` with the boxes that the shipped detector finds in its images; returns how many these are.

    Raises:
        WeightsError: the shipped weights cannot be used.
    """
    # One thread: several get in each other's way where the machine has something else to do.
    detector = Detector.from_file(SHIPPED, DetectorSettings(threads=1))
    return detect_bag(bag, out, detector, DetectBagSettings(topic=DETECTED), overwrite=True).boxes


def write_overlay(bag: Path, detected: Path, file: Path) -> None:
    """Draw what the detector found in the image with the most boxes."""
    with BagReader(detected) as reader:
        found = [boxes_from_msg(message) for _, _, message in reader.messages([DETECTED])]
    best = max(found, key=len)
    with BagReader(bag) as reader:
        for _, _, message in reader.messages([topics.IMAGE]):
            if stamp_from_msg(message.header.stamp) == best.stamp:
                image = decode_image(message)
                cv2.imwrite(str(file), draw_overlay(image[..., ::-1], best))
                return
