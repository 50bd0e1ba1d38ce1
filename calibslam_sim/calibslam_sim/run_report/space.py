"""The map in space, to be turned with the mouse (as the document's Fig. 5.4, with what is known of each thing)."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import plotly.graph_objects as go

from calibslam_msgs_py.measurements import Array, QuadricEstimate
from calibslam_sim.run_report.loading import Run
from calibslam_sim.run_report.style import (
    BLACK,
    BLUE,
    COLOURS,
    ESTIMATE,
    ODOMETRY,
    SIGMAS,
    TRUTH,
    broken,
    limits,
    new_figure,
    rounded,
)
from calibslam_sim.run_report.trajectories import true_path

MERIDIANS, PARALLELS = 18, 11
MOST_ELLIPSOIDS = 15  # of positions along a trajectory


def in_space(run: Run) -> go.Figure:
    """Quadrics, 2 sigma of their centres, and the trajectories."""
    figure = new_figure(height=640)
    positions = run.map.poses[:, :3, 3]
    for quadrics in _by_class(run).values():
        figure.add_traces([_body(quadric, quadric is quadrics[0]) for quadric in quadrics])
    centres = np.reshape([quadric.T_map_object[:3, 3] for quadric in run.map.quadrics], (-1, 3))
    figure.add_trace(
        go.Scatter3d(
            **_xyz(centres), mode="text", text=[quadric.class_id for quadric in run.map.quadrics], name="class names",
            textfont={"size": 11}, hoverinfo="skip",
        )
    )  # fmt: skip
    known = [quadric for quadric in run.map.quadrics if np.isfinite(quadric.covariance).all()]
    rings = [ring for quadric in known for ring in _rings(*_centre_uncertainty(quadric))]
    figure.add_trace(_line(broken(rings), f"{SIGMAS:g} sigma of centres", {"color": BLACK, "width": 2}))
    truth = true_path(run)
    if truth is not None:
        figure.add_trace(_line(truth, "ground truth (best fit)", TRUTH))
    if run.recorded is not None and run.recorded.odometry is not None:
        figure.add_trace(_line(run.recorded.odometry[:, :3, 3], "odometry alone", ODOMETRY))
    figure.add_trace(_line(positions, "estimate", {**ESTIMATE, "width": 4}))
    every = -(-len(positions) // MOST_ELLIPSOIDS)
    covariances = run.position_covariances()
    rings = [ring for k in range(0, len(positions), every) for ring in _rings(positions[k], covariances[k])]
    figure.add_trace(_line(broken(rings), f"{SIGMAS:g} sigma of positions", {"color": BLUE, "width": 1}))
    low, high = limits(positions, centres)
    figure.update_layout(
        scene={
            **{f"{axis}axis": {"title": f"{axis} [m]", "range": [low[k], high[k]]} for k, axis in enumerate("xyz")},
            "aspectmode": "data",
            "camera": {"eye": {"x": -1.0, "y": -1.0, "z": 0.8}, "center": {"x": 0.0, "y": 0.0, "z": -0.15}},
        },
        margin={"l": 0, "r": 0, "t": 30, "b": 0},
    )
    return figure


def _by_class(run: Run) -> dict[str, list[QuadricEstimate]]:
    found: dict[str, list[QuadricEstimate]] = defaultdict(list)
    for quadric in run.map.quadrics:
        found[quadric.class_id].append(quadric)
    return dict(sorted(found.items()))


def _body(quadric: QuadricEstimate, has_legend: bool) -> go.Mesh3d:
    """An ellipsoid; those of a class share a name in the legend."""
    unit, triangles = unit_sphere()
    points = quadric.T_map_object[:3, 3] + (unit * quadric.radii) @ quadric.T_map_object[:3, :3].T
    i, j, k = triangles.T.astype(np.int16)
    return go.Mesh3d(
        **_xyz(points), i=i, j=j, k=k, color=COLOURS[sum(map(ord, quadric.class_id)) % len(COLOURS)], opacity=0.45,
        name=quadric.class_id, legendgroup=quadric.class_id, showlegend=has_legend, hovertext=_text(quadric),
        hoverinfo="text",
    )  # fmt: skip


def _text(quadric: QuadricEstimate) -> str:
    sigmas = np.sqrt(np.diag(quadric.covariance))
    radii = ", ".join(f"{100 * r:.1f} ± {100 * s:.1f}" for r, s in zip(quadric.radii, sigmas[6:], strict=True))
    place = 100 * np.sqrt(np.square(sigmas[3:6]).sum())
    return (
        f"{quadric.class_id} {quadric.id}<br>{quadric.observations} boxes<br>"
        f"radii {radii} cm<br>centre ± {place:.1f} cm"
    )


def unit_sphere() -> tuple[Array, np.ndarray]:
    """Points (N, 3) and triangles (M, 3) of a sphere; neighbouring meridians share their points, the poles are one."""
    rows = np.linspace(0.0, np.pi, PARALLELS)[1:-1]
    columns = np.arange(MERIDIANS) * 2.0 * np.pi / MERIDIANS
    theta, phi = np.meshgrid(rows, columns, indexing="ij")
    belt = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    points = np.concatenate([belt.reshape(-1, 3), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    here = np.arange(len(rows) * MERIDIANS).reshape(len(rows), MERIDIANS)
    next_to = np.roll(here, -1, axis=1)
    north, south = len(points) - 2, len(points) - 1
    sides = [
        np.stack([here[:-1], here[1:], next_to[:-1]], axis=-1).reshape(-1, 3),
        np.stack([next_to[:-1], here[1:], next_to[1:]], axis=-1).reshape(-1, 3),
        np.stack([np.full(MERIDIANS, north), here[0], next_to[0]], axis=-1),
        np.stack([np.full(MERIDIANS, south), next_to[-1], here[-1]], axis=-1),
    ]
    return points, np.concatenate(sides)


def _centre_uncertainty(quadric: QuadricEstimate) -> tuple[Array, Array]:
    """Centre (3,) and its covariance (3, 3) in the map."""
    R = quadric.T_map_object[:3, :3]
    return quadric.T_map_object[:3, 3], R @ quadric.covariance[3:6, 3:6] @ R.T


def _rings(centre: Array, covariance: Array) -> list[Array]:
    """The three main ellipses of the ellipsoid of 2 sigma, each (points, 3)."""
    values, vectors = np.linalg.eigh(covariance)
    axes = vectors * (SIGMAS * np.sqrt(np.maximum(values, 0.0)))
    angles = np.linspace(0.0, 2.0 * np.pi, 25)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    return [centre + (axes[:, list(pair)] @ circle).T for pair in ((0, 1), (0, 2), (1, 2))]


def _line(points: Array, name: str, line: dict[str, object]) -> go.Scatter3d:
    return go.Scatter3d(**_xyz(points), mode="lines", name=name, line=line, hoverinfo="skip")


def _xyz(points: Array) -> dict[str, Array]:
    return dict(zip("xyz", rounded(points).T, strict=True))
