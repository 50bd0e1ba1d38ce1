"""Rows of the benchmark: a measured value beside what must and what should be reached; as text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Row:
    """One measure.

    Attributes:
        measure: what it is.
        value: measured; None: not measured, `note` says why.
        must, aim: largest value allowed and wished (smallest where `higher_is_better`); None: no such target.
        unit: of all three.
        higher_is_better: for shares.
        note: what belongs to the value.
    """

    measure: str
    value: float | None
    must: float | None = None
    aim: float | None = None
    unit: str = ""
    higher_is_better: bool = False
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """How many times worse than `must`: at most 1 if it is reached."""
        if self.value is None or self.must is None:
            return None
        if self.higher_is_better:
            return self.must / self.value if self.value else math.inf
        return self.value / self.must

    def reaches(self, target: float | None) -> bool | None:
        """Whether a target is reached; None where there is none, or no value."""
        if self.value is None or target is None:
            return None
        return self.value >= target if self.higher_is_better else self.value <= target


@dataclass(frozen=True)
class Within:
    """A measure that must lie inside an interval, or outside of it.

    Attributes:
        measure, value, note: as in `Row`.
        low, high: the interval.
        inside: whether the value must lie in it.
    """

    measure: str
    value: float
    low: float
    high: float
    inside: bool = True
    note: str = ""

    @property
    def is_reached(self) -> bool:
        return (self.low <= self.value <= self.high) == self.inside


AnyRow = Row | Within


def as_json(rows: Sequence[AnyRow]) -> list[dict[str, Any]]:
    """All there is, and whether targets are reached."""
    result = []
    for row in rows:
        if isinstance(row, Row):
            reached = {"ratio": row.ratio, "reaches_must": row.reaches(row.must), "reaches_aim": row.reaches(row.aim)}
        else:
            reached = {"reaches_must": row.is_reached}
        result.append({**asdict(row), **reached})
    return result


def as_text(rows: Sequence[AnyRow]) -> str:
    """One table."""
    lines = [("measure", "value", "must", "aim", "value/must", "reached", "")]
    lines += [_row(row) if isinstance(row, Row) else _within(row) for row in rows]
    widths = [max(len(line[i]) for line in lines) for i in range(6)]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *(line[i].rjust(widths[i]) for i in range(1, 6)), line[6]]).rstrip()
        for line in lines
    )


def _row(row: Row) -> tuple[str, ...]:
    reached = {None: "", True: "must", False: "no"}[row.reaches(row.must)]
    if row.reaches(row.aim):
        reached = "aim"
    measure = f"{row.measure} [{row.unit}]" if row.unit else row.measure
    ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
    return measure, _number(row.value), _number(row.must), _number(row.aim), ratio, reached, row.note


def _within(row: Within) -> tuple[str, ...]:
    interval = f"{'in' if row.inside else 'not in'} {row.low:.2f}..{row.high:.2f}"
    return row.measure, _number(row.value), interval, "", "", "must" if row.is_reached else "no", row.note


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2g}" if abs(value) < 0.1 else f"{value:.3g}"
