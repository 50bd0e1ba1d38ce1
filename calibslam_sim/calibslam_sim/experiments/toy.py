"""`toy`: the document's Table 5.1 and Fig. 5.1, with more seeds, more scales, consistency and varying noise.

Four families of conditions, each in the same worlds:
    calibrated, underconfident, ..., scale_S: the graph believes landmark measurements S times as noisy as they are;
    odometry_scale_S: the same with odometry;
    varying_...: every measurement has a noise of its own; the graph knows it (calibrated) or believes a constant;
    direct_overconfident: optimised straight from odometry, where one run in twenty ends in a wrong minimum.
All others are widened first: they believe measurements 8, 4 and 2 times as noisy on the way to their optimum.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import gtsam
import matplotlib
import numpy as np

from calibslam_msgs_py.measurements import Array
from calibslam_sim.experiments.design import (
    CALIBRATED,
    OVERCONFIDENT,
    SCALES,
    UNDERCONFIDENT,
    Experiment,
    Metric,
    Metrics,
    Seed,
    repetition_seed,
    scale_name,
)
from calibslam_sim.experiments.figures import Curve, scale_figure
from calibslam_sim.experiments.toy_world import (
    FIRST_LANDMARK,
    Noise,
    Problem,
    ToySettings,
    World,
    make_world,
    problem,
    solve,
)

matplotlib.use("Agg")
from matplotlib import pyplot as plt

ODOMETRY, VARYING = "odometry_", "varying_"
VARYING_CALIBRATED, VARYING_RMS = VARYING + CALIBRATED, VARYING + "rms"
DIRECT = "direct_"
WIDENING = (8.0, 4.0, 2.0)
COARSE = 1e-5  # tolerance of the optimisation on the way
FIXED_SIGMA = 1e-6  # of the start, where errors relative to it are meant [m, rad]


def run(settings: ToySettings, condition: str, seed: Seed) -> Metrics:
    """One condition on one seed."""
    world = make_world(settings, seed)
    noise = noise_of(world, settings, condition)
    posed, estimate = optimise(world, settings, noise, condition.startswith(DIRECT))
    poses = [estimate.atPose2(k) for k in range(len(world.poses))]
    landmarks = np.array([estimate.atPoint2(FIRST_LANDMARK + j) for j in range(len(world.landmarks))])
    return {
        "ate_m": rms([p.translation() - t.translation() for p, t in zip(poses, world.poses, strict=True)]),
        "rpe_m": rms(
            [
                true_start.between(true_end).between(start.between(end)).translation()
                for (start, end), (true_start, true_end) in zip(pairwise(poses), pairwise(world.poses), strict=True)
            ]
        ),
        "landmark_rmse_m": rms(landmarks - world.landmarks),
        "nees_pose": nees_of_pose(posed, estimate, world, 3 * len(world.poses) // 4),
    }


def noise_of(world: World, settings: ToySettings, condition: str) -> Noise:
    """What a condition believes."""
    ones = np.ones(len(world.seen))
    name = condition.removeprefix(DIRECT)
    for scale in SCALES:
        if name == scale_name(scale):
            return Noise(1.0, scale * ones, ones)
        if name == scale_name(scale, ODOMETRY):
            return Noise(scale, ones, ones)
        if name == scale_name(scale, VARYING):
            return Noise(1.0, scale * ones, world.factors)
    if name == VARYING_CALIBRATED:
        return Noise(1.0, world.factors, world.factors)
    if name == VARYING_RMS:
        return Noise(1.0, rms_factor(settings.variation) * ones, world.factors)
    raise ValueError(f"no condition {condition!r}")


def optimise(
    world: World, settings: ToySettings, noise: Noise, is_direct: bool = False
) -> tuple[Problem, gtsam.Values]:
    """The factor graph of a repetition and its optimum, from odometry's initial values.

    Sharp measurements have narrow minima, which a start from odometry misses; a graph that believes them less leads
    there. Without this the experiment would compare how well optimisation fares, not what covariances are worth.
    """
    posed = problem(world, settings, noise)
    values = posed.initial
    for factor in () if is_direct else WIDENING:
        widened = problem(world, settings, replace(noise, believed=factor * noise.believed))
        values = solve(widened.graph, values, COARSE)
    return posed, solve(posed.graph, values)


def rms_factor(variation: float) -> float:
    """Root mean square of a factor that is log-uniform in [1 / variation, variation]: right on average."""
    if variation == 1.0:
        return 1.0
    return float(np.sqrt((variation**2 - variation**-2) / (4.0 * np.log(variation))))


def rms(errors: Array | list[Array]) -> float:
    """Root of the mean squared length of errors (N, 2)."""
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


def nees_of_pose(posed: Problem, estimate: gtsam.Values, world: World, k: int) -> float:
    """Normalised squared error (3 degrees of freedom) of pose k relative to the first; NaN where the estimate is so
    bad that it has no covariance.

    Relative, because the document's prior has a deviation but no error. One pose of each repetition, because errors
    along a trajectory depend on each other, those of repetitions do not.
    """
    graph = gtsam.NonlinearFactorGraph(posed.graph)
    start, end = estimate.atPose2(0), estimate.atPose2(k)
    fixed = gtsam.noiseModel.Isotropic.Sigma(3, FIXED_SIGMA)
    graph.replace(0, gtsam.PriorFactorPose2(0, start, fixed))
    error = start.between(end).localCoordinates(world.poses[0].between(world.poses[k]))
    try:
        covariance = gtsam.Marginals(graph, estimate).marginalCovariance(k)
    except RuntimeError:  # GTSAM: an indeterminate system
        return float("nan")
    return float(error @ np.linalg.solve(covariance, error))


def conditions(settings: ToySettings) -> list[str]:
    """Factors on the measurements, on odometry, and of a constant where noise varies."""
    return [
        *(scale_name(scale) for scale in SCALES),
        *(scale_name(scale, ODOMETRY) for scale in SCALES if scale != 1.0),
        VARYING_CALIBRATED,
        VARYING_RMS,
        *(scale_name(scale, VARYING) for scale in SCALES),
        DIRECT + OVERCONFIDENT,
    ]


def comparisons(settings: ToySettings) -> list[tuple[str, str]]:
    """The truth against all others of its family."""
    return [
        (truth, name)
        for name in conditions(settings)
        for truth in (VARYING_CALIBRATED if name.startswith(VARYING) else CALIBRATED,)
        if name != truth
    ]


def figure(result: dict[str, Any], path: Path) -> None:
    """All metrics over the factor, and beside it Fig. 5.1 for the first repetition."""
    curves = [
        Curve("landmark measurements", {scale: scale_name(scale) for scale in SCALES}),
        Curve("odometry", {scale: scale_name(scale, ODOMETRY) if scale != 1.0 else CALIBRATED for scale in SCALES}),
        Curve(
            "varying noise, believed constant",
            {scale: scale_name(scale, VARYING) for scale in SCALES},
            VARYING_CALIBRATED,
            "varying noise, each as it is",
        ),
    ]
    scale_figure(path, EXPERIMENT.title, result, METRICS, curves, EXPERIMENT.degrees_of_freedom)
    _trajectories(ToySettings(**result["settings"]), path.with_name(f"{path.stem}_trajectories{path.suffix}"))


def _trajectories(settings: ToySettings, path: Path) -> None:
    """Fig. 5.1: truth, initialisation and estimate of the first repetition, calibrated."""
    world = make_world(settings, repetition_seed(settings.seed, 0))
    posed, estimate = optimise(world, settings, noise_of(world, settings, CALIBRATED))
    truth = np.array([pose.translation() for pose in world.poses])
    figure, axes = plt.subplots(1, 3, figsize=(13, 6), sharex=True, sharey=True, dpi=110)
    panels = [
        ("(a) truth", truth, world.landmarks),
        *(
            (
                title,
                np.array([values.atPose2(k).translation() for k in range(len(truth))]),
                np.array([values.atPoint2(FIRST_LANDMARK + j) for j in range(len(world.landmarks))]),
            )
            for title, values in (("(b) initial, from odometry", posed.initial), ("(c) estimate", estimate))
        ),
    ]
    for panel, (title, trajectory, landmarks) in zip(axes, panels, strict=True):
        panel.plot(*truth.T, "-", color="0.75", linewidth=4.0, label="true trajectory")
        panel.plot(*trajectory.T, "k-", linewidth=1.2, label="trajectory")
        panel.plot(*landmarks.T, "k+", markersize=6, label="landmarks")
        panel.set(title=title, xlabel="x [m]", aspect="equal")
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("y [m]")
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


METRICS = {
    "ate_m": Metric("ATE", "m"),
    "rpe_m": Metric("RPE", "m"),
    "landmark_rmse_m": Metric("landmark RMSE", "m"),
    "nees_pose": Metric("NEES of a pose", is_error=False),
}

TABLE_5_1 = {
    UNDERCONFIDENT: {"ate_m": (1.187, 0.386), "rpe_m": (0.111, 0.004), "landmark_rmse_m": (1.181, 0.384)},
    CALIBRATED: {"ate_m": (0.9878, 0.356), "rpe_m": (0.0996, 0.004), "landmark_rmse_m": (0.992, 0.351)},
    OVERCONFIDENT: {"ate_m": (1.034, 0.492), "rpe_m": (0.114, 0.006), "landmark_rmse_m": (1.047, 0.493)},
}

EXPERIMENT = Experiment(
    title="Robot and landmarks in the plane under wrong covariances (Table 5.1)",
    settings=ToySettings,
    quick={"poses": 60, "turn_rate": 0.2},
    seeds=400,  # 0.06 m of ATE between x1 and x1/2, with a deviation of 0.26 m over pairs
    quick_seeds=5,
    metrics=METRICS,
    conditions=conditions,
    run=run,
    comparisons=comparisons,
    figure=figure,
    degrees_of_freedom={"nees_pose": 3},
    document=lambda settings: TABLE_5_1,
)
