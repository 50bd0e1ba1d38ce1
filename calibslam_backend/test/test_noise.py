"""The noise models of the document against numbers computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from calibslam_backend.graph.noise import (
    CALIBRATED,
    FIXED,
    LEAST_SPREAD,
    QUADRICSLAM,
    NoiseSettings,
    box_covariance,
)
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import SettingsError

OWN = np.array([[4.0, 1, 0.5, 0], [1, 9, 0, 0.5], [0.5, 0, 5, -1], [0, 0.5, -1, 6]])
UNKNOWN = np.full((4, 4), np.nan)


BOXES = np.array([[0.0, 0, 10, 20], [5, 5, 19, 25], [100, 100, 112, 126]])


def covariance(name: str, own: Array = OWN, boxes: Array = BOXES[:1], **settings: float) -> Array:
    return box_covariance(NoiseSettings(noise_model=name, **settings), own, list(boxes))


def test_calibrated_is_the_box_s_own() -> None:
    np.testing.assert_array_equal(covariance(CALIBRATED), OWN)
    np.testing.assert_array_equal(covariance(CALIBRATED, UNKNOWN), 25.0 * np.eye(4))


def test_fixed_is_the_same_for_all() -> None:
    np.testing.assert_array_equal(covariance(FIXED), 25.0 * np.eye(4))
    np.testing.assert_array_equal(covariance(FIXED, boxes=BOXES, fixed_sigma=3.0), 9.0 * np.eye(4))


@pytest.mark.parametrize(
    ("name", "expected"), [(CALIBRATED, 4.0 * OWN), (FIXED, 100.0 * np.eye(4)), (QUADRICSLAM, 100.0 * np.eye(4))]
)
def test_scale_is_of_standard_deviations(name: str, expected: Array) -> None:
    np.testing.assert_allclose(covariance(name, covariance_scale=2.0), expected)


def test_quadricslam_takes_the_spread_of_sizes() -> None:
    """Widths 10, 14, 12 and heights 20, 20, 26: deviations sqrt(8/3) and sqrt(8), n in the denominator."""
    np.testing.assert_allclose(covariance(QUADRICSLAM), 25.0 * np.eye(4))  # one box has no spread
    np.testing.assert_allclose(covariance(QUADRICSLAM, boxes=BOXES[:2]), 4.0 * np.eye(4))  # 2 + 0
    sigma = np.sqrt(8.0 / 3.0) + np.sqrt(8.0)
    np.testing.assert_allclose(covariance(QUADRICSLAM, boxes=BOXES), sigma**2 * np.eye(4))


def test_boxes_that_never_change_are_not_believed_exact() -> None:
    np.testing.assert_array_equal(covariance(QUADRICSLAM, boxes=BOXES[[0] * 5]), np.eye(4) * LEAST_SPREAD**2)


def test_unknown_models_are_refused_with_the_valid_ones() -> None:
    with pytest.raises(SettingsError, match=r"noise_model = 'best'.*calibrated, fixed, quadricslam"):
        NoiseSettings(noise_model="best")
