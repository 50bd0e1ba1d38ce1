"""The noise models of the document against numbers computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from calibslam_backend.graph.noise import (
    CALIBRATED,
    FIXED,
    LEAST_SPREAD,
    QUADRICSLAM,
    NoiseModel,
    NoiseSettings,
    RunningSpread,
)
from calibslam_msgs_py.settings import SettingsError

OWN = np.array([[4.0, 1, 0.5, 0], [1, 9, 0, 0.5], [0.5, 0, 5, -1], [0, 0.5, -1, 6]])
UNKNOWN = np.full((4, 4), np.nan)


def model(name: str, scale: float = 1.0, sigma: float = 5.0) -> NoiseModel:
    return NoiseModel(NoiseSettings(noise_model=name, fixed_sigma=sigma, covariance_scale=scale))


def test_calibrated_is_the_box_s_own() -> None:
    np.testing.assert_array_equal(model(CALIBRATED).covariance(0, OWN), OWN)
    np.testing.assert_array_equal(model(CALIBRATED).covariance(0, UNKNOWN), 25.0 * np.eye(4))


def test_fixed_is_the_same_for_all() -> None:
    np.testing.assert_array_equal(model(FIXED).covariance(0, OWN), 25.0 * np.eye(4))
    np.testing.assert_array_equal(model(FIXED, sigma=3.0).covariance(0, OWN), 9.0 * np.eye(4))


@pytest.mark.parametrize(
    ("name", "expected"), [(CALIBRATED, 4.0 * OWN), (FIXED, 100.0 * np.eye(4)), (QUADRICSLAM, 100.0 * np.eye(4))]
)
def test_scale_is_of_standard_deviations(name: str, expected: np.ndarray) -> None:
    np.testing.assert_allclose(model(name, scale=2.0).covariance(0, OWN), expected)


def test_quadricslam_takes_the_spread_of_sizes() -> None:
    """Widths 10, 14, 12 and heights 20, 20, 26: deviations sqrt(8/3) and sqrt(8), n in the denominator."""
    noise = model(QUADRICSLAM)
    boxes = np.array([[0.0, 0, 10, 20], [5, 5, 19, 25], [100, 100, 112, 126]])
    noise.observe(7, boxes[0])
    np.testing.assert_allclose(noise.covariance(7, OWN), 25.0 * np.eye(4))  # one box has no spread
    noise.observe(7, boxes[1])
    np.testing.assert_allclose(noise.covariance(7, OWN), 4.0 * np.eye(4))  # 2 + 0
    noise.observe(7, boxes[2])
    sigma = np.sqrt(8.0 / 3.0) + np.sqrt(8.0)
    np.testing.assert_allclose(noise.covariance(7, OWN), sigma**2 * np.eye(4))
    np.testing.assert_allclose(noise.covariance(8, OWN), 25.0 * np.eye(4))  # of another object: nothing is known


def test_boxes_that_never_change_are_not_believed_exact() -> None:
    noise = model(QUADRICSLAM)
    for _ in range(5):
        noise.observe(0, np.array([1.0, 2.0, 3.0, 4.0]))
    np.testing.assert_array_equal(noise.covariance(0, OWN), np.eye(4) * LEAST_SPREAD**2)


def test_running_spread_is_that_of_all_boxes() -> None:
    rng = np.random.default_rng(0)
    boxes = np.concatenate([rng.uniform(0, 50, (100, 2)), rng.uniform(1000.0, 1100.0, (100, 2))], axis=1)
    spread = RunningSpread()
    assert np.isnan(spread.sigma())
    for box in boxes:
        spread.add(box)
    sizes = boxes[:, 2:] - boxes[:, :2]
    assert spread.sigma() == pytest.approx(sizes.std(axis=0).sum())
    assert spread.count == 100


def test_unknown_models_are_refused_with_the_valid_ones() -> None:
    with pytest.raises(SettingsError, match=r"noise_model = 'best'.*calibrated, fixed, quadricslam"):
        NoiseSettings(noise_model="best")
