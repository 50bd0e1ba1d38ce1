"""What boxes are believed, and what they deserve (as the document's Fig. 5.3), and how often that comes true."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.graph.noise import NoiseSettings
from calibslam_backend.output.metrics import interpolated
from calibslam_detector.calibration.metrics import whitened
from calibslam_detector.calibration.reliability import reliability
from calibslam_msgs_py.measurements import Array
from calibslam_sim.run_report.loading import Run
from calibslam_sim.run_report.sightings import Sightings, find_sightings
from calibslam_sim.run_report.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    RED,
    decades,
    line_of,
    marker_of,
    new_figure,
    rounded,
)

ONE_SIGMA = 0.6827  # share of normal errors that are smaller than a standard deviation
FEWEST_ROWS = 30  # for a reliability diagram


def sightings_of_map(run: Run) -> Sightings | None:
    """The boxes of keyframes beside the run's own quadrics; None without recording."""
    if run.recorded is None:
        return None
    poses = run.map.poses[[run.keyframe(boxes.stamp) for boxes in run.recorded.boxes]]
    quadrics = [Ellipsoid(quadric.T_map_object, quadric.radii) for quadric in run.map.quadrics]
    classes = [quadric.class_id for quadric in run.map.quadrics]
    return find_sightings(run.recorded.boxes, poses, quadrics, classes, run.recorded.camera)


def sightings_of_truth(run: Run) -> Sightings | None:
    """The same boxes beside the true objects, seen from the true poses; None where these are not known."""
    recorded = run.recorded
    if recorded is None or recorded.truth is None or recorded.objects is None:
        return None
    covered, poses = interpolated(recorded.truth, np.array([boxes.stamp for boxes in recorded.boxes]))
    images = [boxes for boxes, known in zip(recorded.boxes, covered, strict=True) if known]
    return find_sightings(images, poses, recorded.objects, None, recorded.camera)


def sigmas_by_object(run: Run, seen: Sightings) -> go.Figure | None:
    """For each object: the heuristic's deviation, the calibrated ones, and the errors; None without such objects."""
    numbers = seen.often_seen()
    if not numbers:
        return None
    labels = [f"{run.map.quadrics[n].class_id} {run.map.quadrics[n].id}" for n in numbers]
    heuristic, calibrated = seen.heuristic(), seen.calibrated()
    rows = [seen.quadric == n for n in numbers]
    figure = new_figure("object", "standard deviation of an edge [px]", 460)
    figure.add_trace(
        _markers(labels, [heuristic[row][0] for row in rows], "QuadricSLAM's heuristic", "square-open", BLUE)
    )
    middle = [_quantile(calibrated[row], 0.5) for row in rows]
    own = _markers(labels, middle, "that of the boxes, median; bars: 10 to 90 %", "circle", ORANGE)
    own.error_y = {
        "type": "data", "symmetric": False, "color": ORANGE, "thickness": 1.5,
        "array": [_quantile(calibrated[row], 0.9) - m for row, m in zip(rows, middle, strict=True)],
        "arrayminus": [m - _quantile(calibrated[row], 0.1) for row, m in zip(rows, middle, strict=True)],
    }  # fmt: skip
    figure.add_trace(own)
    errors = [_quantile(np.abs(seen.errors[row]), ONE_SIGMA) for row in rows]
    figure.add_trace(_markers(labels, errors, "68 % of its errors in the map are smaller", "x-thin-open", BLACK))
    decades(figure, "y")
    figure.update_xaxes(tickangle=-50, type="category")
    return figure


def reliability_of_boxes(seen: Sightings) -> go.Figure | None:
    """Three noise models of the same boxes, on those with four free edges; None where these are too few."""
    whole = ~np.isnan(seen.errors).any(axis=1) & ~np.isnan(seen.covariances[:, 0, 0])
    if np.count_nonzero(whole) < FEWEST_ROWS:
        return None
    errors, heuristic = seen.errors[whole], seen.heuristic()[whole]
    fixed = NoiseSettings().fixed_sigma
    return _diagram(
        {
            "covariances of the boxes": whitened(errors, seen.covariances[whole]),
            "QuadricSLAM's heuristic": errors / heuristic[:, None],
            f"fixed {fixed:g} px": errors / fixed,
        },
        colours=(ORANGE, BLUE, RED),
    )


def reliability_of_positions(runs: Sequence[Run]) -> go.Figure | None:
    """Positions of keyframes of all runs that have ground truth; None where none has."""
    found = {}
    for run in runs:
        true = run.true_poses()
        if true is None or len(true[1]) < FEWEST_ROWS:
            continue
        covered, poses = true
        # The first is tied to the truth and has no error.
        errors = (run.map.poses[covered] - poses)[1:, :3, 3]
        found[run.name] = whitened(errors, run.position_covariances()[covered][1:])
    return _diagram(found) if found else None


def _diagram(residuals: Mapping[str, Array], colours: Sequence[str] = ()) -> go.Figure:
    figure = new_figure("predicted probability", "share observed", 470)
    diagonal = {"color": GREY, "width": 1.5}
    figure.add_trace(go.Scatter(x=[0, 1], y=[0, 1], mode="lines", name="honest", line=diagonal, hoverinfo="skip"))
    for n, (name, z) in enumerate(residuals.items()):
        curve = reliability(z)
        style = {"line": line_of(n), "marker": marker_of(n, 7)}
        if colours:
            style = {key: {**value, "color": colours[n]} for key, value in style.items()}
        figure.add_trace(
            go.Scatter(
                x=rounded(curve.expected), y=rounded(curve.observed), mode="lines+markers",
                name=f"{name} ({len(z)})", hovertemplate="predicted %{x:.2f}, observed %{y:.2f}", **style,
            )
        )  # fmt: skip
    figure.update_xaxes(range=[0, 1], constrain="domain")
    figure.update_yaxes(range=[0, 1.02], scaleanchor="x", constrain="domain")
    return figure


def _markers(x: list[str], y: Sequence[float], name: str, symbol: str, colour: str) -> go.Scatter:
    return go.Scatter(
        x=x, y=rounded(np.asarray(y), 2), mode="markers", name=name, hovertemplate="%{y:.1f} px",
        marker={"symbol": symbol, "size": 10, "color": colour, "line": {"width": 2, "color": colour}},
    )  # fmt: skip


def _quantile(values: Array, share: float) -> float:
    """Of what is not NaN; NaN where nothing is."""
    known = values[~np.isnan(values)]
    return float(np.quantile(known, share)) if known.size else float("nan")
