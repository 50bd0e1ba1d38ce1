"""The back end on measurements in memory, and how good what comes out is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.output.metrics import Trajectory, ate, motion_nees, position_nees, rpe
from calibslam_backend.output.object_map import MotionCovariances, ObjectMap
from calibslam_msgs_py.measurements import Boxes, Camera, RelativeMotion
from calibslam_sim.experiments.design import Metric, Metrics

SPANS = (1, 10, 30)  # keyframes; motions over so many are looked at
HONESTY = {
    "nees_position": Metric("NEES of a position (3 is honest)", is_error=False),
    **{f"nees_motion_{n}": Metric(f"NEES of motions over {n} keyframe{'s' * (n > 1)}", is_error=False) for n in SPANS},
}


@dataclass(frozen=True)
class Estimate:
    """What the back end has made of measurements, and what it says of motions between keyframes."""

    map: ObjectMap
    motions: MotionCovariances


def estimate(
    camera: Camera, motions: Iterable[RelativeMotion], images: Iterable[Boxes], settings: EstimatorSettings
) -> Estimate:
    """What the back end makes of motions of the camera and of boxes."""
    estimator = Estimator(camera, np.eye(4), settings)
    measurements: list[Boxes | RelativeMotion] = [*motions, *images]
    for measurement in sorted(measurements, key=_end):
        estimator.add(measurement)
    estimator.finish()
    return Estimate(estimator.object_map(), estimator.motion_covariances())


def _end(measurement: Boxes | RelativeMotion) -> int:
    return measurement.stamp if isinstance(measurement, Boxes) else measurement.end


def accuracy_of_trajectory(result: Estimate, truth: Trajectory) -> Metrics:
    """ATE, RPE and NEES as in metrics.json."""
    estimated = Trajectory(np.array(result.map.stamps), result.map.poses)
    nees = position_nees(estimated, result.map.covariances, truth)
    of_motions = motion_nees(estimated, result.motions, truth)
    return {
        "ate_m": ate(estimated, truth),
        "rpe_m": rpe(estimated, truth),
        "nees_position": float("nan") if nees is None else nees,
        **{f"nees_motion_{n}": of_motions.get(n, float("nan")) for n in SPANS},
    }
