"""`tum`: the document's Tables 5.2 and 5.3 on a folder of the TUM benchmark, and the same with real odometry.

Families of conditions:
    fixed, quadricslam, calibrated: as in the document, identities given, and each repetition adds its own noise to
        a good trajectory (there ORB-SLAM's) to make odometry of it;
    real_given_...: real visual odometry, identities given;
    real_estimated_...: real visual odometry and nothing else;
    backwards_given_..., backwards_estimated_...: the same, and the recording played from its end. Its boxes and the
        errors of its odometry are the same; what is known when, and so which objects begin and who takes which box,
        is not. What hangs on the order of things shows here.
    few_given_..., few_estimated_...: every third image only, drawn at random, as a detector a third as fast would give.
    sparse_given_..., sparse_estimated_...: a third of the labelled objects, drawn at random, are not there: what hangs
        on single objects, which decide more than single images.
    failing_given_..., failing_estimated_...: the odometry fails about every 15 s besides, for up to a second: it says
        anything, or that nothing moved (`failing_odometry`).
Two more, real_given_underconfident and real_given_scale_4, believe calibrated deviations to be 2 and 4 times as large:
if errors are alike from image to image, what is right for each box is too confident for a row of them.
With real odometry each repetition leaves out another tenth of the images (`few_`: two thirds): their spread tells how
far a result hangs on single images, not how it would be on other recordings. Two repetitions share nine tenths of their
images, and a third where there are few: these are nearer to repetitions that know nothing of each other. Two
`sparse_` ones share two thirds of their objects.
Boxes without labelled identities (of another detector, `detections`) have the `estimated_` conditions only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_backend.association.matching import ESTIMATED, GIVEN
from calibslam_backend.estimator import EstimatorSettings
from calibslam_backend.graph.noise import CALIBRATED as OWN_COVARIANCE
from calibslam_backend.graph.noise import FIXED, QUADRICSLAM
from calibslam_backend.output.metrics import NoGroundTruth, Trajectory
from calibslam_backend.recording import load_calibrator
from calibslam_msgs_py.bags import BagError
from calibslam_msgs_py.measurements import Boxes, Camera, RelativeMotion, StampedPose
from calibslam_msgs_py.settings import setting
from calibslam_sim.experiments.design import (
    CALIBRATED,
    UNDERCONFIDENT,
    DocumentNumbers,
    Experiment,
    ExperimentError,
    ExperimentSettings,
    Metric,
    Metrics,
    Seed,
    scale_name,
)
from calibslam_sim.experiments.figures import condition_figure
from calibslam_sim.experiments.object_slam import HONESTY, accuracy_of_trajectory, estimate
from calibslam_sim.simulation.failing_odometry import OdometryFailures
from calibslam_sim.simulation.odometry_noise import OdometryNoise
from calibslam_sim.tum_folder import TumError, read_camera, read_detections, read_trajectory

MODELS = (CALIBRATED, FIXED, QUADRICSLAM)
INFLATED = (UNDERCONFIDENT, scale_name(4.0))
# Condition without its prefix -> noise model of the back end, and factor on its standard deviations.
NOISE = {
    CALIBRATED: (OWN_COVARIANCE, 1.0),
    FIXED: (FIXED, 1.0),
    QUADRICSLAM: (QUADRICSLAM, 1.0),
    UNDERCONFIDENT: (OWN_COVARIANCE, 2.0),
    scale_name(4.0): (OWN_COVARIANCE, 4.0),
}
REAL_GIVEN, BACKWARDS, FEW, SPARSE, FAILING = "real_given_", "backwards_", "few_", "sparse_", "failing_"
# Prefix of a condition -> association.
REAL = {
    REAL_GIVEN: GIVEN,
    "real_estimated_": ESTIMATED,
    BACKWARDS + "given_": GIVEN,
    BACKWARDS + "estimated_": ESTIMATED,
    FEW + "given_": GIVEN,
    FEW + "estimated_": ESTIMATED,
    SPARSE + "given_": GIVEN,
    SPARSE + "estimated_": ESTIMATED,
    FAILING + "given_": GIVEN,
    FAILING + "estimated_": ESTIMATED,
}
GROUND_TRUTH, ODOMETRY, DETECTIONS, CAMERA_INFO = (
    "groundtruth.txt",
    "odometry.txt",
    "detections.csv",
    "camera_info.yaml",
)


@dataclass(frozen=True)
class TumSettings(ExperimentSettings):
    """The recording, and how its odometry is made."""

    folder: str = setting("", "recording: groundtruth.txt, odometry.txt, detections.csv, camera_info.yaml")
    detections: str = setting(DETECTIONS, "file in the folder with the boxes")
    calibrator: str = setting("", "file with a calibrator that was fitted on other recordings; empty: the default one")
    good_trajectory: str = setting("reference_orbslam.txt", "file in the folder of which noisy odometry is made")
    rotation_noise: float = setting(0.5, "added to each step of it, about each axis", unit="deg", low=1e-4)
    translation_noise: float = setting(0.01, "added to each step of it, along each axis", unit="m", low=1e-6)
    left_out: float = setting(0.1, "share of images left out where odometry is real", low=0.01, high=0.9)
    left_out_of_few: float = setting(2.0 / 3.0, "the same in `few_` conditions", low=0.01, high=0.9)
    left_out_objects: float = setting(1.0 / 3.0, "share of objects left out in `sparse_` conditions", low=0.0, high=0.9)
    most_images: int = setting(1_000_000, "of the recording, from its beginning", low=10)


@dataclass(frozen=True)
class TumRecording:
    """What a folder holds: the boxes have covariances, the motions have none."""

    camera: Camera
    truth: Trajectory
    odometry: list[RelativeMotion]
    good: list[RelativeMotion]
    images: list[Boxes]

    @cached_property
    def backwards(self) -> TumRecording:
        """Played from the end: its last image is the first, at the time that the first one had."""
        ends = self.images[0].stamp + self.images[-1].stamp

        def undone(motions: list[RelativeMotion]) -> list[RelativeMotion]:
            return [
                RelativeMotion(ends - motion.end, ends - motion.start, np.linalg.inv(motion.T_start_end).astype(float))
                for motion in reversed(motions)
            ]

        return TumRecording(
            self.camera,
            Trajectory(ends - self.truth.stamps[::-1], self.truth.poses[::-1]),
            undone(self.odometry),
            undone(self.good),
            [replace(boxes, stamp=ends - boxes.stamp) for boxes in reversed(self.images)],
        )


def run(settings: TumSettings, condition: str, seed: Seed) -> Metrics:
    """One condition on one seed."""
    recording = recorded(settings)
    rng = np.random.default_rng(seed)
    family = next((prefix for prefix in REAL if condition.startswith(prefix)), "")
    model, scale = NOISE[condition.removeprefix(family)]
    if family.startswith(BACKWARDS):
        recording = recording.backwards
    motions, images = recording.odometry, recording.images
    if family:
        kept = rng.random(len(images)) >= left_out(settings, condition)
        images = [boxes for boxes, keep in zip(images, kept, strict=True) if keep]
        if family.startswith(SPARSE):
            images = sparse(images, settings.left_out_objects, rng)
        if family.startswith(FAILING):
            motions = OdometryFailures().spoil(motions, rng)
    else:
        noise = OdometryNoise(np.radians(settings.rotation_noise), settings.translation_noise)
        motions = [
            RelativeMotion(step.start, step.end, noise.perturb(step.T_start_end, rng), noise.covariance)
            for step in recording.good
        ]
    back_end = EstimatorSettings(noise_model=model, covariance_scale=scale, association=REAL.get(family, GIVEN))
    result = estimate(recording.camera, motions, images, back_end)
    try:
        return accuracy_of_trajectory(result, recording.truth)
    except NoGroundTruth as error:
        raise ExperimentError(f"{settings.folder}: {error}") from error


def sparse(images: list[Boxes], left_out: float, rng: np.random.Generator) -> list[Boxes]:
    """The images without the boxes of a share of the labelled objects; boxes without label stay."""
    names = sorted({name for boxes in images for name in boxes.object_ids if name})
    gone = {name for name in names if rng.random() < left_out}
    return [
        boxes.select(np.array([i for i, name in enumerate(boxes.object_ids) if name not in gone], dtype=int))
        for boxes in images
    ]


@lru_cache(maxsize=1)
def recorded(settings: TumSettings) -> TumRecording:
    """The recording in a folder; kept for the other conditions.

    Raises:
        ExperimentError: a file is missing or cannot be read.
    """
    folder = Path(settings.folder)
    if not settings.folder or not folder.is_dir():
        raise ExperimentError(f"--folder {settings.folder or '(not given)'}: must be a folder in TUM format")
    try:
        camera = read_camera(folder / CAMERA_INFO)
        truth = read_trajectory(folder / GROUND_TRUTH)
        calibrate = load_calibrator(settings.calibrator or None)
        images = read_detections(folder / settings.detections, camera)[: settings.most_images]
        return TumRecording(
            camera,
            Trajectory.of(truth),
            steps(read_trajectory(folder / ODOMETRY)),
            steps(read_trajectory(folder / settings.good_trajectory)),
            [calibrate(boxes) for boxes in images],
        )
    except (TumError, BagError, ValueError, OSError) as error:
        raise ExperimentError(str(error)) from error


def steps(poses: list[StampedPose]) -> list[RelativeMotion]:
    """Motions between neighbouring poses, of unknown covariance."""
    return [
        RelativeMotion(before.stamp, after.stamp, np.linalg.inv(before.T) @ after.T)
        for before, after in pairwise(poses)
    ]


def conditions(settings: TumSettings) -> list[str]:
    """Every noise model in every family that these boxes allow, and inflated ones in one.

    Raises:
        ExperimentError: the folder cannot be used.
    """
    return [prefix + model for prefix in _families(settings) for model in _models(prefix)]


def left_out(settings: TumSettings, condition: str) -> float:
    """Share of the images. What else differs between repetitions, which objects are missing or where odometry fails, is
    not shared, so where something does the deviation of their mean is an upper bound."""
    if not condition.startswith(tuple(REAL)):
        return 0.0
    return settings.left_out_of_few if condition.startswith(FEW) else settings.left_out


def inputs(settings: TumSettings) -> dict[str, Path]:
    """The files of the recording, and the calibrator's."""
    names = (GROUND_TRUTH, ODOMETRY, settings.detections, CAMERA_INFO, settings.good_trajectory)
    found = {name: Path(settings.folder) / name for name in names}
    return {**found, "calibrator": Path(settings.calibrator)} if settings.calibrator else found


