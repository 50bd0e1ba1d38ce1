"""`quadric_sim`: the document's Tables 5.2 and 5.3 in simulated worlds, where the truth is exact.

A camera is walked around a desk; the back end is told of each box what a noise model says: a constant (fixed),
the spread of the object's box sizes (quadricslam), or the box's true covariance (calibrated), also times 4 and
divided by 4 (deviations times 2, under- and overconfident). The same again with gross errors among the boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_backend.association.matching import ESTIMATED, GIVEN
from calibslam_backend.estimator import EstimatorSettings
from calibslam_backend.graph.noise import CALIBRATED as OWN_COVARIANCE
from calibslam_backend.graph.noise import FIXED, QUADRICSLAM
from calibslam_backend.output.metrics import Trajectory, alignment
from calibslam_msgs_py.settings import setting
from calibslam_sim.accuracy.objects import MapObject, map_objects, object_accuracy
from calibslam_sim.experiments.design import (
    CALIBRATED,
    OVERCONFIDENT,
    UNDERCONFIDENT,
    Experiment,
    ExperimentSettings,
    Metric,
    Metrics,
    Seed,
)
from calibslam_sim.experiments.figures import condition_figure
from calibslam_sim.experiments.object_slam import HONESTY, Estimate, accuracy_of_trajectory, estimate
from calibslam_sim.simulation.recording import Simulation, SimulationSettings, simulate

OUTLIERS = "outliers_"  # conditions in which some boxes are grossly wrong
# Condition -> noise model of the back end, and factor on its standard deviations.
NOISE = {
    CALIBRATED: (OWN_COVARIANCE, 1.0),
    UNDERCONFIDENT: (OWN_COVARIANCE, 2.0),
    OVERCONFIDENT: (OWN_COVARIANCE, 0.5),
    FIXED: (FIXED, 1.0),
    QUADRICSLAM: (QUADRICSLAM, 1.0),
}


@dataclass(frozen=True)
class QuadricSimSettings(ExperimentSettings):
    """The recordings, and what the back end is told."""

    duration: float = setting(60.0, "length of a recording", unit="s", low=1.0)
    frame_rate: float = setting(30.0, "images per second", unit="Hz", low=1.0)
    pace: float = setting(1.0, "speed of the camera; 1: as TUM fr3_office, 2: as fr1_desk", low=0.01)
    outliers: float = setting(0.05, "share of grossly wrong boxes, in the conditions with outliers", low=0.0, high=1.0)
    association: str = setting(GIVEN, "which box is of which object", choices=(GIVEN, ESTIMATED))


def run(settings: QuadricSimSettings, condition: str, seed: Seed) -> Metrics:
    """One condition on one seed."""
    outliers = settings.outliers if condition.startswith(OUTLIERS) else 0.0
    model, scale = NOISE[condition.removeprefix(OUTLIERS)]
    recording = recorded(
        SimulationSettings(
            seed=int(seed.generate_state(1)[0]),
            duration=settings.duration,
            frame_rate=settings.frame_rate,
            pace=settings.pace,
            outliers=outliers,
        )
    )
    back_end = EstimatorSettings(noise_model=model, covariance_scale=scale, association=settings.association)
    return accuracy(estimate(recording.camera, recording.odometry, recording.boxes, back_end), recording)


@lru_cache(maxsize=2)
def recorded(settings: SimulationSettings) -> Simulation:
    """The recording; kept for the other conditions."""
    return simulate(settings)


def accuracy(result: Estimate, recording: Simulation) -> Metrics:
    """Metrics of an estimate against the truth."""
    truth = Trajectory(recording.times, recording.T_world_camera)
    T_world_map = alignment(Trajectory(np.array(result.map.stamps), result.map.poses), truth)
    objects = object_accuracy(
        map_objects(result.map.quadrics, T_world_map),
        [MapObject(thing.class_id, thing.ellipsoid) for thing in recording.world],
    )
    return {
        **accuracy_of_trajectory(result, truth),
        "centre_m": objects.centre_m,
        "iou_error": 1.0 - objects.iou,
        "missed": float(objects.true - objects.matched),
        "spurious": float(objects.estimated - objects.matched),
    }


def conditions(settings: QuadricSimSettings) -> list[str]:
    """Every noise model without, then with gross errors."""
    return [prefix + name for prefix in ("", OUTLIERS) for name in NOISE]


def comparisons(settings: QuadricSimSettings) -> list[tuple[str, str]]:
    """The truth against all others."""
    return [(prefix + CALIBRATED, prefix + name) for prefix in ("", OUTLIERS) for name in NOISE if name != CALIBRATED]


def figure(result: dict[str, Any], path: Path) -> None:
    """Every metric in every condition."""
    condition_figure(path, EXPERIMENT.title, result, METRICS, list(result["conditions"]))


METRICS = {
    "ate_m": Metric("ATE", "m"),
    "rpe_m": Metric("RPE", "m"),
    "centre_m": Metric("centres of objects", "m"),
    "iou_error": Metric("1 - IoU in 3-D"),
    "missed": Metric("missed objects"),
    "spurious": Metric("objects that are none"),
    **HONESTY,
}

EXPERIMENT = Experiment(
    title="Object SLAM of simulated desks under noise models of boxes (Tables 5.2, 5.3)",
    settings=QuadricSimSettings,
    quick={"duration": 8.0},
    seeds=30,
    quick_seeds=2,
    metrics=METRICS,
    conditions=conditions,
    run=run,
    comparisons=comparisons,
    figure=figure,
)
