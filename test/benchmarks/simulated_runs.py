"""The back end on simulated desks, where the truth is exact: how honest its covariances are, and how accurate it is.

Used by the benchmark and, with fewer or shorter runs, by the tests.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.graph.object_graph import T_MAP_FIRST_CAMERA
from calibslam_backend.keyframe import Keyframe
from calibslam_backend.output.metrics import Trajectory, ate, motion_nees
from calibslam_msgs_py.measurements import Array, Boxes, RelativeMotion
from calibslam_sim.simulation.recording import Simulation


@dataclass(frozen=True)
class Run:
    """An estimator that has seen a recording, and what each keyframe brought."""

    recording: Simulation
    estimator: Estimator
    keyframes: list[Keyframe]

    def ate(self) -> float:
        """[m], final."""
        return ate(*self._trajectories())

    def motion_nees(self) -> dict[int, float]:
        """Mean NEES of motions by how many keyframes they span; 3 is honest."""
        estimated, truth = self._trajectories()
        return motion_nees(estimated, self.estimator.motion_covariances(), truth)

    def _trajectories(self) -> tuple[Trajectory, Trajectory]:
        estimated = Trajectory(np.array(self.estimator.stamps), self.estimator.trajectory())
        return estimated, Trajectory(self.recording.times, self.recording.T_world_camera)


def measurements(recording: Simulation) -> Iterator[Boxes | RelativeMotion]:
    """In the order of their times."""
    for k, boxes in enumerate(recording.boxes):
        if k:
            yield recording.odometry[k - 1]
        yield boxes


def run(recording: Simulation, settings: EstimatorSettings, at_most: float = np.inf) -> Run:
    """The estimator on a recording, to its end or to so many keyframes."""
    estimator = Estimator(recording.camera, np.eye(4), settings)
    keyframes: list[Keyframe] = []
    for measurement in measurements(recording):
        keyframes += estimator.add(measurement)
        if len(keyframes) >= at_most:
            break
    estimator.finish()
    return Run(recording, estimator, keyframes)


def T_map_world(done: Run) -> Array:
    """(4, 4); the map begins at the camera of the first keyframe, whose true pose is known."""
    first = int(np.searchsorted(done.recording.times, done.estimator.stamps[0]))
    return np.asarray(T_MAP_FIRST_CAMERA @ np.linalg.inv(done.recording.T_world_camera[first]))


def position_nees_at_the_end(done: Run) -> float:
    """Squared Mahalanobis distance of the last keyframe's position to the truth: chi-squared, 3 degrees of freedom.

    One pose for each run: the errors of the poses of a run hang together, those of runs do not.
    """
    k = len(done.estimator.stamps) - 1
    at = int(np.searchsorted(done.recording.times, done.estimator.stamps[k]))
    true = T_map_world(done) @ done.recording.T_world_camera[at]
    pose = done.estimator.pose(k)
    error = pose[:3, :3].T @ (pose[:3, 3] - true[:3, 3])  # in the body, as the covariance is
    return float(error @ np.linalg.solve(done.estimator.pose_covariance(k)[3:, 3:], error))


def quadric_nees(done: Run) -> list[float]:
    """For each quadric the squared Mahalanobis distance of its vector (t, L) to the truth: chi-squared, 9 degrees.

    A quadric is of the object most of its boxes are of.
    """
    boxes: dict[int, Counter[str]] = {}
    for quadric, name in done.estimator.associations():
        if quadric is not None:
            boxes.setdefault(quadric, Counter())[name] += 1
    to_map = T_map_world(done)
    objects = {str(thing.id): thing.ellipsoid for thing in done.recording.world}
    covariances, graph = done.estimator._covariances, done.estimator._graph  # of (t, L), not of rotation and radii
    result = []
    for j, covariance in covariances.quadrics().items():
        true = objects[boxes[j].most_common(1)[0][0]]
        error = graph.quadric(j) - Ellipsoid(to_map @ true.T_world_object, true.radii).vector()
        result.append(float(error @ np.linalg.solve(covariance, error)))
    return result
