"""The detector that comes with the package: small, safe to load, whole, and described."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import setuptools
import torch

from calibslam_detector.model import weights_file
from calibslam_detector.model.detector import Detector, DetectorSettings
from calibslam_msgs_py.conversions import valid_boxes

MOST_BYTES = 25e6
SETUP = Path(__file__).resolve().parents[1] / "setup.py"


def test_file_is_small_half_precision_and_plain_data() -> None:
    assert weights_file.SHIPPED.stat().st_size < MOST_BYTES
    content = torch.load(weights_file.SHIPPED, weights_only=True)
    assert content["architecture"] == "compact" and content["boxes"] == "amodal_bbox"
    kinds = {value.dtype for value in content["weights"].values()}
    assert kinds == {torch.float16, torch.int64}  # int64: counts of batches


def test_it_is_what_loads_by_default() -> None:
    model = weights_file.load()
    assert not model.training and len(model.class_names) == 10
    # Both stages of training are in it: a head at its beginning says the same of every box.
    assert model.covariance_head.output.weight.abs().max() > 0.0
    assert model.familiarity.whitening.abs().max() > 0.0


def test_the_head_to_compare_with_is_of_the_same_detector(tmp_path: Path) -> None:
    assert weights_file.SHIPPED_NLL_HEAD.stat().st_size < 0.2e6
    f_cal, nll = weights_file.load(), weights_file.load(weights_file.SHIPPED_NLL_HEAD)
    differs = {name for name, w in f_cal.state_dict().items() if not torch.equal(w, nll.state_dict()[name])}
    assert differs == {f"covariance_head.{name}" for name, _ in nll.covariance_head.named_parameters()}
    weights_file.save_head(nll, tmp_path / "again.pt")
    again = weights_file.load(tmp_path / "again.pt").covariance_head.state_dict()
    assert all(torch.equal(w, again[name]) for name, w in nll.covariance_head.state_dict().items())


def test_a_head_of_another_detector_is_refused(tmp_path: Path) -> None:
    content = torch.load(weights_file.SHIPPED_NLL_HEAD, weights_only=True)
    torch.save({**content, "detector": "0" * 64}, tmp_path / "other.pt")
    with pytest.raises(weights_file.WeightsError, match="is a covariance head of another release's detector"):
        weights_file.load(tmp_path / "other.pt")
    torch.save({**content, "weights": {"summary": torch.zeros(2)}}, tmp_path / "torn.pt")
    with pytest.raises(weights_file.WeightsError, match="does not fit the covariance head"):
        weights_file.load(tmp_path / "torn.pt")
    model = weights_file.load()
    with torch.no_grad():
        next(model.detector.parameters()).add_(1.0)
    with pytest.raises(ValueError, match="only heads of the shipped detector"):
        weights_file.save_head(model, tmp_path / "head.pt")


def test_noise_is_unlike_what_it_knows() -> None:
    image = np.random.default_rng(1).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    detector = Detector.from_file(weights_file.SHIPPED, DetectorSettings(score_threshold=0.05, device="cpu"))
    boxes, strangeness = detector(image)
    assert strangeness > 1.5
    assert len(valid_boxes(boxes)[0]) == len(boxes)  # whatever it sees, its covariances can be used


def test_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", given.update)
    monkeypatch.chdir(SETUP.parent)
    exec(compile(SETUP.read_text(), str(SETUP), "exec"), {})
    patterns = given["package_data"]["calibslam_detector"]
    package = SETUP.parent / "calibslam_detector"
    installed = {file.relative_to(package) for pattern in patterns for file in package.glob(pattern)}
    wanted = {"compact.pt", "compact_nll_head.pt", "MODEL_CARD.md"}
    assert {Path("default_weights") / name for name in wanted} <= installed


def test_model_card_tells_what_one_must_know() -> None:
    card = weights_file.SHIPPED.with_name("MODEL_CARD.md").read_text(encoding="utf-8")
    for heading in ("What it is", "How it was made", "What was measured", "Limits"):
        assert re.search(rf"^## {heading}$", card, re.MULTILINE), heading
    names = weights_file.load().class_names
    assert all(name in card for name in names)
    commands = ("render_dataset", "train train", "--stage covariance", "evaluate_detector")
    assert all(command in card for command in commands)
