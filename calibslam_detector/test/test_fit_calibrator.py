"""The calibrator that is fitted: known features, known errors found again, honest judgement, clear errors."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from small_bag import messages, write

from calibslam_detector.fit_calibrator import LARGEST, Edges, calibrator, fit, held_out, judge, main
from calibslam_detector.foreign_boxes.calibrator import CalibratorError, load
from calibslam_detector.foreign_boxes.edge_mixture import EdgeMixture, fit_mixture
from calibslam_detector.foreign_boxes.features import FEATURES, edge_features
from calibslam_detector.foreign_boxes.log_linear import LogLinearCalibrator
from calibslam_msgs_py.measurements import Array, Boxes


def boxes_of(corners: Array, scores: Array | None = None) -> Boxes:
    n = len(corners)
    return Boxes(
        stamp=7,
        width=640,
        height=480,
        corners=np.reshape(np.asarray(corners, float), (-1, 4)),
        covariances=np.full((n, 4, 4), np.nan),
        class_ids=("cup",) * n,
        scores=np.full(n, 0.9) if scores is None else scores,
        object_ids=("",) * n,
    )


@dataclass(frozen=True)
class Image:
    boxes: Boxes
    errors: Array
    objects: Array


# Errors of 4 px where all features are zero, growing with the root of the extent, and less for high scores.
LAW = LogLinearCalibrator(intercept=np.log(4.0), extent=0.5, score=-1.0)


def images(seed: int, n: int = 800, gross: float = 0.1) -> list[Image]:
    """Two boxes each; a share of the edges is grossly wrong."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(n):
        low = rng.uniform(10.0, 150.0, (2, 2))
        boxes = boxes_of(np.concatenate([low, low + rng.uniform(20.0, 300.0, (2, 2))], axis=1), rng.uniform(0.3, 1, 2))
        spread = np.where(rng.random((2, 4)) < gross, 10.0, 1.0)
        errors = LAW.sigmas(boxes) * spread * rng.normal(size=(2, 4))
        result.append(Image(boxes, errors, rng.integers(0, 20, 2)))
    return result


def test_features_by_hand() -> None:
    """A box of 100 x 200 in the corner of the image, whose right half another one covers."""
    boxes = boxes_of(np.array([[0, 0, 100, 200], [50, 0, 150, 200]]), np.array([0.7, 0.4]))
    corner = edge_features(boxes)[0]
    place = np.hypot(270.0, 140.0) / np.hypot(320.0, 240.0)
    log2 = np.log(2.0)
    #                extent, other, score, covered, another edge at the border, place
    np.testing.assert_allclose(corner[0], [0.0, log2, 0.7, 0.5, 1.0, place])  # xmin: ymin touches
    np.testing.assert_allclose(corner[1], [log2, 0.0, 0.7, 0.5, 1.0, place])  # ymin: xmin touches
    np.testing.assert_allclose(corner[2], [0.0, log2, 0.7, 0.5, 1.0, place])
    second = edge_features(boxes)[1]
    assert second[1, 4] == 0.0  # ymin is the only edge of this box at the border
    assert second[3, 4] == 1.0
    assert edge_features(boxes, 150.0, 180.0)[0, 0, 0] == pytest.approx(np.log(1.5))
    assert edge_features(boxes, 150.0, 180.0)[0, 1, 0] == pytest.approx(np.log(1.8))


def test_no_boxes_have_no_features() -> None:
    assert edge_features(boxes_of(np.empty((0, 4)))).shape == (0, 4, len(FEATURES))
    assert len(LAW(boxes_of(np.empty((0, 4))))) == 0


def test_sigma_by_hand() -> None:
    (covariance,) = LAW(boxes_of(np.array([[100, 100, 200, 500]]))).covariances
    sigma = 4.0 * np.exp(-0.9)
    np.testing.assert_allclose(covariance, np.diag([1.0, 4.0, 1.0, 4.0]) * sigma**2)


