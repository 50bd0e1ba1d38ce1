"""The benchmark's table by hand, and what it says of recordings that are not there."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import pytest
from benchmark_table import Row, Within, as_json, as_text

BENCHMARK = Path(__file__).parent / "benchmarks" / "run.py"


def test_ratios_by_hand() -> None:
    """Value over must; where more is better, must over value: above 1 is always worse than demanded."""
    slow = Row("update", 66.0, 33.0, 10.0, "ms")
    assert slow.ratio == 2.0 and slow.reaches(slow.must) is False
    recall = Row("recall", 0.96, 0.9, 0.95, higher_is_better=True)
    assert recall.ratio == pytest.approx(0.9375) and recall.reaches(recall.must) and recall.reaches(recall.aim)
    assert Row("nothing", None, 1.0).ratio is None and Row("nothing", None, 1.0).reaches(1.0) is None
    assert Row("no target", 3.0).ratio is None and Row("no target", 3.0).reaches(None) is None


@pytest.mark.parametrize(("value", "inside"), [(2.9, True), (5.0, False), (1.0, False)])
def test_intervals_by_hand(value: float, inside: bool) -> None:
    assert Within("NEES", value, 2.4, 3.7).is_reached == inside
    assert Within("NEES", value, 2.4, 3.7, inside=False).is_reached != inside


def test_the_table_says_what_is_reached() -> None:
    rows = [
        Row("a", 0.04, 0.1, 0.05, "m", note="so far"),
        Row("b", 0.07, 0.1, 0.05),
        Row("c", 0.2, 0.1, 0.05),
        Row("d", None, note="left out: why"),
        Within("e", 3.0, 2.0, 4.0),
    ]
    lines = as_text(rows).splitlines()[1:]
    assert [line.split()[-1] for line in lines[1:3] + lines[4:]] == ["must", "no", "must"]
    assert lines[0].startswith("a [m]") and lines[0].endswith("0.40      aim  so far")
    assert lines[3].endswith("left out: why") and "in 2.00..4.00" in lines[4]
    assert [row["reaches_must"] for row in json.loads(json.dumps(as_json(rows)))] == [True, True, False, None, True]


def test_missing_recordings_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "table.json"
    monkeypatch.setattr(
        sys, "argv", ["run.py", "--data", str(tmp_path), "--out", str(out), "--only", "fr3_office", "solver"]
    )
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(BENCHMARK), run_name="__main__")
    assert ended.value.code == 0
    table = json.loads(out.read_text())
    assert [row["note"] for row in table["rows"]] == [
        "left out: fr3_office lacks odometry.txt, detections.csv, groundtruth.txt"
    ] * 2
    assert "left out" in capsys.readouterr().out
