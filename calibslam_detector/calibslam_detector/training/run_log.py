"""What a training tells: losses in a file, and how far it is."""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

from tqdm import tqdm

SECONDS_BETWEEN_LINES = 30.0  # where there is no terminal to show a bar on


class Log:
    """Losses by step in a CSV file; what comes after the step of a resumed checkpoint is dropped."""

    def __init__(self, path: Path, first: int) -> None:
        self.path = path
        self._names: list[str] = []
        self._rows: list[dict[str, str]] = []
        if first and path.exists():
            with path.open(newline="") as file:
                self._rows = [row for row in csv.DictReader(file) if int(row["step"]) < first]
        self._names = list(self._rows[0]) if self._rows else []
        self._begun_at = float(self._rows[-1]["seconds"]) if self._rows else 0.0
        if self._names:
            self._write("w", self._rows)
        else:
            path.unlink(missing_ok=True)

    def add(self, step: int, seconds: float, rate: float, losses: dict[str, float]) -> None:
        """A line; `seconds` since this process began."""
        row = {"step": str(step), "seconds": f"{self._begun_at + seconds:.1f}", "learning_rate": f"{rate:.6g}"}
        row.update({name: f"{value:.6g}" for name, value in losses.items()})
        if not self._names:
            self._names = list(row)
            self._write("w", [row])
        else:
            self._write("a", [row])

    def _write(self, mode: str, rows: list[dict[str, str]]) -> None:
        with self.path.open(mode, newline="") as file:
            writer = csv.DictWriter(file, self._names)
            if mode == "w":
                writer.writeheader()
            writer.writerows(rows)


class Teller:
    """How far it is: a bar on a terminal, a line now and then elsewhere; a context manager."""

    def __init__(self, first: int, steps: int, is_shown: bool) -> None:
        self._first, self._steps = first, steps
        self._began = self._told = time.monotonic()
        self._bar = tqdm(total=steps, initial=first, unit="step", disable=None if is_shown else True)
        self._has_lines = is_shown and self._bar.disable

    def __enter__(self) -> Teller:
        return self

    def __exit__(self, *reason: object) -> None:
        self._bar.close()

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self._began

    def loss(self, step: int, loss: float) -> None:
        """The loss of a step."""
        self._bar.set_postfix(loss=f"{loss:.4g}")
        now = time.monotonic()
        if self._has_lines and now - self._told >= SECONDS_BETWEEN_LINES:
            self._told = now
            left = self.seconds / (step + 1 - self._first) * (self._steps - step - 1)
            line = f"step {step + 1} of {self._steps}: loss {loss:.4g}, {left / 60.0:.1f} min left"
            print(line, file=sys.stderr, flush=True)

    def step(self, in_vain: int) -> None:
        """One more is done; so many in a row have taught nothing."""
        if in_vain:
            self._bar.set_postfix_str(f"{in_vain} steps that taught nothing")
        self._bar.update()