def test_a_known_covariance_is_kept() -> None:
    boxes = boxes_of(np.array([[10, 20, 50, 50]]))
    boxes.covariances[0] = np.diag([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(LAW(boxes).covariances, boxes.covariances)


def test_likelihood_by_hand() -> None:
    """One edge, 2 px off, sigma 2 px: half the density of N(0, 4), half that of N(0, 36)."""
    model = EdgeMixture(float(np.log(2.0)), np.empty(0), 0.5, 3.0)
    core, outlier = (np.exp(-2.0 / s**2) / (s * np.sqrt(2 * np.pi)) for s in (2.0, 6.0))
    errors, features = np.array([2.0]), np.empty((1, 0))
    assert model.negative_log_likelihoods(errors, features) == pytest.approx(-np.log(0.5 * core + 0.5 * outlier))
    assert model.inliers(errors, features) == pytest.approx(core / (core + outlier))


def test_the_law_of_the_errors_is_found() -> None:
    edges = Edges.of(images(0))
    model, _ = fit(edges)
    found = calibrator(model, edges.extents)
    for image in images(1, n=50):
        np.testing.assert_allclose(found.sigmas(image.boxes), LAW.sigmas(image.boxes), rtol=0.15)
    assert model.outlier_share == pytest.approx(0.1, abs=0.03)
    assert model.outlier_spread == pytest.approx(10.0, rel=0.2)


def test_gross_errors_blow_nothing_up() -> None:
    """A plain Gaussian would have the standard deviation sqrt(0.9 + 0.1 * 100) = 3.3."""
    rng = np.random.default_rng(2)
    errors = rng.normal(size=4000) * np.where(rng.random(4000) < 0.1, 10.0, 1.0)
    model = fit_mixture(errors, np.empty((4000, 0)))
    assert np.exp(model.intercept) == pytest.approx(1.0, rel=0.06)


def confident(seed: int) -> list[Image]:
    """Boxes of a detector whose scores are 0.98 to 1, and which errs by 2 px at 1 and by 6.6 px at 0.98."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(150):
        low = rng.uniform(50.0, 300.0, (6, 2))
        scores = 1.0 - rng.exponential(0.004, 6).clip(0.0, 0.02)
        boxes = boxes_of(np.concatenate([low, low + rng.uniform(40.0, 200.0, (6, 2))], axis=1), scores)
        errors = 2.0 * np.exp(60.0 * (1.0 - scores))[:, None] * rng.normal(size=(6, 4))
        result.append(Image(boxes, errors, np.arange(6)))
    return result


def test_a_confident_detector_gets_a_valid_calibrator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The likeliest slope would be -57 per score: at a score of 0.5 that were e^27 px."""
    monkeypatch.setattr("calibslam_detector.fit_calibrator.references", lambda bag: confident(0))
    assert main(["bag", "--out", str(tmp_path / "c.json")]) == 0
    found = load(str(tmp_path / "c.json"))
    assert isinstance(found, LogLinearCalibrator) and found.score < -5.0
    model, constant = fit(Edges.of(confident(0)))
    judged = judge(model, constant, Edges.of(confident(1)))
    assert judged.nll < judged.nll_constant - 0.005
    assert judged.coverage_90 == pytest.approx(0.9, abs=0.03)
    # What no file can hold is said, with what to do.
    with pytest.raises(CalibratorError, match=r"intercept = 56.*record longer"):
        calibrator(replace(model, intercept=56.0), (20.0, 200.0))


def test_limits_are_met_and_matter_only_where_they_are_exceeded() -> None:
    edges = Edges.of(images(0))
    free, (intercept, *_) = fit_mixture(edges.errors, edges.features), LARGEST
    assert np.abs([free.intercept, *free.coefficients]).max() < intercept / 2
    bound = fit_mixture(edges.errors, edges.features, LARGEST)
    assert bound.intercept == free.intercept and np.array_equal(bound.coefficients, free.coefficients)
    tight = fit_mixture(edges.errors, edges.features, np.array([1.0, *LARGEST[1:]]))
    assert 1.0 - 1e-5 < tight.intercept <= 1.0 < free.intercept
    # Other features say for the intercept what it must not say.
    likelihoods = [model.negative_log_likelihoods(edges.errors, edges.features).mean() for model in (free, tight)]
    assert likelihoods[0] < likelihoods[1] < likelihoods[0] + 0.02


def test_judged_on_other_edges() -> None:
    model, constant = fit(Edges.of(images(0)))
    fresh = judge(model, constant, Edges.of(images(3)))
    # 6400 edges: standard errors 0.6 and 0.4 points; taking the likely ones as inliers shortens the tail a little.
    assert fresh.coverage_50 == pytest.approx(0.5, abs=0.03)
    assert fresh.coverage_90 == pytest.approx(0.9, abs=0.03)
    assert fresh.nll < fresh.nll_constant - 0.05
    # Twice as certain is caught.
    proud = replace(model, intercept=model.intercept - np.log(2.0))
    assert judge(proud, constant, Edges.of(images(3))).coverage_50 < 0.4


def test_objects_are_held_out_not_images() -> None:
    """One object errs 30 times as much, and a feature tells which: only who saw it knows what that means."""
    edges = Edges.of(images(0))
    judged = held_out(edges)
    assert judged.edges == len(edges.errors)
    scores = edges.features.copy()
    scores[:, 2] = edges.objects == 0
    errors = np.where(edges.objects == 0, 30.0 * edges.errors, edges.errors)
    told = replace(edges, errors=errors, features=scores)
    assert judge(*fit(told), told).inliers > held_out(told).inliers + 0.01


def test_too_little_is_refused() -> None:
    with pytest.raises(CalibratorError, match=r"too little to fit to: 80 edges of \d+ objects"):
        Edges.of(images(0, n=10))
    one = [replace(image, objects=np.zeros(2, int)) for image in images(0)]
    with pytest.raises(CalibratorError, match="6400 edges of 1 objects"):
        Edges.of(one)


def test_from_a_recording_to_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, out = write(tmp_path / "bag", messages()), tmp_path / "calibrator.json"
    assert main([str(bag), "--out", str(out), "--test", str(bag)]) == 0
    assert "bag, objects held out: inliers" in capsys.readouterr().out
    content = json.loads(out.read_text())
    assert content["fitted_on"]["objects"] == 9
    assert content["fitted_on"]["test"]["bag"] == "bag"
    calibrated = load(str(out))(boxes_of(np.array([[200, 200, 260, 270]])))
    # The small world's boxes err by 1.5 px.
    np.testing.assert_allclose(np.sqrt(np.diagonal(calibrated.covariances[0])), 1.5, rtol=0.25)


@pytest.mark.parametrize(
    ("left_out", "says"),
    [
        ("/ground_truth", "no ground truth"),
        ("/detections", "no topic /detections"),
        ("/camera/camera_info", "no topic"),
    ],
)
def test_a_recording_without_what_is_needed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], left_out: str, says: str
) -> None:
    bag = write(tmp_path / "bag", (m for m in messages() if m[0] != left_out))
    assert main([str(bag), "--out", str(tmp_path / "c.json")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ") and says in error
    assert not (tmp_path / "c.json").exists()


def test_a_recording_is_not_replaced_by_the_calibrator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, test = (write(tmp_path / name, messages()) for name in ("fit.mcap", "test.mcap"))
    before = bag.read_bytes(), test.read_bytes()
    for out in (bag, test):
        assert main([str(bag), "--out", str(out), "--test", str(test)]) == 1
        assert "would replace" in capsys.readouterr().err
    assert (bag.read_bytes(), test.read_bytes()) == before
