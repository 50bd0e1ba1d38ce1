"""What an experiment leaves: result.json, result.csv, and a table for a person."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_sim.experiments.design import Experiment, ExperimentSettings, Metric
from calibslam_sim.experiments.statistics import defined, nees_interval, paired, summary

Values = Mapping[str, Mapping[str, Sequence[float]]]


def result_of(
    name: str,
    experiment: Experiment,
    settings: ExperimentSettings,
    values: Values,
    code: str,
    command: str,
    seconds: float,
) -> dict[str, Any]:
    """The content of result.json.

    Args:
        name: of the experiment.
        experiment: it.
        settings: that were used.
        values: condition -> metric -> value of each repetition.
        code: state of the code that made it.
        command: that made it.
        seconds: of computing, all repetitions together.
    """
    first = next(iter(values.values()))
    repetitions = len(next(iter(first.values())))
    left_out = {condition: experiment.left_out(settings, condition) for condition in values}

    def number(metric: str) -> int:
        """Of repetitions in which the metric is defined, in the condition that has fewest."""
        return min(len(defined(metrics[metric])) for metrics in values.values())

    return {
        "experiment": name,
        "title": experiment.title,
        "settings": asdict(settings),
        "repetitions": repetitions,
        "conditions": {
            condition: {metric: summary(numbers) for metric, numbers in metrics.items()}
            for condition, metrics in values.items()
        },
        "paired": {
            f"{a}_vs_{b}": {metric: paired(values[a][metric], values[b][metric], left_out[a]) for metric in values[a]}
            for a, b in experiment.comparisons(settings)
        },
        "nees_interval": {
            metric: list(nees_interval(freedom, number(metric)))
            for metric, freedom in experiment.degrees_of_freedom.items()
            if number(metric)
        },
        "left_out": {condition: share for condition, share in left_out.items() if share},
        **experiment.further(values),
        "code": code,
        "command": command,
        "seconds": seconds,
    }


def write(result: dict[str, Any], folder: Path) -> None:
    """result.json and result.csv (a row for each repetition of each condition)."""
    text = json.dumps(result, indent=1, allow_nan=False)
    (folder / "result.json").write_text(text + "\n", encoding="utf-8")
    conditions = result["conditions"]
    metrics = list(next(iter(conditions.values())))
    with (folder / "result.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["condition", "repetition", *metrics])
        for condition, found in conditions.items():
            columns = [found[metric]["values"] for metric in metrics]
            for number, row in enumerate(zip(*columns, strict=True)):
                writer.writerow([condition, number, *("" if value is None else repr(value) for value in row)])


def table(result: dict[str, Any], metrics: Mapping[str, Metric]) -> str:
    """Mean and deviation of each condition, then the paired differences, for a person."""
    lines = rows_of_conditions(result, metrics)
    tests = rows_of_pairs(result, metrics)
    blocks = [_aligned(lines), _aligned(tests)] if len(tests) > 1 else [_aligned(lines)]
    for metric, (low, high) in result["nees_interval"].items():
        blocks.append(f"{metrics[metric].label}: {low:.3g} to {high:.3g} (95 %) if the covariances are right")
    return "\n\n".join(blocks)


def rows_of_conditions(result: dict[str, Any], metrics: Mapping[str, Metric]) -> list[list[str]]:
    """A head and a row for each condition."""
    shown = [metric for metric in metrics if metric in next(iter(result["conditions"].values()))]
    rows = [[f"{result['repetitions']} repetitions", *(metrics[metric].label for metric in shown)]]
    for condition, found in result["conditions"].items():
        rows.append([condition, *(mean_and_deviation(found[m]["mean"], found[m]["std"]) for m in shown)])
    return rows


def rows_of_pairs(result: dict[str, Any], metrics: Mapping[str, Metric]) -> list[list[str]]:
    """A head and a row for each tested pair, of metrics of which less is better."""
    first = next(iter(result["conditions"].values()))
    shown = [metric for metric in metrics if metric in first and metrics[metric].is_error]
    rows = [["difference (p)", *(metrics[metric].label for metric in shown)]]
    for pair, found in result["paired"].items():
        rows.append([pair.replace("_vs_", " - "), *(_difference(found[metric]) for metric in shown)])
    return rows


def mean_and_deviation(mean: float | None, std: float | None) -> str:
    """E.g. "0.988 ± 0.36"; "-" where there is none."""
    if mean is None:
        return "-"
    return significant(mean, 3) if std is None else f"{significant(mean, 3)} ± {significant(std, 2)}"


def significant(value: float, digits: int) -> str:
    """So many digits that count; with an exponent only where many zeros would precede them."""
    if abs(value) < 1e-3:
        return f"{value:.{digits}g}"
    return str(np.format_float_positional(value, precision=digits, unique=False, fractional=False, trim="-"))


def _difference(found: dict[str, float | None]) -> str:
    mean, p = found["mean_difference"], found["p_value"]
    if mean is None or p is None:
        return "-"
    return f"{'+' if mean > 0.0 else ''}{significant(mean, 2)} ({p_value(p)})"


def p_value(p: float) -> str:
    """Two digits; below 1e-4 its order of magnitude, which means nothing below 1e-16."""
    if p < 1e-16:
        return "<1e-16"
    return f"{p:.2g}" if p >= 1e-4 else f"{p:.0e}"


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    )
