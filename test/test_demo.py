"""A short demo, from images: all its processes, its table and its files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from live import random_domain

from calibslam_sim import demo


def test_demo_makes_maps_of_boxes_and_of_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random_domain()))
    assert demo.main(["--out", str(tmp_path), "--duration", "6", "--rate", "2"]) == 0
    shown = capsys.readouterr().out
    for condition in demo.CONDITIONS:
        metrics = json.loads((tmp_path / condition.name / "metrics.json").read_text())
        assert metrics["keyframes"] >= 6 and metrics["objects"] >= 3
        assert all((tmp_path / condition.name / name).is_file() for name in demo.RESULTS)
        (row,) = (line for line in shown.splitlines() if line.startswith(condition.title))
        assert f"{metrics['ate_m']:.3f}" in row
        assert (metrics["recording"], metrics["topics"]["detections"]) == (
            str(tmp_path / "detected"), condition.detections
        )  # fmt: skip
    page = (tmp_path / "report.html").read_text()
    assert f"{tmp_path}/report.html" in shown and page.count("at the true objects") == len(demo.CONDITIONS)
    assert "not at hand" not in page and "data:image/jpeg" in page
    assert cv2.imread(str(tmp_path / "overlay.png")).shape == (480, 640, 3)
