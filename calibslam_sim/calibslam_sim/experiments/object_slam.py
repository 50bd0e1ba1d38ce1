"""The back end on measurements in memory, and how good what comes out is."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.output.metrics import Trajectory, ate, position_nees, rpe
from calibslam_backend.output.object_map import ObjectMap
from calibslam_msgs_py.measurements import Boxes, Camera, RelativeMotion
from calibslam_sim.experiments.design import Metrics


def estimate(
    camera: Camera, motions: Iterable[RelativeMotion], images: Iterable[Boxes], settings: EstimatorSettings
) -> ObjectMap:
    """What the back end makes of motions of the camera and of boxes."""
    estimator = Estimator(camera, np.eye(4), settings)
    measurements: list[Boxes | RelativeMotion] = [*motions, *images]
    for measurement in sorted(measurements, key=_end):
        estimator.add(measurement)
    estimator.finish()
    return estimator.object_map()


def _end(measurement: Boxes | RelativeMotion) -> int:
    return measurement.stamp if isinstance(measurement, Boxes) else measurement.end


def accuracy_of_trajectory(result: ObjectMap, truth: Trajectory) -> Metrics:
    """ATE, RPE and NEES as in metrics.json."""
    estimated = Trajectory(np.array(result.stamps), result.poses)
    nees = position_nees(estimated, result.covariances, truth)
    return {
        "ate_m": ate(estimated, truth),
        "rpe_m": rpe(estimated, truth),
        "nees_position": float("nan") if nees is None else nees,
    }
