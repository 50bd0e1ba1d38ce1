"""The `image` experiment: one detector, several covariance heads, and the pipeline from rendered images to a map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from calibslam_detector.model import weights_file
from calibslam_detector.model.detector import Detector, DetectorSettings
from calibslam_detector.model.network import CalibratedDetector
from calibslam_detector.model.weights_file import SHIPPED, SHIPPED_NLL_HEAD
from calibslam_sim import experiment
from calibslam_sim.experiments import engine, image
from calibslam_sim.experiments.covariance_heads import CovarianceHeads
from calibslam_sim.experiments.design import ExperimentError

CLASSES = ("cup", "book")


def a_detector(path: Path, detector_seed: int, head_seed: int) -> Path:
    """An untrained one that is sure of many cups."""
    torch.manual_seed(detector_seed)
    model = CalibratedDetector("compact", CLASSES)
    with torch.no_grad():
        model.detector.roi_heads.box_predictor.cls_score.bias[1] = 5.0
        torch.manual_seed(head_seed)
        model.covariance_head.output.weight.normal_(std=0.1)
        model.familiarity.mean.normal_()  # heads learn from different images
    weights_file.save(model, path)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("weights")
    return {
        "calibrated": a_detector(folder / "a.pt", 1, 2),
        "nll": a_detector(folder / "b.pt", 1, 3),
        "another": a_detector(folder / "c.pt", 4, 2),
    }


def test_boxes_are_shared_and_covariances_are_those_of_each_file(files: dict[str, Path]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    both = {name: files[name] for name in ("calibrated", "nll")}
    found = CovarianceHeads(both)(pixels, 7)
    assert len(found["nll"]) > 3 and found["nll"].class_ids[0] == "cup" and found["nll"].stamp == 7
    assert not np.allclose(found["nll"].covariances, found["calibrated"].covariances, rtol=0.01)
    for name, path in both.items():
        alone, _ = Detector.from_file(path, DetectorSettings(device="cpu"))(pixels, 7)
        np.testing.assert_array_equal(found[name].corners, found["calibrated"].corners)
        np.testing.assert_allclose(found[name].corners, alone.corners, rtol=1e-5)
        np.testing.assert_allclose(found[name].covariances, alone.covariances, rtol=1e-4)
        np.testing.assert_allclose(found[name].scores, alone.scores, rtol=1e-5)
        assert found[name].class_ids == alone.class_ids


def test_another_detector_is_refused(files: dict[str, Path]) -> None:
    with pytest.raises(ExperimentError, match="finds other boxes than"):
        CovarianceHeads({name: files[name] for name in ("calibrated", "another")})


def test_what_is_wrong_with_the_weights_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["image", "--quick", "--out", str(tmp_path / "out"), "--nll-weights", str(tmp_path / "none.pt")]
    assert experiment.main(out) == 1
    assert "none.pt cannot be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_shipped_detector_needs_no_option() -> None:
    assert image.conditions(image.ImageSettings()) == list(image.NOISE)


def test_without_a_second_detector_there_is_no_condition_for_it(files: dict[str, Path]) -> None:
    alone = image.ImageSettings(weights=str(files["calibrated"]))
    assert image.conditions(alone) == ["calibrated", "fixed", "quadricslam"]
    both = image.ImageSettings(weights=str(files["calibrated"]), nll_weights=str(files["nll"]))
    assert image.comparisons(both) == [("calibrated", name) for name in ("nll", "fixed", "quadricslam")]


def test_the_files_it_is_computed_from_are_known(files: dict[str, Path]) -> None:
    """The shipped ones, too."""
    assert set(image.EXPERIMENT.inputs(image.ImageSettings()).values()) == {SHIPPED, SHIPPED_NLL_HEAD}
    one = image.ImageSettings(nll_weights=str(files["nll"]))
    assert image.EXPERIMENT.inputs(one) == {"weights of calibrated": SHIPPED, "weights of nll": files["nll"]}


def test_the_command(files: dict[str, Path], tmp_path: Path) -> None:
    options = ["--weights", str(files["calibrated"]), "--nll-weights", str(files["nll"]), "--seeds", "1"]
    small = ["--duration", "1.5", "--image-every", "15", "--jobs", "1"]
    assert experiment.main(["image", "--quick", "--out", str(tmp_path), *options, *small]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert list(result["conditions"]) == list(image.NOISE)
    assert "calibrated_vs_nll" in result["paired"]
    assert all(found["ate_m"]["mean"] < 1.0 for found in result["conditions"].values())


def test_conditions_of_a_repetition_stay_together() -> None:
    wanted = [("a", 0), ("b", 0), ("b", 1), ("a", 2), ("b", 2)]
    assert engine.groups(wanted, True) == [[("a", 0), ("b", 0)], [("b", 1)], [("a", 2), ("b", 2)]]
    assert engine.groups(wanted, False) == [[each] for each in wanted]
