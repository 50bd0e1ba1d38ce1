"""The folder of an experiment: its settings, the state of the code and of the files it is computed from, and a line for
each repetition that is done.

An interrupted experiment finds there what it need not do again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from calibslam_sim.experiments.design import ExperimentError, ExperimentSettings, Metrics

SETTINGS, REPETITIONS = "settings.json", "repetitions.jsonl"


@dataclass(frozen=True)
class Repetition:
    """A condition on one seed: its metrics (NaN: not defined), and the computing time [s]."""

    condition: str
    number: int
    metrics: Metrics
    seconds: float


class RunStore:
    """What is done of an experiment, in a folder."""

    def __init__(
        self,
        folder: Path,
        name: str,
        settings: ExperimentSettings,
        code: str,
        inputs: Mapping[str, str],
        overwrite: bool = False,
    ) -> None:
        """Begin in a new folder, or go on in one.

        Args:
            folder: of the experiment.
            name: of the experiment.
            settings: of the experiment.
            code: which state of the code is running, see `fingerprint`.
            inputs: hash of each file that is computed from, by its name.
            overwrite: begin anew.

        Raises:
            ExperimentError: the folder holds another experiment, other settings, or what other code or other files
                gave.
        """
        self._lines = folder / REPETITIONS
        self._done: dict[tuple[str, int], Repetition] = {}
        path = folder / SETTINGS
        header = {"experiment": name, "code": code, "settings": asdict(settings), "inputs": dict(inputs)}
        if overwrite:
            path.unlink(missing_ok=True)
            self._lines.unlink(missing_ok=True)
        if path.exists():
            _check(path, header)
            self._read()
            return
        folder.mkdir(parents=True, exist_ok=True)
        if self._lines.exists():
            raise ExperimentError(
                f"{self._lines} exists without {SETTINGS}: choose another --out, or begin anew with --overwrite"
            )
        path.write_text(json.dumps(header, indent=1) + "\n", encoding="utf-8")

    def missing(self, conditions: Iterable[str], repetitions: int) -> list[tuple[str, int]]:
        """What is still to be done, repetition by repetition: an interruption leaves complete pairs."""
        wanted = [(condition, k) for k in range(repetitions) for condition in conditions]
        return [key for key in wanted if key not in self._done]

    def add(self, repetition: Repetition) -> None:
        """Keep one, at once also on disk."""
        self._done[repetition.condition, repetition.number] = repetition
        metrics = {name: None if math.isnan(value) else value for name, value in repetition.metrics.items()}
        line = json.dumps({**asdict(repetition), "metrics": metrics}, allow_nan=False)
        with self._lines.open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def values(self, conditions: Iterable[str], repetitions: int) -> dict[str, dict[str, list[float]]]:
        """Condition -> metric -> value of each repetition, in order."""
        found: dict[str, dict[str, list[float]]] = {}
        for condition in conditions:
            metrics = [self._done[condition, k].metrics for k in range(repetitions)]
            found[condition] = {name: [each[name] for each in metrics] for name in metrics[0]}
        return found

    def seconds(self, conditions: Iterable[str], repetitions: int) -> float:
        """Computing time [s] of all of these together."""
        return sum(self._done[condition, k].seconds for condition in conditions for k in range(repetitions))

    def _read(self) -> None:
        if not self._lines.exists():
            return
        lines = self._lines.read_text(encoding="utf-8").split("\n")
        # What follows the last line break was cut off by a crash; it would garble the next line.
        if lines.pop():
            self._lines.write_text("".join(line + "\n" for line in lines), encoding="utf-8")
        for number, line in enumerate(lines, 1):
            try:
                content = json.loads(line)
                metrics = {name: math.nan if value is None else value for name, value in content["metrics"].items()}
                repetition = Repetition(content["condition"], content["number"], metrics, content["seconds"])
            except (ValueError, KeyError, TypeError) as error:
                raise ExperimentError(f"{self._lines}:{number}: not a repetition ({error}): delete this line") from None
            self._done[repetition.condition, repetition.number] = repetition


def _check(path: Path, wanted: dict[str, Any]) -> None:
    """Whether a file states this experiment with these settings, this code and these files.

    Raises:
        ExperimentError: naming what differs.
    """
    way_out = "choose another --out, or begin anew with --overwrite"
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
        name, code, settings = header["experiment"], header.get("code", "unknown"), dict(header["settings"])
        inputs = dict(header.get("inputs", {}))
    except (ValueError, KeyError, TypeError):
        raise ExperimentError(f"{path} is not of an experiment: {way_out}") from None
    if name != wanted["experiment"]:
        raise ExperimentError(f"{path.parent} holds the experiment {name}: {way_out}")
    now = wanted["settings"]
    differing = [
        f"{key} = {settings.get(key)!r} there, {now.get(key)!r} now"
        for key in sorted({*settings, *now})
        if settings.get(key) != now.get(key)
    ]
    if differing:
        raise ExperimentError(f"{path.parent} holds other settings ({'; '.join(differing)}): {way_out}")
    if code != wanted["code"]:
        raise ExperimentError(f"{path.parent} was made by other code ({code} there, {wanted['code']} now): {way_out}")
    changed = [name for name in sorted({*inputs, *wanted["inputs"]}) if inputs.get(name) != wanted["inputs"].get(name)]
    if changed:
        raise ExperimentError(
            f"{path.parent} was made of files that are others now, by their content ({', '.join(changed)}): {way_out}"
        )
