"""`image`: the whole pipeline from images (the document's Figs. 1.1 and 5.2), with covariances of different origin.

A desk is rendered, a detector finds its boxes, the back end makes a map of them and decides itself which box is of
which object. Conditions see the same boxes and differ in what is believed of them: what a covariance head says that was
trained by f-Cal (calibrated) or by the negative log-likelihood (nll), a constant (fixed), or the spread of an object's
box sizes (quadricslam). Worlds are others than those that detectors are trained on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_backend.association.matching import ESTIMATED
from calibslam_backend.estimator import EstimatorSettings
from calibslam_backend.graph.noise import CALIBRATED as OWN_COVARIANCE
from calibslam_backend.graph.noise import FIXED, QUADRICSLAM
from calibslam_detector.images.image_conversion import decode_compressed
from calibslam_detector.model.weights_file import SHIPPED, SHIPPED_NLL_HEAD
from calibslam_msgs_py.conversions import valid_boxes
from calibslam_msgs_py.measurements import Boxes
from calibslam_msgs_py.settings import setting
from calibslam_sim.experiments.covariance_heads import CovarianceHeads
from calibslam_sim.experiments.design import (
    CALIBRATED,
    Experiment,
    ExperimentSettings,
    Metrics,
    Seed,
)
from calibslam_sim.experiments.figures import condition_figure
from calibslam_sim.experiments.object_slam import estimate
from calibslam_sim.experiments.quadric_sim import METRICS, accuracy
from calibslam_sim.rendering.looks import FAMILIES
from calibslam_sim.rendering.render import Renderer
from calibslam_sim.simulation.recording import Simulation, SimulationSettings, simulate

NLL = "nll"
# Condition -> covariance head whose boxes are taken, and noise model of the back end.
NOISE = {
    CALIBRATED: (CALIBRATED, OWN_COVARIANCE),
    NLL: (NLL, OWN_COVARIANCE),
    FIXED: (CALIBRATED, FIXED),
    QUADRICSLAM: (CALIBRATED, QUADRICSLAM),
}


@dataclass(frozen=True)
class ImageSettings(ExperimentSettings):
    """The recordings, and the detectors."""

    weights: str = setting("", "file of the detector with covariances trained by f-Cal; empty: the shipped one")
    nll_weights: str = setting(
        "", "file of the same detector with covariances trained by NLL; empty: the shipped one's, or left out"
    )
    duration: float = setting(20.0, "length of a recording", unit="s", low=1.0)
    frame_rate: float = setting(30.0, "odometry steps per second", unit="Hz", low=1.0)
    image_every: int = setting(5, "of so many odometry steps one has an image", low=1)
    pace: float = setting(1.0, "speed of the camera; 1: as TUM fr3_office, 2: as fr1_desk", low=0.01)
    looks: str = setting(FAMILIES[0], "of rendered images; detectors know the first", choices=FAMILIES)


@dataclass(frozen=True)
class Detected:
    """A recording, and the boxes found in its images by the name of the covariance head."""

    recording: Simulation
    boxes: dict[str, list[Boxes]]


def run(settings: ImageSettings, condition: str, seed: Seed) -> Metrics:
    """One condition on one seed."""
    head, model = NOISE[condition]
    found = detected(settings, int(seed.generate_state(1)[0]))
    back_end = EstimatorSettings(noise_model=model, association=ESTIMATED)
    recording = found.recording
    return accuracy(estimate(recording.camera, recording.odometry, found.boxes[head], back_end), recording)


@lru_cache(maxsize=1)
def detected(settings: ImageSettings, seed: int) -> Detected:
    """The recording of a seed; kept for the other conditions."""
    detect = heads(settings.weights, settings.nll_weights)
    recording = simulate(
        SimulationSettings(seed=seed, duration=settings.duration, frame_rate=settings.frame_rate, pace=settings.pace)
    )
    render = Renderer(recording.world, recording.camera, seed, settings.pace, settings.looks).render
    found: dict[str, list[Boxes]] = {}
    for time in recording.times[:: settings.image_every].tolist():
        # As from a bag: through JPEG.
        image = decode_compressed(np.frombuffer(render(time).jpeg(), np.uint8))
        for name, boxes in detect(image, time).items():
            found.setdefault(name, []).append(valid_boxes(boxes)[0])
    return Detected(recording, found)


@lru_cache(maxsize=1)
def heads(weights: str, nll_weights: str) -> CovarianceHeads:
    """The detectors of these files.

    Raises:
        ExperimentError: they cannot be used.
    """
    return CovarianceHeads(files(weights, nll_weights))


def files(weights: str, nll_weights: str) -> dict[str, Path]:
    """Covariance head -> its file. The shipped detector has one of each kind."""
    found = {CALIBRATED: Path(weights) if weights else SHIPPED}
    if nll_weights or not weights:
        found[NLL] = Path(nll_weights) if nll_weights else SHIPPED_NLL_HEAD
    return found


def conditions(settings: ImageSettings) -> list[str]:
    """Those that the given detectors allow.

    Raises:
        ExperimentError: the detectors cannot be used.
    """
    heads(settings.weights, settings.nll_weights)  # before any process is started
    there = files(settings.weights, settings.nll_weights)
    return [name for name, (head, _) in NOISE.items() if head in there]


def inputs(settings: ImageSettings) -> dict[str, Path]:
    """The detectors' files, also those that are shipped."""
    there = files(settings.weights, settings.nll_weights)
    return {f"weights of {head}": path for head, path in there.items()}


def comparisons(settings: ImageSettings) -> list[tuple[str, str]]:
    """f-Cal against all others."""
    return [(CALIBRATED, name) for name in conditions(settings) if name != CALIBRATED]


def figure(result: dict[str, Any], path: Path) -> None:
    """Every metric in every condition."""
    condition_figure(path, EXPERIMENT.title, result, METRICS, list(result["conditions"]))


EXPERIMENT = Experiment(
    title="Object SLAM from images, with covariances of boxes from different sources (Figs. 1.1, 5.2)",
    settings=ImageSettings,
    quick={"duration": 3.0, "image_every": 10},
    seeds=20,
    quick_seeds=2,
    metrics=METRICS,
    conditions=conditions,
    run=run,
    comparisons=comparisons,
    figure=figure,
    inputs=inputs,
    is_shared=True,
)
