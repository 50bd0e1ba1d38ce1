"""`results`: tables of experiments in a document."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from calibslam_sim import results
from calibslam_sim.experiments.registry import load
from calibslam_sim.experiments.statistics import paired, summary

VALUES = {"overconfident": [2.0, 4.0], "calibrated": [1.0, 2.0], "underconfident": [1.5, 2.0]}


def result() -> dict[str, Any]:
    return {
        "experiment": "toy",
        "settings": {},
        "repetitions": 2,
        "conditions": {name: {"ate_m": summary(values)} for name, values in VALUES.items()},
        "paired": {
            "calibrated_vs_overconfident": {"ate_m": paired(VALUES["calibrated"], VALUES["overconfident"])},
        },
        "nees_interval": {},
        "code": "0.1.0+3f2a90c1d4e5",
        "command": "./calibslam run calibslam_sim experiment toy --out results/toy",
        "seconds": 90.0,
    }


def test_tables_show_ours_and_the_documents_numbers() -> None:
    lines = results.block(result(), load("toy")).splitlines()
    ours = lines.index("| calibrated | 1.5 ± 0.71 |")
    assert lines[ours + 1] == "| *calibrated, the document* | 0.988 ± 0.36 |"
    # Differences -1 and -2: mean -1.5, t = -3 with one degree of freedom, p = 1 - 2 atan(3) / pi = 0.205.
    assert "| calibrated - overconfident | -1.5 (0.2) |" in lines
    assert "1.5 minutes of computing, code 0.1.0+3f2a90c1d4e5." in lines[-1]


def test_the_documents_numbers_stand_only_below_conditions_that_there_are() -> None:
    found = result()
    del found["conditions"]["calibrated"]
    lines = results.block(found, load("toy")).splitlines()
    assert [line.split(" | ")[0] for line in lines if ", the document" in line] == [
        "| *overconfident, the document*",
        "| *underconfident, the document*",
    ]


def test_fill_replaces_what_stands_between_the_marks() -> None:
    text = "a\n<!-- results toy -->\nold\n<!-- end toy -->\nb <!-- results kalman --><!-- end kalman -->\n"
    filled = results.fill(text, "toy", "new")
    assert filled.startswith("a\n<!-- results toy -->\n\nnew\n\n<!-- end toy -->\nb ")
    assert "old" not in filled
    assert results.fill(filled, "toy", "new") == filled
    with pytest.raises(results.ResultsError, match="<!-- results other -->"):
        results.fill(text, "other", "new")


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = tmp_path / "results.md"
    document.write_text("# Results\n<!-- results toy -->\n<!-- end toy -->\n")
    folder = tmp_path / "toy"
    folder.mkdir()
    assert results.main([str(folder), "--into", str(document)]) == 1
    assert "run the experiment first" in capsys.readouterr().err
    (folder / "result.json").write_text(json.dumps({**result(), "experiment": "nonsense"}))
    assert results.main([str(folder), "--into", str(document)]) == 1
    (folder / "result.json").write_text(json.dumps(result()))
    assert results.main([str(folder), "--into", str(document)]) == 0
    assert "| calibrated | 1.5 ± 0.71 |" in document.read_text()
