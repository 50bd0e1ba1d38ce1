"""How figures look: what differs in colour differs in dashes or markers too."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go

from calibslam_msgs_py.measurements import Array

SIGMAS = 2.0  # that ellipses and bands show
MARGIN = 0.4  # [m] around what is shown
REACH = 4.0  # [m] from the camera's path, within which objects are
# Okabe and Ito's colours, which most colour-blind people can tell apart.
BLUE, RED, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
BLACK, GREY = "#222222", "#8a8a8a"
COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY)
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
MARKERS = ("circle", "square", "diamond", "cross", "x", "triangle-up")

ESTIMATE: dict[str, Any] = {"color": BLUE, "dash": "solid", "width": 2}
ODOMETRY: dict[str, Any] = {"color": RED, "dash": "dot", "width": 2}
TRUTH: dict[str, Any] = {"color": GREY, "dash": "solid", "width": 5}


def line_of(n: int) -> dict[str, Any]:
    """Line of the n-th run."""
    return {"color": COLOURS[n % len(COLOURS)], "dash": DASHES[n % len(DASHES)], "width": 2}


def marker_of(n: int, size: int = 8) -> dict[str, Any]:
    """Marker of the n-th run."""
    return {"color": COLOURS[n % len(COLOURS)], "symbol": MARKERS[n % len(MARKERS)], "size": size}


def new_figure(x: str = "", y: str = "", height: int = 420) -> go.Figure:
    """An empty one with these titles of its axes."""
    figure = go.Figure()
    figure.update_layout(
        template="plotly_white",
        height=height,
        margin={"l": 70, "r": 45, "t": 30, "b": 55},
        modebar={"orientation": "v", "remove": ["sendChartToCloud", "select2d", "lasso2d"]},
        font={"family": "system-ui, sans-serif", "size": 13, "color": BLACK},
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.0, "x": 0.0},
        hoverlabel={"namelength": -1},
    )
    figure.update_xaxes(title=x, showline=True, linecolor=GREY, ticks="outside")
    figure.update_yaxes(title=y, showline=True, linecolor=GREY, ticks="outside")
    return figure


def decades(figure: go.Figure, axis: str) -> None:
    """A logarithmic axis ("x" or "y") with numbers at 1, 2 and 5 times the powers of ten."""
    places = [digit * 10.0**power for power in range(-4, 7) for digit in (1, 2, 5)]
    ticks = {"tickvals": places, "ticktext": [f"{place:g}" for place in places]}
    figure.update_layout({f"{axis}axis": {"type": "log", **ticks}})


def translucent(colour: str, alpha: float) -> str:
    """A colour "#rrggbb" that lets through."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha:g})"


def rounded(values: Array, digits: int = 4) -> Array:
    """Numbers as small as a picture needs them."""
    return np.asarray(np.round(np.asarray(values, float), digits), np.float32)


def limits(positions: Array, others: Array) -> tuple[Array, Array]:
    """Corners (3,) of the box around positions (N, 3) and those of M others that are near: an object whose place is
    hardly known must not shrink everything else to a dot.
    """
    near = [other for other in others if np.linalg.norm(positions - other, axis=1).min() < REACH]
    everything = np.concatenate([positions, *([np.array(near)] if near else [])])
    return everything.min(axis=0) - MARGIN, everything.max(axis=0) + MARGIN


def broken(lines: list[Array]) -> Array:
    """Lines (n, d) as one that is interrupted between them: (N, d) with rows of NaN."""
    if not lines:
        return np.empty((0, 3))
    gap = np.full((1, lines[0].shape[1]), np.nan)
    return np.concatenate([part for line in lines for part in (line, gap)])


def ellipse(centre: Array, shape: Array, points: int = 33) -> Array:
    """Outline (points, 2) of the set (p - centre)^T shape^-1 (p - centre) <= 1, for a (2, 2) shape."""
    values, vectors = np.linalg.eigh(shape)
    angles = np.linspace(0.0, 2.0 * np.pi, points)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    return np.asarray(centre + (vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)).T)