def comparisons(settings: TumSettings) -> list[tuple[str, str]]:
    """Calibrated against all others of its family."""
    return [
        (prefix + CALIBRATED, prefix + model)
        for prefix in _families(settings)
        for model in _models(prefix)
        if model != CALIBRATED
    ]


def _families(settings: TumSettings) -> list[str]:
    """Prefixes of conditions. Without labels there is no identity to give and no object to leave out."""
    is_labelled = any(name for boxes in recorded(settings).images for name in boxes.object_ids)
    return [
        prefix
        for prefix in ("", *REAL)
        if is_labelled or (REAL.get(prefix, GIVEN) == ESTIMATED and not prefix.startswith(SPARSE))
    ]


def _models(prefix: str) -> tuple[str, ...]:
    return MODELS + (INFLATED if prefix == REAL_GIVEN else ())


def document(settings: dict[str, Any]) -> DocumentNumbers:
    """Table 5.2 or 5.3, where the folder is of that recording."""
    name = Path(settings["folder"]).name.replace("freiburg", "fr")
    for (camera, scene), found in TABLES.items():
        if camera in name and scene in name:
            return found
    return {}


def figure(result: dict[str, Any], path: Path) -> None:
    """Every metric in every condition."""
    condition_figure(path, EXPERIMENT.title, result, METRICS, list(result["conditions"]))


