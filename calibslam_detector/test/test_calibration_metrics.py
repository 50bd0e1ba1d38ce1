"""Metrics, recalibration and mixtures: numbers computed by hand, and agreement with uncertainty-toolbox."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import uncertainty_toolbox as library
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, norm, special_ortho_group
from torch import nn

from calibslam_detector.calibration import metrics
from calibslam_detector.calibration.epistemic import combined, ensemble, monte_carlo_dropout
from calibslam_detector.calibration.recalibration import IsotonicRecalibration, TemperatureScaling
from calibslam_detector.calibration.reliability import plot, reliability
from calibslam_msgs_py.measurements import Array


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def overconfident(rng: np.random.Generator, n: int) -> tuple[Array, Array, Array]:
    """Prediction, standard deviation and truth (N,) of a predictor that claims 0.7 of its true sigmas."""
    mean, sigma = rng.normal(size=n), rng.uniform(0.2, 2.0, n)
    return mean, 0.7 * sigma, mean + sigma * rng.normal(size=n)


def test_whitened_by_hand() -> None:
    # [[4, 2], [2, 5]] = L L^T with L = [[2, 0], [1, 2]]; L z = (2, 5) has z = (1, 2).
    z = metrics.whitened(np.array([[2.0, 5.0]]), np.array([[[4.0, 2.0], [2.0, 5.0]]]))
    np.testing.assert_allclose(z, [[1.0, 2.0]])
    np.testing.assert_allclose(metrics.whitened(np.array([[2.0, 6.0]]), np.array([[4.0, 9.0]])), [[1.0, 2.0]])


def test_coverage_by_hand() -> None:
    # Of chi-squared with 2 degrees the quantile of p is -2 ln(1 - p): 1.386 for 0.5, 4.605 for 0.9.
    z = np.array([[1.0, 0.0], [1.0, 1.0], [2.0, 0.0], [2.0, 1.0]])  # squares 1, 2, 4, 5
    np.testing.assert_allclose(metrics.coverage(z, np.array([0.5, 0.9])), [0.25, 0.75])


def test_ece_z_by_hand() -> None:
    # |z| <= 0.6745 at 0.5 and 1.6449 at 0.9: shares 0.5 and 1.
    z = np.array([-0.1, 0.5, 0.7, -1.6])
    assert metrics.ece_z(z, np.array([0.5, 0.9])) == pytest.approx(0.5 * (0.0 + 0.1))


def test_ece_q_by_hand() -> None:
    # Sums of K = 2: 1 + 0 and 4 + 4, against 1.386 and 4.605.
    z = np.array([[1.0], [0.0], [2.0], [-2.0]])
    levels = np.array([0.5, 0.9])
    np.testing.assert_allclose(metrics.coverage_of_sums(z, 2, levels), [0.5, 0.5])
    assert metrics.ece_q(z, 2, levels) == pytest.approx(0.5 * (0.0 + 0.4))
    # The same numbers as rows with two components: one row is a sum.
    assert metrics.ece_q(z.reshape(2, 2), 2, levels) == pytest.approx(0.2)


def test_calibrated_boxes_are_covered_jointly(rng: np.random.Generator) -> None:
    """4-D with correlations: each share within 4 standard deviations of its binomial distribution."""
    n = 20000
    rotation = special_ortho_group.rvs(4, random_state=1)
    covariance = rotation @ np.diag([1.0, 4.0, 9.0, 100.0]) @ rotation.T
    errors = rng.standard_normal((n, 4)) @ np.linalg.cholesky(covariance).T
    z = metrics.whitened(errors, np.broadcast_to(covariance, (n, 4, 4)))
    deviation = np.sqrt(metrics.LEVELS * (1.0 - metrics.LEVELS) / n)
    assert (np.abs(metrics.coverage(z) - metrics.LEVELS) < 4.0 * deviation).all()
    # Without the correlations, each edge is still covered and the box is not.
    variances = np.broadcast_to(np.diag(covariance), (n, 4))
    assert metrics.ece_z(metrics.whitened(errors, variances)) < 0.01
    assert np.abs(metrics.coverage(metrics.whitened(errors, variances)) - metrics.LEVELS).max() > 0.05


def test_ece_q_of_a_factor_is_what_theory_says(rng: np.random.Generator) -> None:
    """Variances 10 % too small, K = 50: shares of q computed from chi-squared."""
    z = rng.standard_normal((200_000, 1)) / math.sqrt(0.9)
    shares = chi2.cdf(0.9 * chi2.ppf(metrics.LEVELS, 50), 50)
    expected = np.abs(shares - metrics.LEVELS).mean()
    assert metrics.ece_q(z, 50, rng=rng) == pytest.approx(expected, abs=0.01)
    assert expected > 5.0 * metrics.ece_z(z)


def test_agreement_with_uncertainty_toolbox(rng: np.random.Generator) -> None:
    mean, sigma, truth = overconfident(rng, 5000)
    errors, variances = (truth - mean)[:, None], np.square(sigma)[:, None]
    # Theirs has the levels 0 and 1 besides, at which nobody errs.
    theirs = library.mean_absolute_calibration_error(mean, sigma, truth, num_bins=21, vectorized=True)
    assert metrics.ece_z(metrics.whitened(errors, variances)) == pytest.approx(theirs * 21.0 / 19.0)
    assert metrics.negative_log_likelihood(errors, variances) == pytest.approx(library.nll_gaussian(mean, sigma, truth))
    assert metrics.sharpness(variances) == pytest.approx(library.sharpness(sigma))
    crps = library.crps_gaussian(mean, sigma, truth)
    assert metrics.energy_score(errors, variances, rng) == pytest.approx(crps, rel=0.02)


def test_likelihood_by_hand() -> None:
    # Sigmas 1 and 2, errors 1 and 2: (1 + 1 + ln 4)/2 + ln 2 pi; the same of a diagonal matrix.
    expected = 1.0 + math.log(2.0) + math.log(2.0 * math.pi)
    error = np.array([[1.0, 2.0]])
    assert metrics.negative_log_likelihood(error, np.array([[1.0, 4.0]])) == pytest.approx(expected)
    assert metrics.negative_log_likelihood(error, np.diag([1.0, 4.0])[None]) == pytest.approx(expected)


def test_sharpness_by_hand() -> None:
    assert metrics.sharpness(np.array([[1.0, 7.0]])) == pytest.approx(2.0)
    assert metrics.sharpness(np.array([[[1.0, 0.5], [0.5, 7.0]]])) == pytest.approx(2.0)


def test_energy_score_by_hand(rng: np.random.Generator) -> None:
    """The CRPS of N(0, 1) at its centre is sqrt(2/pi) - 1/sqrt(pi); certain predictions score their error."""
    zeros = np.zeros((20000, 1))
    expected = math.sqrt(2.0 / math.pi) - 1.0 / math.sqrt(math.pi)
    assert metrics.energy_score(zeros, np.ones_like(zeros), rng, 20) == pytest.approx(expected, abs=0.01)
    certain = np.full((1, 2, 2), 0.0) + 1e-12 * np.eye(2)
    assert metrics.energy_score(np.array([[3.0, 4.0]]), certain, rng) == pytest.approx(5.0, abs=1e-4)


def test_energy_score_is_least_for_the_truth(rng: np.random.Generator) -> None:
    errors = rng.standard_normal((20000, 4))
    scores = [
        metrics.energy_score(errors, np.full((20000, 4), scale**2), np.random.default_rng(0), 20)
        for scale in (0.7, 1.0, 1.4)
    ]
    assert min(scores) == scores[1]


@given(st.integers(0, 10_000), st.integers(1, 4), st.floats(0.1, 10.0))
@settings(max_examples=40, deadline=None)
def test_metrics_know_no_unit(seed: int, d: int, scale: float) -> None:
    """In other units z is the same, and so is every ECE; likelihood and sharpness change as they must."""
    random = np.random.default_rng(seed)
    A = random.standard_normal((30, d, d))
    covariances, errors = A @ A.mT + 0.1 * np.eye(d), random.standard_normal((30, d))
    z, scaled_z = (metrics.whitened(s * errors, s**2 * covariances) for s in (1.0, scale))
    np.testing.assert_allclose(z, scaled_z, rtol=1e-6, atol=1e-9)
    nll, scaled_nll = (metrics.negative_log_likelihood(s * errors, s**2 * covariances) for s in (1.0, scale))
    assert scaled_nll == pytest.approx(nll + d * math.log(scale), abs=1e-6)
    assert metrics.sharpness(scale**2 * covariances) == pytest.approx(scale * metrics.sharpness(covariances))


def test_errors_say_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="K = 100 squares cannot be made of 10 residuals"):
        metrics.ece_q(np.zeros((10, 1)), 100)
    with pytest.raises(ValueError, match="must be finite"):
        metrics.ece_z(np.array([np.nan]))
    with pytest.raises(np.linalg.LinAlgError):
        metrics.whitened(np.zeros((1, 2)), -np.eye(2)[None])
    with pytest.raises(ValueError, match="needs finite"):
        TemperatureScaling.fit(np.array([]))


def test_band_holds_the_truth_as_often_as_it_says() -> None:
    """Calibrated residuals leave the 90 % band in at most 10 % of 400 repetitions, and not never."""
    curves = [reliability(np.random.default_rng(i).standard_normal((200, 1)), confidence=0.9) for i in range(400)]
    # DKW is nearly exact for the supremum over all levels; over 19 it is a little wider than needed.
    outside = sum(not curve.is_calibrated for curve in curves)
    assert 4 <= outside <= 40 + 3 * 6
    assert curves[0].half_width == pytest.approx(math.sqrt(math.log(20.0) / 400.0))
    # 40 sums of 25 rows of two.
    of_sums = reliability(np.random.default_rng(0).standard_normal((1000, 2)), K=50, confidence=0.9)
    assert of_sums.half_width == pytest.approx(math.sqrt(math.log(20.0) / 80.0))


def test_reliability_plot(tmp_path: Path, rng: np.random.Generator) -> None:
    z = rng.standard_normal((2000, 1))
    curves = {"calibrated": reliability(z), "overconfident": reliability(1.5 * z), "sums": reliability(z, K=50)}
    assert curves["calibrated"].is_calibrated and not curves["overconfident"].is_calibrated
    plot(curves, tmp_path / "reliability.png", "three predictors, called x$^$ by somebody")
    assert (tmp_path / "reliability.png").stat().st_size > 5000


def test_temperature_by_hand() -> None:
    scaling = TemperatureScaling.fit(np.array([1.0, 7.0]))  # root of (1 + 49)/2
    assert scaling.factor == pytest.approx(5.0)
    np.testing.assert_allclose(scaling(np.array([10.0])), [2.0])


def test_isotonic_map_of_a_shifted_and_stretched_normal(rng: np.random.Generator) -> None:
    """z = 2 n + 1 becomes n again, in between the extremes."""
    n = rng.standard_normal((20000, 1))
    recalibrate = IsotonicRecalibration.fit(2.0 * n + 1.0)
    new = np.linspace(-2.0, 2.0, 9)[:, None]
    np.testing.assert_allclose(recalibrate(2.0 * new + 1.0), new, atol=0.1)
    assert np.isfinite(recalibrate(np.array([[-50.0], [50.0]]))).all()
    held_out = rng.standard_normal((20000, 1))
    assert metrics.ece_z(recalibrate(2.0 * held_out + 1.0)) < 0.01


def test_mixture_by_hand() -> None:
    # Means 0 and 2, variances 1 and 3: mean 1, variance 2 + 1.
    means, variances = torch.tensor([[[0.0]], [[2.0]]]), torch.tensor([[[1.0]], [[3.0]]])
    mean, variance = combined(means, variances)
    assert float(mean) == pytest.approx(1.0) and float(variance) == pytest.approx(3.0)
    # In 2-D, means (0, 0) and (2, 4): covariance of means [[1, 2], [2, 4]].
    means = torch.tensor([[[0.0, 0.0]], [[2.0, 4.0]]])
    _, matrix = combined(means, torch.eye(2).expand(2, 1, 2, 2))
    torch.testing.assert_close(matrix[0], torch.tensor([[2.0, 2.0], [2.0, 5.0]]))
    mean, variance = ensemble([lambda x: (x, torch.ones_like(x)), lambda x: (x + 2.0, torch.ones_like(x))], means[0])
    torch.testing.assert_close(variance, torch.full((1, 2), 2.0))


class WithDropout(nn.Module):
    """Each input is 0 or doubled, as chance has it."""

    def __init__(self) -> None:
        super().__init__()
        self.dropout = nn.Dropout(0.5)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.dropout(x), torch.full_like(x, 0.5)


def test_dropout_by_hand() -> None:
    """Of an input 1 the mean is 1 and the variance 0.5 + 1: of 4000 samples, within 4 standard errors."""
    network, x = WithDropout().eval(), torch.ones(1, 1)
    mean, variance = monte_carlo_dropout(network, x, 4000, seed=1)
    assert float(mean) == pytest.approx(1.0, abs=4.0 / math.sqrt(4000.0))
    assert float(variance) == pytest.approx(1.5, abs=0.01)
    assert not network.dropout.training
    assert float(monte_carlo_dropout(network, x, 50, seed=1)[0]) == float(
        monte_carlo_dropout(network, x, 50, seed=1)[0]
    )
    with pytest.raises(ValueError, match="dropout layers"):
        monte_carlo_dropout(nn.Linear(1, 1), x, 2, seed=1)


def test_normal_quantiles_are_those_of_chi_squared() -> None:
    """What `coverage` uses in one dimension: chi-squared with one degree is the squared normal."""
    np.testing.assert_allclose(np.sqrt(chi2.ppf(metrics.LEVELS, 1)), norm.ppf(0.5 + metrics.LEVELS / 2.0))
