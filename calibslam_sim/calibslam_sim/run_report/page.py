"""One HTML page that needs nothing beside it: figures, their library and images are inside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from calibslam_sim.run_report import boxes, image_view, space, trajectories
from calibslam_sim.run_report.loading import Run
from calibslam_sim.run_report.sightings import Sightings
from calibslam_sim.run_report.template import SCRIPT, STYLE

HOW_TO_READ = (
    "Ellipses and bands show 2 sigma. The estimate is solid, odometry alone dotted, ground truth thick and grey. "
    "Drag to zoom or turn, double-click to go back; a click on a name in a legend hides it."
)


def page(runs: Sequence[Run]) -> str:
    """The page of these runs, at least one; the same runs give the same bytes."""
    parts = _Parts()
    title = "CalibSLAM: " + ", ".join(run.name for run in runs)
    parts.add(f"<h1>{escape(title)}</h1><p>{HOW_TO_READ}</p>")
    parts.add("<noscript><p><b>The figures need JavaScript; nothing is loaded from anywhere.</b></p></noscript>")
    _comparison(parts, runs)
    for n, run in enumerate(runs):
        parts.add(f"<details{' open' if n == 0 else ''}><summary>{escape(run.name)}</summary>")
        _of_run(parts, run)
        parts.add("</details>")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>\n"
        f"{parts.html()}\n<script>{get_plotlyjs()}</script>\n<script>{SCRIPT}</script></body></html>\n"
    )


class _Parts:
    """Pieces of the page; figures are numbered."""

    def __init__(self) -> None:
        self._pieces: list[str] = []
        self._figures = 0

    def add(self, html: str) -> None:
        self._pieces.append(html)

    def figure(self, title: str, text: str, figure: go.Figure | None, otherwise: str = "") -> None:
        """A figure below its title and what it shows; without one, why not."""
        if figure is None:
            if otherwise:
                self.add(f'<h3>{title}</h3><p class="note">{otherwise}</p>')
            return
        name = f"figure-{self._figures}"
        self._figures += 1
        # The end of a script element must not stand inside one.
        content = figure.to_json().replace("</", "<\\/")
        self.add(
            f'<h3>{title}</h3><p class="note">{text}</p><div data-figure="{name}"></div>'
            f'<script type="application/json" id="{name}">{content}</script>'
        )

    def html(self) -> str:
        return "\n".join(self._pieces)


def _comparison(parts: _Parts, runs: Sequence[Run]) -> None:
    parts.add("<h2>All runs</h2>" if len(runs) > 1 else "<h2>Numbers</h2>")
    parts.add(metrics_table(runs))
    parts.figure(
        "Position errors",
        "Tied to the truth at the first keyframe. A thin line above its run's error most of the time is honest.",
        trajectories.errors_of_runs(runs),
        "No recording of these runs is at hand, and with it no true path: no errors over time."
        if all(run.recorded is None for run in runs)
        else "No ground truth: neither errors nor NEES.",
    )
    parts.figure(
        "Reliability of positions",
        "How often a keyframe's true position lay inside the ellipsoid of each probability: below the diagonal is "
        "overconfident. Neighbouring keyframes err alike, so even an honest run strays from the diagonal.",
        boxes.reliability_of_positions(runs),
    )
    parts.figure("Update times", "Of one keyframe, from its boxes to the updated map.", trajectories.update_times(runs))


def _of_run(parts: _Parts, run: Run) -> None:
    if run.recorded is None:
        parts.add(f'<p class="note">The recording of this run is not at hand: {escape(missing(run))}.</p>')
    parts.figure("Map from above", "Trajectory and objects with their covariances.", trajectories.from_above(run))
    parts.figure("Map in space", "Point at an object to see what is known of it.", space.in_space(run))
    parts.figure(
        "Errors along the axes of the map",
        "Tied to the truth at the first keyframe; 95 % of an honest estimate lies inside its band.",
        trajectories.errors_by_axis(run),
    )
    seen = boxes.sightings_of_map(run)
    if seen is None:
        return
    drawings = image_view.views(run, seen)
    if drawings:
        parts.add(
            '<h3>Boxes, their covariances and quadrics</h3><p class="note">Yellow, solid: measured boxes and 2 sigma '
            "of their corners as the detector or calibrator states it. Blue, dashed: 2 sigma of QuadricSLAM's "
            f"heuristic. White, dotted: the map's quadrics.</p><div class='views'>{''.join(drawings)}</div>"
        )
    parts.figure(
        "Heuristic and calibrated deviations",
        "QuadricSLAM takes the spread of an object's box sizes for the boxes' noise; that grows as the camera comes "
        "nearer. The crosses tell what is true, if the map is.",
        boxes.sigmas_by_object(run, seen),
    )
    parts.figure(
        "Reliability of boxes, measured at this run's map",
        "Errors against the projected quadrics, which were fitted to these very boxes. Below the diagonal is "
        f"overconfident. {_correlation(seen)}",
        boxes.reliability_of_boxes(seen),
    )
    true = boxes.sightings_of_truth(run)
    if true is not None:
        parts.figure(
            "Reliability of boxes, measured at the true objects",
            f"Errors against the true objects seen from the true poses. {_correlation(true)}",
            boxes.reliability_of_boxes(true),
        )


def missing(run: Run) -> str:
    """Why the recording of a run is not at hand, what is left out without it, and how to name it."""
    return f"{run.missing}; without it there are no odometry, truth, boxes and images; --recording BAG names one"


def _correlation(seen: Sightings) -> str:
    found = seen.neighbour_correlation()
    if np.isnan(found):
        return ""
    return (
        f"Errors of an object's boxes in neighbouring keyframes correlate by {found:.2f}: a row of them says less than "
        "their number, which the graph allows for unless --no-box-correlation is given."
    )


def metrics_table(runs: Sequence[Run]) -> str:
    """A column for each run; a tick at the best of several."""
    head = "".join(f"<th>{escape(run.name)}</th>" for run in runs)
    rows = []
    for label, path, style, is_error in METRICS:
        values = [_value(run.metrics, path) for run in runs]
        known = [value for value in values if isinstance(value, (int, float))]
        if all(value is None for value in values):
            continue
        best = min(known) if is_error and len(known) > 1 and min(known) < max(known) else None
        cells = "".join(
            f"<td{' class=best' if best is not None and value == best else ''}>{_text(value, style)}</td>"
            for value in values
        )
        rows.append(f"<tr><td>{label}</td>{cells}</tr>")
    return (
        f'<div class="wide"><table><thead><tr><th></th>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _value(metrics: dict[str, Any], path: str) -> Any:
    found: Any = metrics
    for key in path.split("."):
        found = found.get(key) if isinstance(found, dict) else None
    return found


def _text(value: Any, style: Callable[[Any], str]) -> str:
    return "–" if value is None else escape(style(value))


# Label, place in metrics.json, how it is written, whether less is better.
METRICS: tuple[tuple[str, str, Callable[[Any], str], bool], ...] = (
    ("noise model", "settings.noise_model", str, False),
    ("association", "settings.association", str, False),
    ("ATE [m]", "ate_m", "{:.3f}".format, True),
    ("ATE of each keyframe when it came [m]", "online_ate_m", "{:.3f}".format, True),
    ("ATE of odometry alone [m]", "odometry_ate_m", "{:.3f}".format, False),
    ("RPE [m]", "rpe_m", "{:.4f}".format, True),
    ("RPE of odometry alone [m]", "odometry_rpe_m", "{:.4f}".format, False),
    ("NEES of positions (3 is honest)", "nees_position", "{:.2f}".format, False),
    ("NEES of motions over 1 keyframe", "nees_motion.1", "{:.2f}".format, False),
    ("NEES of motions over 30 keyframes", "nees_motion.30", "{:.2f}".format, False),
    ("keyframes", "keyframes", str, False),
    ("objects", "objects", str, False),
    ("boxes used", "boxes_used", str, False),
    ("boxes rejected", "boxes_rejected", str, False),
    ("association: precision", "association.precision", "{:.1%}".format, False),
    ("association: recall", "association.recall", "{:.1%}".format, False),
    ("update, median [ms]", "update_ms.p50", "{:.1f}".format, True),
    ("update, 99 % [ms]", "update_ms.p99", "{:.1f}".format, True),
    ("update, longest [ms]", "update_ms.max", "{:.1f}".format, True),
    ("computing [s]", "wall_s", "{:.1f}".format, True),
    ("length of the recording [s]", "sequence_s", "{:.1f}".format, False),
    ("peak memory [MB]", "peak_rss_mb", "{:.0f}".format, False),
)
