"""Figures of experiments, readable without colour: markers and line styles tell conditions apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from calibslam_sim.experiments.design import Metric
from calibslam_sim.experiments.statistics import defined, half_interval

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

STYLES = ("o-", "s--", "^:", "D-.")
COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:purple")


@dataclass(frozen=True)
class Curve:
    """A line over factors on a standard deviation.

    Attributes:
        title: of the line.
        conditions: factor -> condition.
        level: a condition without factor to compare with, drawn as a horizontal line; "" for none.
        level_title: of that line.
    """

    title: str
    conditions: Mapping[float, str]
    level: str = ""
    level_title: str = ""


def scale_figure(
    path: Path,
    title: str,
    result: dict[str, Any],
    metrics: Mapping[str, Metric],
    curves: Sequence[Curve],
    degrees_of_freedom: Mapping[str, int],
) -> None:
    """A panel for each metric: means over the factor, with 95 % intervals of the mean."""
    columns = min(len(metrics), 2)
    rows = -(-len(metrics) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(6.2 * columns, 4.4 * rows), squeeze=False, dpi=110)
    for i, (metric, named) in enumerate(metrics.items()):
        panel = axes.flat[i]
        for curve, style, colour in zip(curves, STYLES, COLOURS, strict=False):
            _curve(panel, result, metric, curve, style, colour)
        if metric in degrees_of_freedom:
            low, high = result["nees_interval"][metric]
            panel.axhspan(low, high, color="0.75", label="honest (95 %)", zorder=0)
        panel.set_xscale("log", base=2)
        panel.set_yscale("log")
        factors = sorted({factor for curve in curves for factor in curve.conditions})
        panel.xaxis.set_major_locator(FixedLocator(factors))
        panel.xaxis.set_minor_locator(NullLocator())
        panel.set_xticklabels([f"{factor:g}" if factor >= 1 else f"1/{1 / factor:g}" for factor in factors])
        panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.yaxis.set_minor_locator(NullLocator())
        panel.set(xlabel="believed over true standard deviation", ylabel=named.label)
        panel.grid(alpha=0.3)
        panel.legend(fontsize=8)
    for panel in axes.flat[len(metrics) :]:
        panel.set_axis_off()
    figure.suptitle(f"{title}\n{result['repetitions']} repetitions; bars: 95 % intervals of the mean", fontsize=11)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def _curve(panel: Axes, result: dict[str, Any], metric: str, curve: Curve, style: str, colour: str) -> None:
    found = [result["conditions"][condition][metric] for condition in curve.conditions.values()]
    bars = [half_interval(each["values"]) for each in found]
    panel.errorbar(
        list(curve.conditions), [each["mean"] for each in found], bars, fmt=style, color=colour, capsize=3,
        label=curve.title,
    )  # fmt: skip
    if curve.level:
        level = result["conditions"][curve.level][metric]["mean"]
        panel.axhline(level, color=colour, linestyle=style[1:], linewidth=1.0, label=curve.level_title)


@matplotlib.rc_context({"text.parse_math": False})  # names are texts, whatever signs they hold
def condition_figure(
    path: Path, title: str, result: dict[str, Any], metrics: Mapping[str, Metric], conditions: Sequence[str]
) -> None:
    """A panel for each metric: every repetition as a dash, the mean and its 95 % interval beside.

    Panels reach as far as repetitions do: where these are nearly the same, an interval can be much wider.
    """
    columns = min(len(metrics), 3)
    rows = -(-len(metrics) // columns)
    height = 1.4 + 0.42 * len(conditions)
    figure, axes = plt.subplots(rows, columns, figsize=(4.6 * columns, height * rows), squeeze=False, dpi=110)
    places = np.arange(len(conditions))[::-1]
    for i, (metric, named) in enumerate(metrics.items()):
        panel, every = axes.flat[i], np.zeros(0)
        for place, condition in zip(places, conditions, strict=True):
            found = result["conditions"][condition][metric]
            values = defined(found["values"])
            every = np.append(every, values)
            panel.plot(values, np.full(len(values), place + 0.15), "|", color="0.5", markersize=7)
            if len(values):
                half = half_interval(values, result.get("left_out", {}).get(condition, 0.0))
                panel.errorbar(found["mean"], place - 0.1, xerr=half, fmt="o", color="black", capsize=4)
        if len(every) and np.ptp(every) > 0.0:
            panel.set_xlim(every.min() - 0.05 * np.ptp(every), every.max() + 0.05 * np.ptp(every))
        panel.set_yticks(places, conditions if i % columns == 0 else [""] * len(conditions))
        panel.set_ylim(-0.6, len(conditions) - 0.4)
        panel.xaxis.set_major_locator(MaxNLocator(5))
        panel.set_xlabel(named.label)
        panel.grid(alpha=0.3)
    for panel in axes.flat[len(metrics) :]:
        panel.set_axis_off()
    figure.suptitle(
        f"{title}\n{result['repetitions']} repetitions (|); mean and its 95 % interval (•), cut where panels end",
        fontsize=11,
    )
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
