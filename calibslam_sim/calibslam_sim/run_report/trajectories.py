"""Where the camera was and how wrong that is, with what the estimate says of it (as the document's Fig. 5.1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calibslam_msgs_py.measurements import Array
from calibslam_sim.run_report.loading import Run
from calibslam_sim.run_report.style import (
    BLACK,
    BLUE,
    COLOURS,
    ESTIMATE,
    GREEN,
    GREY,
    ODOMETRY,
    SIGMAS,
    TRUTH,
    broken,
    decades,
    ellipse,
    limits,
    line_of,
    new_figure,
    rounded,
    translucent,
)

MOST_ELLIPSES = 40  # of positions along a trajectory
MOST_POINTS = 1500  # of the ground truth, which may be known more often than a line needs


def from_above(run: Run) -> go.Figure:
    """Trajectories and objects from above, with ellipses of 2 sigma."""
    figure = new_figure("x forward [m]", "y left [m]", 560)
    positions = run.map.poses[:, :3, 3]
    shown = [positions]
    truth = true_path(run)
    if truth is not None:
        shown.append(truth)
        figure.add_trace(_path(truth, "ground truth (best fit)", TRUTH))
    if run.recorded is not None and run.recorded.odometry is not None:
        odometry = run.recorded.odometry[:, :3, 3]
        shown.append(odometry)
        figure.add_trace(_path(odometry, "odometry alone", ODOMETRY))
    figure.add_trace(_path(positions, "estimate", ESTIMATE))
    every = -(-len(positions) // MOST_ELLIPSES)
    covariances = run.position_covariances()[:, :2, :2] * SIGMAS**2
    outlines = [ellipse(positions[k, :2], covariances[k]) for k in range(0, len(positions), every)]
    figure.add_trace(_outline(outlines, f"{SIGMAS:g} sigma of positions", {"color": BLUE, "width": 1}))
    _objects(figure, run)
    figure.add_trace(
        go.Scatter(
            x=positions[:1, 0], y=positions[:1, 1], mode="markers", name="start",
            marker={"symbol": "star", "size": 13, "color": BLACK},
        )
    )  # fmt: skip
    centres = np.reshape([quadric.T_map_object[:3, 3] for quadric in run.map.quadrics], (-1, 3))
    low, high = limits(np.concatenate(shown), centres)
    figure.update_xaxes(range=[low[0], high[0]])
    figure.update_yaxes(range=[low[1], high[1]], scaleanchor="x")
    return figure


def true_path(run: Run) -> Array | None:
    """(T, 3) true positions in the map during the run, fitted as for ATE; None where they are not known."""
    T_map_world = run.best_fit()
    if run.recorded is None or run.recorded.truth is None or T_map_world is None:
        return None
    truth = run.recorded.truth
    inside = (truth.stamps >= run.map.stamps[0]) & (truth.stamps <= run.map.stamps[-1])
    positions = (T_map_world @ truth.poses[inside])[:, :3, 3]
    return np.asarray(positions[:: -(-len(positions) // MOST_POINTS)])


def errors_by_axis(run: Run) -> go.Figure | None:
    """Errors along the axes of the map over time, with the band of 2 sigma; None without ground truth."""
    found = run.true_poses()
    if found is None:
        return None
    covered, true = found
    seconds = run.seconds[covered]
    errors = run.map.poses[covered][:, :3, 3] - true[:, :3, 3]
    bands = SIGMAS * np.sqrt(np.diagonal(run.position_covariances()[covered], axis1=1, axis2=2))
    odometry = run.recorded.odometry if run.recorded else None
    figure = make_subplots(rows=3, cols=1, shared_xaxes=True, vertical_spacing=0.04)
    figure.update_layout(new_figure(height=560).layout)
    for axis, name in enumerate(("x", "y", "z")):
        at = {"row": axis + 1, "col": 1}
        first = axis == 0
        band = np.concatenate([bands[:, axis], -bands[::-1, axis]])
        figure.add_trace(
            go.Scatter(
                x=rounded(np.concatenate([seconds, seconds[::-1]])), y=rounded(band, 5), fill="toself",
                fillcolor=translucent(BLUE, 0.15), line={"width": 0}, name=f"{SIGMAS:g} sigma, as stated",
                showlegend=first, hoverinfo="skip", legendgroup="band",
            ), **at,
        )  # fmt: skip
        if odometry is not None:
            error = odometry[covered][:, axis, 3] - true[:, axis, 3]
            figure.add_trace(_over_time(seconds, error, "odometry alone", ODOMETRY, first), **at)
        figure.add_trace(_over_time(seconds, errors[:, axis], "estimate", ESTIMATE, first), **at)
        figure.update_yaxes(title=f"error in {name} [m]", **at)
        # Odometry may drift out of sight: what counts is the estimate and its band.
        reach = 1.15 * max(np.abs(errors[:, axis]).max(), bands[:, axis].max())
        figure.update_yaxes(range=[-reach, reach], **at)
    figure.update_xaxes(title="time [s]", row=3, col=1)
    return figure


def errors_of_runs(runs: Sequence[Run]) -> go.Figure | None:
    """Position errors of runs over time, with the root mean square that each states; None without ground truth."""
    figure = new_figure("time [s]", "position error [m]")
    for n, run in enumerate(runs):
        found = run.true_poses()
        if found is None:
            continue
        covered, true = found
        seconds = run.seconds[covered]
        error = np.linalg.norm(run.map.poses[covered][:, :3, 3] - true[:, :3, 3], axis=1)
        stated = SIGMAS * np.sqrt(np.trace(run.position_covariances()[covered], axis1=1, axis2=2))
        figure.add_trace(
            go.Scatter(
                x=rounded(seconds), y=rounded(stated, 5), fill="tozeroy",
                name=f"{run.name}: {SIGMAS:g} sigma, as stated",
                fillcolor=translucent(COLOURS[n % len(COLOURS)], 0.1),
                line={**line_of(n), "width": 0.8}, hoverinfo="skip",
            )
        )  # fmt: skip
        figure.add_trace(_over_time(seconds, error, run.name, line_of(n), True))
    return figure if len(figure.data) else None


def update_times(runs: Sequence[Run]) -> go.Figure | None:
    """Median, 99th percentile and longest update of each run; None where none states them."""
    timed = [run for run in runs if (run.metrics.get("update_ms") or {}).get("p50") is not None]
    if not timed:
        return None
    figure = new_figure("time of an update [ms]", "", 150 + 36 * len(timed))
    names = [run.name for run in timed]
    kinds = (("p50", "median", "circle", BLUE), ("p99", "99 %", "diamond-open", GREEN), ("max", "longest", "x", BLACK))
    for run in timed:
        ends = [run.metrics["update_ms"][key] for key in ("p50", "max")]
        line = {"color": GREY, "width": 1}
        figure.add_trace(go.Scatter(x=ends, y=[run.name] * 2, mode="lines", line=line, showlegend=False))
    for key, name, symbol, colour in kinds:
        times = [run.metrics["update_ms"][key] for run in timed]
        figure.add_trace(
            go.Scatter(
                x=times, y=names, mode="markers", name=name, hovertemplate="%{x:.1f} ms",
                marker={"symbol": symbol, "size": 11, "color": colour},
            )
        )  # fmt: skip
    decades(figure, "x")
    figure.update_yaxes(autorange="reversed", type="category")
    return figure


def _objects(figure: go.Figure, run: Run) -> None:
    outlines, uncertain = [], []
    for quadric in run.map.quadrics:
        R = quadric.T_map_object[:3, :3]
        centre = quadric.T_map_object[:2, 3]
        outlines.append(ellipse(centre, ((R * quadric.radii**2) @ R.T)[:2, :2]))
        if np.isfinite(quadric.covariance).all():
            spread = R @ quadric.covariance[3:6, 3:6] @ R.T * SIGMAS**2
            uncertain.append(ellipse(centre, spread[:2, :2]))
    if outlines:
        outline = _outline(outlines, "objects", {"color": GREEN, "width": 1.5})
        outline.update(fill="toself", fillcolor=translucent(GREEN, 0.15))
        figure.add_trace(outline)
        dashed = {"color": BLACK, "width": 1, "dash": "dot"}
        figure.add_trace(_outline(uncertain, f"{SIGMAS:g} sigma of their centres", dashed))
        centres = np.array([quadric.T_map_object[:2, 3] for quadric in run.map.quadrics])
        figure.add_trace(
            go.Scatter(
                x=rounded(centres[:, 0]), y=rounded(centres[:, 1]), mode="text", name="classes",
                text=[quadric.class_id for quadric in run.map.quadrics], textfont={"size": 10},
                hovertext=[f"{q.class_id} {q.id}: {q.observations} boxes" for q in run.map.quadrics], hoverinfo="text",
            )
        )  # fmt: skip


def _path(positions: Array, name: str, line: dict[str, object]) -> go.Scatter:
    return go.Scatter(x=rounded(positions[:, 0]), y=rounded(positions[:, 1]), mode="lines", name=name, line=line)


def _outline(outlines: list[Array], name: str, line: dict[str, object]) -> go.Scatter:
    points = rounded(broken(outlines))
    return go.Scatter(x=points[:, 0], y=points[:, 1], mode="lines", name=name, line=line, hoverinfo="skip")


def _over_time(seconds: Array, values: Array, name: str, line: dict[str, object], has_legend: bool) -> go.Scatter:
    return go.Scatter(
        x=rounded(seconds), y=rounded(values, 5), mode="lines", name=name, line=line, showlegend=has_legend,
        legendgroup=name, hovertemplate="%{y:.3f} m at %{x:.1f} s",
    )  # fmt: skip
