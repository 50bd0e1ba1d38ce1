"""f-Cal with the distance of Cramer and von Mises: by hand, without bias, and least at true covariances."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import chi2, cramervonmises
from torch import Tensor

from calibslam_detector.calibration import metrics
from calibslam_detector.calibration.f_cal_cramer import FCalCramer, chi_squared_probability, cramer_von_mises
from calibslam_detector.calibration.losses import Blend, GaussianNLL
from calibslam_detector.calibration.residuals import CalibrationError


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def of_residuals(loss: torch.nn.Module, z: Tensor, variance: Tensor | None = None) -> Tensor:
    """The loss of errors z with these variances, 1 by default."""
    result: Tensor = loss(torch.zeros_like(z), torch.ones_like(z) if variance is None else variance, z)
    return result


def test_distance_by_hand() -> None:
    # p = 0.2, 0.6, 0.7: E p^2 = 0.89/3; larger ones of the pairs 0.6, 0.7, 0.7, mean 2/3.
    p = torch.tensor([0.7, 0.2, 0.6], dtype=torch.float64)
    assert float(cramer_von_mises(p)) == pytest.approx(0.89 / 3.0 - 2.0 / 3.0 + 1.0 / 3.0)
    # All at c: the integral of (1[t >= c] - t)^2, (c^3 + (1 - c)^3)/3.
    for c in (0.0, 0.25, 1.0):
        assert float(cramer_von_mises(torch.full((5,), c))) == pytest.approx((c**3 + (1.0 - c) ** 3) / 3.0, abs=1e-6)


@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=40))
@settings(max_examples=50, deadline=None)
def test_distance_and_the_classic_statistic(values: list[float]) -> None:
    """n omega^2 of scipy is that of the empirical distribution, which holds each sample's pair with itself, too:
    int (G_n - t)^2 dt = n^-2 (sum of E[p^2] over ...) differs from ours by int G_n (1 - G_n) dt / (n - 1)."""
    p = np.array(values)
    n = len(p)
    classic = cramervonmises(p, "uniform").statistic / n
    ordered = np.concatenate([[0.0], np.sort(p), [1.0]])
    G = np.arange(n + 1) / n
    variance = float((G * (1.0 - G) * np.diff(ordered)).sum())
    ours = float(cramer_von_mises(torch.from_numpy(p)))
    assert ours == pytest.approx(classic - variance / (n - 1), abs=1e-12)


@pytest.mark.parametrize("K", [1, 4, 100])
def test_distribution_function_and_its_gradient(K: int) -> None:
    q = torch.linspace(0.01, 3.0 * K, 50, dtype=torch.float64, requires_grad=True)
    p = chi_squared_probability(q, K)
    np.testing.assert_allclose(p.detach().numpy(), chi2.cdf(q.detach().numpy(), K), atol=1e-12)
    p.sum().backward()
    np.testing.assert_allclose(q.grad.numpy(), chi2.pdf(q.detach().numpy(), K), rtol=1e-6, atol=1e-12)


def test_a_residual_of_zero_has_a_gradient() -> None:
    variance = torch.ones(4, 1, requires_grad=True)
    of_residuals(FCalCramer((1,)), torch.tensor([[0.0], [0.0], [1.0], [-2.0]]), variance).backward()
    assert bool(torch.isfinite(variance.grad).all())


@pytest.mark.parametrize("scale", [1.0, 1.3])
@pytest.mark.parametrize("K", [1, 4, 20])
def test_without_bias(scale: float, K: int) -> None:
    """Mean over many small batches against the integral with the true distributions; 4 standard errors."""
    batches = 600
    losses = [float(of_residuals(FCalCramer((K,), 2, generator=generator(s)), scale * normal(12, 4, seed=s)))
              for s in range(batches)]  # fmt: skip
    mean, error = np.mean(losses), np.std(losses) / math.sqrt(batches)
    true, _ = quad(lambda t: (chi2.cdf(chi2.ppf(t, K) / scale**2, K) - t) ** 2, 0.0, 1.0)
    assert error < 0.01
    assert abs(mean - true) < 4.0 * error


def test_drawing_without_replacement_does_not_matter() -> None:
    """Nearly all of a batch in each sum: the published f-Cal is off by half there (test_f_cal)."""
    losses = [
        float(of_residuals(FCalCramer((75,), generator=generator(s)), normal(150, 1, seed=s))) for s in range(800)
    ]
    assert abs(np.mean(losses)) < 4.0 * np.std(losses) / math.sqrt(len(losses)) < 0.02


@pytest.mark.parametrize("degrees", [(1,), (2,), (100,), (1, 100)])
def test_loss_is_least_at_scale_one(degrees: tuple[int, ...]) -> None:
    """The same batches at every scale of sigma."""
    scales = (0.85, 0.95, 1.0, 1.05, 1.2)
    losses = [
        np.mean([float(of_residuals(FCalCramer(degrees, generator=generator(s)), normal(400, 2, seed=s) / scale))
                 for s in range(100)])
        for scale in scales
    ]  # fmt: skip
    assert int(np.argmin(losses)) == scales.index(1.0)


@given(st.integers(0, 1000), st.floats(0.5, 2.0))
@settings(max_examples=30, deadline=None)
def test_root_of_the_distance_bounds_the_calibration_error(seed: int, scale: float) -> None:
    """ECE(z) with many levels is the mean of |G_n - t|, and its square is below the mean of the squares."""
    z = scale * normal(200, 1, seed=seed)
    levels = np.linspace(0.0005, 0.9995, 1000)
    squared_distance = np.square(metrics.coverage(z.numpy(), levels) - levels).mean()
    assert metrics.ece_z(z.numpy(), levels) ** 2 <= squared_distance + 1e-9
    biased = float(of_residuals(FCalCramer((1,)), z))
    # The estimate without bias is smaller by int G_n (1 - G_n)/(n - 1), at most 1/4(n - 1).
    assert biased <= squared_distance + 1e-4
    assert biased >= squared_distance - 0.25 / 199 - 1e-4


def test_a_missed_correlation_is_seen_by_rows() -> None:
    """Each component is standard normal, so K = 1 sees nothing; sums of both are too wide."""
    L = torch.linalg.cholesky(torch.tensor([[1.0, 0.9], [0.9, 1.0]], dtype=torch.float64))
    errors = normal(40_000, 2) @ L.T
    assert float(of_residuals(FCalCramer((1,)), errors)) < 1e-4
    for K in (2, 20):
        assert float(of_residuals(FCalCramer((K,), generator=generator()), errors)) > 1e-3


def test_an_outlier_pulls_less_than_with_the_normal_fit() -> None:
    """The gradient in its log variance is bounded: the density falls faster than the residual grows."""
    gradients = []
    for outlier in (4.0, 40.0):
        z = normal(200, 1)
        z[0] = outlier
        log_variance = torch.zeros_like(z, requires_grad=True)
        of_residuals(FCalCramer((1,)), z, log_variance.exp()).backward()
        gradients.append(abs(float(log_variance.grad[0])))
    assert gradients[1] < gradients[0] < 1.0 / 200


def test_training_with_it_finds_heteroscedastic_sigmas() -> None:
    """Errors of 0.1 or 1.0, told apart by the input; the likelihood and f-Cal together find both, to 5 %."""
    random = generator(3)
    kind = torch.arange(2000) % 2
    errors = torch.randn(2000, 1, generator=random) * torch.tensor([0.1, 1.0])[kind][:, None]
    raw = torch.zeros(2, requires_grad=True)
    loss = Blend(GaussianNLL(), FCalCramer((1, 50), generator=random), 0.5)
    optimiser = torch.optim.Adam([raw], 0.2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 200)
    for _ in range(200):
        batch = torch.randperm(2000, generator=random)[:400]
        variance = raw[kind[batch]].exp()[:, None]
        optimiser.zero_grad()
        loss(torch.zeros(400, 1), variance, errors[batch]).backward()
        optimiser.step()
        schedule.step()
    sample = [float(errors[kind == each].square().mean()) for each in (0, 1)]
    assert raw.detach().exp().tolist() == pytest.approx(sample, rel=0.1)


@pytest.mark.parametrize(
    ("n", "d", "K", "text"),
    [(50, 1, 100, "two sums of K = 100 squares need 200 residuals of 1; got 50"), (50, 3, 100, "no multiple of the 3")],
)
def test_errors_say_what_is_wrong(n: int, d: int, K: int, text: str) -> None:
    with pytest.raises(CalibrationError, match=text):
        of_residuals(FCalCramer((K,)), normal(n, d))


def test_weights_of_the_distances() -> None:
    """By hand of the distances alone, from the same partitions; 1 each if none are given."""
    z = 1.2 * normal(400, 4)
    of_components, of_sums = (float(of_residuals(FCalCramer((K,), generator=generator()), z)) for K in (1, 100))
    for weights, expected in (
        ((1.0, 0.01), of_components + 0.01 * of_sums),
        ((0.0, 2.0), 2.0 * of_sums),
        (None, of_components + of_sums),
    ):
        found = float(of_residuals(FCalCramer((1, 100), weights=weights, generator=generator()), z))
        assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("K", [1, 4, 20])
def test_evidence_of_true_covariances_is_alike_for_all_sums(K: int) -> None:
    """n times the classic statistic has the mean 1/6 and the variance 1/45 for any K. Ours is without bias: the mean is
    0, the variance n/(n - 1) times that; so distances vary as K does. 4 standard errors."""
    squares = normal(240, 4, 4000).square()
    sums = squares[:, 0] if K == 1 else squares.sum(dim=1).view(-1, K // 4, 4000).sum(dim=1)
    n = len(sums)
    values = n * cramer_von_mises(chi_squared_probability(sums, K)).numpy()
    error = np.std(values) / math.sqrt(len(values))
    assert abs(np.mean(values)) < 4.0 * error < 0.01
    assert np.std(values) == pytest.approx(math.sqrt(n / (n - 1) / 45.0), rel=0.12)
    classic = [cramervonmises(each, "chi2", args=(K,)).statistic for each in sums.T[:400].numpy()]
    assert abs(np.mean(classic) - 1.0 / 6.0) < 4.0 * np.std(classic) / math.sqrt(len(classic)) < 0.04


def test_settings_are_checked() -> None:
    for weights in ((1.0,), (1.0, -1.0)):
        with pytest.raises(CalibrationError, match="each K needs a weight"):
            FCalCramer((1, 100), weights=weights)
    for degrees, partitions in (((), 1), ((0,), 1), ((1,), 0)):
        with pytest.raises(CalibrationError, match="must be positive"):
            FCalCramer(degrees, partitions)
