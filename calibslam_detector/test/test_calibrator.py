"""The calibrator: known numbers, kept covariances, clear errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibslam_detector.foreign_boxes.calibrator import CalibratorError, PerSizeCalibrator, load
from calibslam_msgs_py.measurements import Boxes


def boxes_of(corners: list[list[float]]) -> Boxes:
    n = len(corners)
    return Boxes(
        stamp=7,
        width=640,
        height=480,
        corners=np.array(corners, float).reshape(-1, 4),
        covariances=np.full((n, 4, 4), np.nan),
        class_ids=("cup",) * n,
        scores=np.full(n, 0.9),
        object_ids=("",) * n,
    )


def test_an_edge_errs_by_a_floor_and_a_share_of_its_extent() -> None:
    calibrated = PerSizeCalibrator(floor=3.0, relative=0.1)(boxes_of([[10, 20, 50, 50]]))
    np.testing.assert_allclose(calibrated.covariances[0], np.diag([25.0, 18.0, 25.0, 18.0]))
    assert calibrated.stamp == 7


def test_a_known_covariance_is_kept() -> None:
    boxes = boxes_of([[10, 20, 50, 50], [10, 20, 50, 50]])
    boxes.covariances[1] = np.diag([1.0, 2.0, 3.0, 4.0])
    calibrated = PerSizeCalibrator()(boxes)
    np.testing.assert_array_equal(calibrated.covariances[1], boxes.covariances[1])
    assert calibrated.has_covariance.all()


def test_no_boxes_stay_no_boxes() -> None:
    assert len(PerSizeCalibrator()(boxes_of([]))) == 0


@given(
    st.floats(0.01, 100.0),
    st.floats(0.0, 1.0),
    st.tuples(*[st.floats(-100.0, 1000.0)] * 2, *[st.floats(0.01, 1000.0)] * 2),
)
def test_covariances_are_positive_definite(floor: float, relative: float, box: tuple[float, ...]) -> None:
    x, y, w, h = box
    (covariance,) = PerSizeCalibrator(floor, relative).covariances(np.array([[x, y, x + w, y + h]]))
    assert (np.linalg.eigvalsh(covariance) >= 0.99 * floor**2).all()


def test_without_a_file_the_defaults_hold() -> None:
    assert load() == load(None) == PerSizeCalibrator()


def test_a_file_sets_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "calibrator.json"
    path.write_text(json.dumps({"version": 1, "kind": "per_size", "parameters": {"floor": 4}}))
    assert load(str(path)) == PerSizeCalibrator(floor=4.0)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "is not JSON"),
        ([], 'does not say "version": 1'),
        ({"version": 2, "kind": "per_size"}, 'does not say "version": 1'),
        ({"version": 1, "kind": "magic"}, "unknown kind 'magic'; known: per_size"),
        ({"version": 1, "kind": []}, "unknown kind"),
        ({"version": 1, "kind": "per_size", "floor": 3}, "unknown key floor"),
        ({"version": 1, "kind": "per_size", "parameters": 3}, "parameters"),
        ({"version": 1, "kind": "per_size", "parameters": {"flor": 3}}, "unknown setting 'flor'"),
        ({"version": 1, "kind": "per_size", "parameters": {"floor": -1}}, "floor = -1.0: must be at least"),
        ({"version": 1, "kind": "per_size", "parameters": {"floor": "3"}}, "must be a number"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, content: Any, says: str) -> None:
    path = tmp_path / "calibrator.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(CalibratorError, match=says) as caught:
        load(str(path))
    assert str(path) in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibratorError, match=r"nowhere\.json cannot be read"):
        load(str(tmp_path / "nowhere.json"))
