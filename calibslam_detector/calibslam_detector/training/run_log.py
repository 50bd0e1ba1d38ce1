"""Losses of a training in a file."""

from __future__ import annotations

import csv
from pathlib import Path


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
