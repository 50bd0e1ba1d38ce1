"""`results DIR... --into FILE`: writes tables of experiments into a document, each between the marks of its folder.

A folder results/toy fills what stands between `<!-- results toy -->` and `<!-- end toy -->`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_sim.experiments.design import Experiment
from calibslam_sim.experiments.outputs import mean_and_deviation, rows_of_conditions, rows_of_pairs
from calibslam_sim.experiments.registry import MODULES, load


class ResultsError(ValueError):
    """A result or a document that cannot be used; the text says why."""


def read_result(folder: Path) -> dict[str, Any]:
    """The result.json of a folder.

    Raises:
        ResultsError: there is none, or it is not of an experiment.
    """
    path = folder / "result.json"
    try:
        result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ResultsError(f"{path}: {error.strerror}: run the experiment first") from error
    except ValueError as error:
        raise ResultsError(f"{path}: not JSON: {error}") from error
    if result.get("experiment") not in MODULES:
        raise ResultsError(f"{path}: not of an experiment of these: {', '.join(sorted(MODULES))}")
    return result


def block(result: dict[str, Any], experiment: Experiment) -> str:
    """The tables of a result as Markdown, the document's numbers below ours."""
    metrics = experiment.metrics
    rows = rows_of_conditions(result, metrics)
    shown = [metric for metric in metrics if metric in next(iter(result["conditions"].values()))]
    for condition, theirs in experiment.document(result["settings"]).items():
        cells = [mean_and_deviation(*theirs[metric]) if metric in theirs else "" for metric in shown]
        names = [row[0] for row in rows]
        if condition in names:  # not where boxes are those of another detector, without identities
            rows.insert(names.index(condition) + 1, [f"*{condition}, the document*", *cells])
    parts = [f"```bash\n{result['command']}\n```", _markdown(rows)]
    tests = rows_of_pairs(result, metrics)
    if len(tests) > 1:
        shared = result.get("left_out")
        note = "; where repetitions share most of their images, with their variance corrected for it" if shared else ""
        parts.append(f"Paired differences (negative: the first is better) with p of the paired t-test{note}:")
        parts.append(_markdown(tests))
    notes = [
        f"{metrics[metric].title}: {low:.3g} to {high:.3g} (95 %) if the covariances are right."
        for metric, (low, high) in result["nees_interval"].items()
    ]
    if "filter_graph_max_difference" in result:
        notes.append(f"Largest difference between filter and graph: {result['filter_graph_max_difference']:.1e}.")
    code = f", code {result['code']}" if "code" in result else ""
    notes.append(f"{result['seconds'] / 60.0:.1f} minutes of computing{code}.")
    return "\n\n".join([*parts, " ".join(notes)])


def fill(text: str, name: str, content: str) -> str:
    """The text with this content between the marks of `name`.

    Raises:
        ResultsError: the text lacks these marks.
    """
    begin, end = f"<!-- results {name} -->", f"<!-- end {name} -->"
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise ResultsError(f"no lines '{begin}' and '{end}': put them where the tables of {name} belong")
    return f"{before}{begin}\n\n{content}\n\n{end}{after}"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `results`; returns the exit code."""
    parser = ArgumentParser(prog="results", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="folders that `experiment` wrote")
    parser.add_argument("--into", type=Path, required=True, metavar="FILE", help="Markdown document with marks")
    arguments = parser.parse_args(argv)
    try:
        text = arguments.into.read_text(encoding="utf-8")
        for folder in arguments.folders:
            result = read_result(folder)
            text = fill(text, folder.resolve().name, block(result, load(result["experiment"])))
    except ResultsError as error:
        print(f"results: {error}", file=sys.stderr)
        return 1
    arguments.into.write_text(text, encoding="utf-8")
    print(f"{arguments.into}: {', '.join(folder.resolve().name for folder in arguments.folders)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
