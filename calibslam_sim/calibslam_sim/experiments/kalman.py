"""`kalman`: chapter 3 of the document. A Kalman filter is a factor graph, and both need the true covariances.

A body moves in the plane at nearly constant velocity; its position is measured at every step. The filter is given
measurement (or process) noise that is a factor away from what it is. Its mean squared error is least, and its
covariance honest, where the factor is 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import setting
from calibslam_sim.experiments.design import (
    CALIBRATED,
    SCALES,
    Experiment,
    ExperimentSettings,
    Metric,
    Metrics,
    Seed,
    scale_name,
)
from calibslam_sim.experiments.figures import Curve, scale_figure

PROCESS = "process_"  # conditions in which the process noise is believed wrongly
DIMENSION = 4  # of the state: x, y [m] and their velocities [m/s]


@dataclass(frozen=True)
class KalmanSettings(ExperimentSettings):
    """The body, and how it is seen."""

    steps: int = setting(100, "measurements of a repetition", low=2)
    time_step: float = setting(1.0, "between measurements", unit="s", low=1e-3)
    acceleration: float = setting(0.3, "spectral density of the random acceleration", unit="m/s^1.5", low=1e-6)
    position_sigma: float = setting(1.0, "standard deviation of a measured coordinate", unit="m", low=1e-6)
    start_position: float = setting(1.0, "standard deviation of the first position", unit="m", low=1e-6)
    start_velocity: float = setting(1.0, "standard deviation of the first velocity", unit="m/s", low=1e-6)


@dataclass(frozen=True)
class Model:
    """x_t = F x_{t-1} + w, z_t = H x_t + v, with covariances Q of w and R of v (eq. 3.1.1); x_0 has mean 0 and
    covariance P."""

    F: Array
    Q: Array
    H: Array
    R: Array
    P: Array


def constant_velocity(settings: KalmanSettings) -> Model:
    """The true model; Q is that of white noise acceleration, integrated over a step."""
    dt = settings.time_step
    return Model(
        F=_in_plane([[1.0, dt], [0.0, 1.0]]),
        Q=settings.acceleration**2 * _in_plane([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]),
        H=_in_plane([[1.0, 0.0]]),
        R=settings.position_sigma**2 * np.eye(2),
        P=_in_plane([[settings.start_position**2, 0.0], [0.0, settings.start_velocity**2]]),
    )


def _in_plane(on_a_line: Sequence[Sequence[float]]) -> Array:
    """The matrix for both coordinates, of position and velocity on a line."""
    return np.asarray(np.kron(on_a_line, np.eye(2)), float)


def simulate(model: Model, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """True states (T, 4) and measurements (T, 2) at times 1 ... T."""
    w = rng.standard_normal((steps, DIMENSION)) @ np.linalg.cholesky(model.Q).T
    v = rng.standard_normal((steps, 2)) @ np.linalg.cholesky(model.R).T
    x = np.linalg.cholesky(model.P) @ rng.standard_normal(DIMENSION)
    states = np.empty((steps, DIMENSION))
    for t in range(steps):
        x = model.F @ x + w[t]
        states[t] = x
    return states, states @ model.H.T + v


def kalman_filter(model: Model, measurements: Array) -> tuple[Array, Array]:
    """States (T, 4) and covariances (T, 4, 4), each after its measurement (T, 2); eq. 3.1.2 and 3.1.3.

    The document writes P'_{t-1} in the prediction of P'_t; meant is the covariance after the update, P_{t-1}.
    """
    x, P = np.zeros(DIMENSION), model.P
    states, covariances = [], []
    for z in measurements:
        x = model.F @ x
        P = model.F @ P @ model.F.T + model.Q
        K = P @ model.H.T @ np.linalg.inv(model.H @ P @ model.H.T + model.R)
        x = x + K @ (z - model.H @ x)
        P = (np.eye(DIMENSION) - K @ model.H) @ P
        states.append(x)
        covariances.append(P)
    return np.array(states), np.array(covariances)


def factor_graph(model: Model, measurements: Array) -> tuple[Array, Array]:
    """The same states and covariances, each as the last variable of the graph of all measurements up to it.

    Variables are differences to what was measured, at rest, so that they are small: elimination by Cholesky
    rounds in proportion to them.
    """
    origins = np.vstack([np.zeros(DIMENSION), measurements @ model.H])
    whiten_Q, whiten_R, whiten_P = (np.linalg.inv(np.linalg.cholesky(C)) for C in (model.Q, model.R, model.P))
    graph = gtsam.GaussianFactorGraph()
    unit = gtsam.noiseModel.Unit.Create
    graph.add(0, whiten_P, np.zeros(DIMENSION), unit(DIMENSION))
    # Eliminated in the order of time, the last conditional is that of the newest state alone.
    ordering = gtsam.Ordering()
    ordering.push_back(0)
    states, covariances = [], []
    for t, z in enumerate(measurements, 1):
        predicted = model.F @ origins[t - 1]
        graph.add(t - 1, -whiten_Q @ model.F, t, whiten_Q, whiten_Q @ (predicted - origins[t]), unit(DIMENSION))
        graph.add(t, whiten_R @ model.H, whiten_R @ (z - model.H @ origins[t]), unit(2))
        ordering.push_back(t)
        conditional = graph.eliminateSequential(ordering).at(t)
        R = conditional.R()
        states.append(origins[t] + np.linalg.solve(R, conditional.d()))
        covariances.append(np.linalg.inv(R.T @ R))
    return np.array(states), np.array(covariances)


def believed(model: Model, condition: str) -> Model:
    """The model as a condition states it: one of its standard deviations times a factor."""
    for scale in SCALES:
        if condition == scale_name(scale):
            return Model(model.F, model.Q, model.H, scale**2 * model.R, model.P)
        if condition == scale_name(scale, PROCESS):
            return Model(model.F, scale**2 * model.Q, model.H, model.R, model.P)
    raise ValueError(f"no condition {condition!r}")


def run(settings: KalmanSettings, condition: str, seed: Seed) -> Metrics:
    """One condition on one seed."""
    truth = constant_velocity(settings)
    states, measurements = simulate(truth, settings.steps, np.random.default_rng(seed))
    model = believed(truth, condition)
    filtered, covariances = kalman_filter(model, measurements)
    smoothed, of_graph = factor_graph(model, measurements)
    error = filtered - states
    return {
        "mse": float(np.mean(np.sum(error[:, :2] ** 2, axis=1))),
        "nees_state": float(error[-1] @ np.linalg.solve(covariances[-1], error[-1])),
        "filter_graph_difference": float(max(np.abs(filtered - smoothed).max(), np.abs(covariances - of_graph).max())),
    }


def conditions(settings: KalmanSettings) -> list[str]:
    """Every factor on the measurement noise, then on the process noise."""
    return [scale_name(scale) for scale in SCALES] + [scale_name(scale, PROCESS) for scale in SCALES if scale != 1.0]


def comparisons(settings: KalmanSettings) -> list[tuple[str, str]]:
    """The truth against all others."""
    return [(CALIBRATED, other) for other in conditions(settings) if other != CALIBRATED]


def largest_difference(values: Mapping[str, Mapping[str, Sequence[float]]]) -> dict[str, Any]:
    """The entry filter_graph_max_difference of result.json: any state [m, m/s] or covariance, at any time."""
    return {"filter_graph_max_difference": max(max(each["filter_graph_difference"]) for each in values.values())}


def figure(result: dict[str, Any], path: Path) -> None:
    """Error and honesty over the factor."""
    curves = [
        Curve("measurement noise", {scale: scale_name(scale) for scale in SCALES}),
        Curve(
            "process noise",
            {scale: scale_name(scale, PROCESS) if scale != 1.0 else CALIBRATED for scale in SCALES},
        ),
    ]
    shown = {name: METRICS[name] for name in ("mse", "nees_state")}
    scale_figure(path, EXPERIMENT.title, result, shown, curves, EXPERIMENT.degrees_of_freedom)


METRICS = {
    "mse": Metric("MSE of the position", "m²"),
    "nees_state": Metric("NEES of the last state", is_error=False),
    "filter_graph_difference": Metric("filter - graph", is_error=False),
}

EXPERIMENT = Experiment(
    title="Kalman filter and factor graph under wrong covariances (chapter 3)",
    settings=KalmanSettings,
    quick={"steps": 20},
    seeds=400,
    quick_seeds=20,
    metrics=METRICS,
    conditions=conditions,
    run=run,
    comparisons=comparisons,
    figure=figure,
    degrees_of_freedom={"nees_state": DIMENSION},
    further=largest_difference,
)