# Words in the name of the folder -> the document's Tables 5.2 and 5.3.
TABLES: dict[tuple[str, str], DocumentNumbers] = {
    ("fr3", "office"): {
        CALIBRATED: {"ate_m": (0.377, 0.081), "rpe_m": (0.033, None)},
        FIXED: {"ate_m": (0.429, 0.117), "rpe_m": (0.027, 0.0033)},
        QUADRICSLAM: {"ate_m": (0.484, 0.197), "rpe_m": (0.018, 0.0006)},
    },
    ("fr2", "desk"): {
        CALIBRATED: {"ate_m": (1.394, 0.117), "rpe_m": (0.053, 0.010)},
        FIXED: {"ate_m": (1.461, 0.071), "rpe_m": (0.042, 0.005)},
        QUADRICSLAM: {"ate_m": (1.407, 0.160), "rpe_m": (0.033, 0.0005)},
    },
}

METRICS = {
    "ate_m": Metric("ATE", "m"),
    "rpe_m": Metric("RPE", "m"),
    **HONESTY,
}

EXPERIMENT = Experiment(
    title="Object SLAM on a TUM recording under noise models of boxes (Tables 5.2, 5.3)",
    settings=TumSettings,
    quick={"most_images": 150},
    seeds=10,
    quick_seeds=2,
    metrics=METRICS,
    conditions=conditions,
    run=run,
    comparisons=comparisons,
    left_out=left_out,
    figure=figure,
    inputs=inputs,
    document=document,
)
