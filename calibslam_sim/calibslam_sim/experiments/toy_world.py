"""The document's toy world (section 5.1): a robot drives a figure 8 in the plane and sees landmarks near it."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import setting
from calibslam_sim.experiments.design import ExperimentSettings, Seed

FIRST_LANDMARK = 1_000_000  # key of landmark 0 in the graph; pose k has key k
PRIOR_SIGMAS = np.array([0.05, 0.05, np.radians(2.0)])  # [m, m, rad] of the first pose


@dataclass(frozen=True)
class ToySettings(ExperimentSettings):
    """The world of the document's Table 5.1."""

    poses: int = setting(252, "poses of the robot; the turn changes its sense after half of them", low=5)
    speed: float = setting(1.0, "of the robot", unit="m/s", low=1e-3)
    turn_rate: float = setting(0.05, "of the robot", unit="rad/s", low=1e-3)
    time_step: float = setting(1.0, "between poses", unit="s", low=1e-3)
    cell: float = setting(5.0, "there is one landmark in each square cell of this size", unit="m", low=0.1)
    reach: float = setting(5.0, "largest distance at which a landmark is seen", unit="m", low=0.1)
    # The document states none; a bearing means nothing at a landmark, and measured ranges must not be negative.
    shortest_range: float = setting(0.5, "smallest distance at which a landmark is seen", unit="m", low=0.0)
    odometry_translation: float = setting(0.1, "odometry: standard deviation along x and y", unit="m", low=1e-6)
    odometry_rotation: float = setting(2.0, "odometry: standard deviation of the turn", unit="deg", low=1e-6)
    bearing: float = setting(2.0, "standard deviation of a bearing", unit="deg", low=1e-6)
    range: float = setting(0.1, "standard deviation of a range", unit="m", low=1e-6)
    variation: float = setting(
        4.0, "where noise varies: largest factor on a measurement's deviation, and 1 over the smallest", low=1.0
    )

    @property
    def odometry_sigmas(self) -> Array:
        """(3,) x, y [m], turn [rad]."""
        return np.array([self.odometry_translation, self.odometry_translation, np.radians(self.odometry_rotation)])

    @property
    def measurement_sigmas(self) -> Array:
        """(2,) bearing [rad], range [m]."""
        return np.array([np.radians(self.bearing), self.range])


@dataclass(frozen=True)
class World:
    """The truth, and the noise of one repetition in units of its standard deviation.

    Attributes:
        poses: K true poses; the first is the origin.
        landmarks: (N, 2) [m], those that are ever seen.
        seen: (M, 2) pose and landmark of each measurement, in order of time.
        bearings: (M,) true bearings [rad] in the robot's frame.
        ranges: (M,) true distances [m].
        odometry_noise: (K - 1, 3) unit normal.
        measurement_noise: (M, 2) unit normal.
        factors: (M,) on the standard deviations of each measurement, where noise varies: log-uniform.
    """

    poses: list[gtsam.Pose2]
    landmarks: Array
    seen: np.ndarray
    bearings: Array
    ranges: Array
    odometry_noise: Array
    measurement_noise: Array
    factors: Array


def figure_eight(settings: ToySettings) -> list[gtsam.Pose2]:
    """One circle to the left, then one to the right, from the origin along x."""
    step, turn = settings.speed * settings.time_step, settings.turn_rate * settings.time_step
    poses = [gtsam.Pose2()]
    for k in range(settings.poses - 1):
        sense = 1.0 if k < settings.poses // 2 else -1.0
        poses.append(poses[-1].compose(gtsam.Pose2.Expmap(np.array([step, 0.0, sense * turn]))))
    return poses


def landmark_grid(positions: Array, cell: float, rng: np.random.Generator) -> Array:
    """A landmark (N, 2) drawn uniformly in each cell of the square around these positions (K, 2)."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    side = float((high - low).max())
    cells = int(np.ceil(side / cell))
    corner = (low + high) / 2.0 - cells * cell / 2.0
    grid = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 2)
    return np.asarray(corner + cell * (grid + rng.uniform(size=grid.shape)))


def make_world(settings: ToySettings, seed: Seed) -> World:
    """The world of one repetition."""
    places, odometry, measurements, variation = (np.random.default_rng(child) for child in seed.spawn(4))
    poses = figure_eight(settings)
    states = np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])
    landmarks = landmark_grid(states[:, :2], settings.cell, places)
    distances = np.linalg.norm(states[:, None, :2] - landmarks[None], axis=2)
    visible = (distances <= settings.reach) & (distances >= settings.shortest_range)
    kept = visible.any(axis=0)
    landmarks, visible = landmarks[kept], visible[:, kept]
    seen = np.argwhere(visible)
    offsets = landmarks[seen[:, 1]] - states[seen[:, 0], :2]
    reach = np.log(settings.variation)
    return World(
        poses=poses,
        landmarks=landmarks,
        seen=seen,
        bearings=np.arctan2(offsets[:, 1], offsets[:, 0]) - states[seen[:, 0], 2],
        ranges=np.linalg.norm(offsets, axis=1),
        odometry_noise=odometry.standard_normal((len(poses) - 1, 3)),
        # Drawn for every landmark at every pose: what is seen does not shift the numbers of the rest.
        measurement_noise=measurements.standard_normal((*visible.shape, 2))[visible],
        factors=np.exp(variation.uniform(-reach, reach, visible.shape))[visible],
    )


@dataclass(frozen=True)
class Problem:
    """A factor graph with its initial values: the prior comes first."""

    graph: gtsam.NonlinearFactorGraph
    initial: gtsam.Values


@dataclass(frozen=True)
class Noise:
    """What the noise is, and what a graph believes, as factors on the standard deviations of `ToySettings`.

    Attributes:
        odometry: believed.
        believed: (M,) of each measurement.
        true: (M,) of each measurement.
    """

    odometry: float
    believed: Array
    true: Array


def problem(world: World, settings: ToySettings, noise: Noise) -> Problem:
    """The factor graph of a repetition (eq. 2.2.4), initialised as in section 5.1.2."""
    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, world.poses[0], diagonal(PRIOR_SIGMAS)))
    guesses = [world.poses[0]]
    initial.insert(0, guesses[0])
    step_noise = diagonal(noise.odometry * settings.odometry_sigmas)
    for k, unit in enumerate(world.odometry_noise):
        error = gtsam.Pose2.Expmap(unit * settings.odometry_sigmas)
        measured = world.poses[k].between(world.poses[k + 1]).compose(error)
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, measured, step_noise))
        guesses.append(guesses[-1].compose(measured))
        initial.insert(k + 1, guesses[-1])
    sigmas = settings.measurement_sigmas
    errors = world.measurement_noise * noise.true[:, None] * sigmas
    for (k, j), bearing, distance, believed in zip(
        world.seen.tolist(), world.bearings + errors[:, 0], world.ranges + errors[:, 1], noise.believed, strict=True
    ):
        key = FIRST_LANDMARK + j
        noise_model = diagonal(believed * sigmas)
        graph.add(gtsam.BearingRangeFactor2D(k, key, gtsam.Rot2(bearing), distance, noise_model))
        if not initial.exists(key):
            place = distance * np.array([np.cos(bearing), np.sin(bearing)])
            initial.insert(key, guesses[k].transformFrom(place))
    return Problem(graph, initial)


def solve(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, tolerance: float = 1e-10) -> gtsam.Values:
    """Levenberg-Marquardt; GTSAM's usual tolerance of 1e-5 stops one run in six too early here."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(tolerance)
    parameters.setMaxIterations(300)
    return gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters).optimize()
