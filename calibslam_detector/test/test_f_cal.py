"""f-Cal: the closed forms, and that true covariances are where it is least."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from calibslam_detector.calibration.f_cal import DIVERGENCES, FCal, kl, wasserstein
from calibslam_detector.calibration.losses import Blend, CalibrationLoss, GaussianNLL
from calibslam_detector.calibration.residuals import CalibrationError, bounded_variance, standardised

SEED = 3


def generator(seed: int = SEED) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = SEED) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def of_residuals(loss: FCal, z: Tensor, variance: Tensor | None = None) -> Tensor:
    """The loss of errors z with these variances, 1 by default."""
    return loss(torch.zeros_like(z), torch.ones_like(z) if variance is None else variance, z)


def mean_and_error(values: list[float]) -> tuple[float, float]:
    """Mean, and its standard error."""
    numbers = torch.tensor(values)
    return float(numbers.mean()), float(numbers.std() / math.sqrt(len(numbers)))


def test_divergences_by_hand() -> None:
    # A fit N(12, 36) against N(10, 20): (ln(20/36) + (36 + 4)/20 - 1)/2, and 4 + (6 - sqrt 20)^2.
    variance, squared_bias = torch.tensor(36.0), torch.tensor(4.0)
    assert float(kl(variance, squared_bias, 10.0)) == pytest.approx(0.5 * (math.log(20 / 36) + 1.0))
    assert float(wasserstein(variance, squared_bias, 10.0)) == pytest.approx(4.0 + (6.0 - math.sqrt(20.0)) ** 2)
    for divergence in (kl, wasserstein):
        assert float(divergence(torch.tensor(20.0), torch.tensor(0.0), 10.0)) == pytest.approx(0.0, abs=1e-6)


def test_kl_agrees_with_torch() -> None:
    fit = torch.distributions.Normal(12.0, 6.0)
    target = torch.distributions.Normal(10.0, math.sqrt(20.0))
    expected = torch.distributions.kl_divergence(fit, target)
    assert float(kl(torch.tensor(36.0), torch.tensor(4.0), 10.0)) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.parametrize("divergence", DIVERGENCES)
@pytest.mark.parametrize("published", [False, True])
def test_many_sums_approach_the_closed_form(divergence: str, published: bool) -> None:
    """With H towards infinity the fit is that of the batch's own mean and variance."""
    n, K = 150, 75
    z = normal(n, 1)
    a = z.square()
    variance = K * a.var() * ((1.0 - K / n) if published else 1.0)
    squared_bias = (K * a.mean() - K) ** 2 - (0.0 if published else K * variance / n)
    expected = (kl if divergence == "kl" else wasserstein)(variance, squared_bias, float(K))
    loss = FCal(K, 200_000, divergence, published=published, generator=generator())
    assert float(of_residuals(loss, z)) == pytest.approx(float(expected), rel=0.03)


@pytest.mark.parametrize(("n", "K", "ratio"), [(500, 100, 0.80), (150, 75, 0.50)])
def test_drawing_without_replacement_shrinks_the_variance(n: int, K: int, ratio: float) -> None:
    """The flaw: 2K (1 - K/N) instead of 2K; averaged over batches, with its standard error."""
    loss = FCal(K, 200, published=True, generator=generator())
    variances = [float(loss._sums(normal(n, seed=seed).square(), K).var() / (2 * K)) for seed in range(400)]
    mean, error = mean_and_error(variances)
    assert abs(mean - ratio) < 4.0 * error < 0.05


def test_both_moments_are_unbiased() -> None:
    """Exactly, over all batches of three residuals and all draws of two sums of two: z^2 is 3 for a third of them and 0
    for the others, so it has the mean 1 and the variance 2 of a squared normal."""
    n, K, H = 3, 2, 2
    loss = FCal(K, H)
    seen: list[tuple[float, float]] = []
    loss.divergence = lambda variance, squared_bias, _: seen.append((float(variance), float(squared_bias))) or variance
    weights = []
    for squares in itertools.product([0.0, 3.0], repeat=n):
        z = torch.tensor(squares, dtype=torch.float64).sqrt()[:, None]
        for drawn in itertools.product(range(n), repeat=K * H):
            chosen = torch.tensor(drawn).reshape(H, K)
            loss._sums = lambda a, _, chosen=chosen: a[chosen].sum(dim=1)
            of_residuals(loss, z)
            weights.append(math.prod(1 / 3 if a else 2 / 3 for a in squares) / n ** (K * H))
    assert sum(weights) == pytest.approx(1.0)
    variance, squared_bias = (
        sum(w * value for w, value in zip(weights, of, strict=True)) for of in zip(*seen, strict=True)
    )
    assert variance == pytest.approx(2.0 * K)
    assert squared_bias == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("divergence", DIVERGENCES)
def test_gradient_vanishes_at_true_scale(divergence: str) -> None:
    """Mean gradient in a common log scale over many batches, as the scale that it asks for: |shift| < 0.4 %.

    Without the correction of the mean it would ask for 0.7 %.
    """
    n, K, batches = 150, 75, 2000
    loss = FCal(K, 200, divergence, generator=generator())
    gradients = []
    for seed in range(batches):
        log_scale = torch.zeros((), dtype=torch.float64, requires_grad=True)
        z = normal(n, 1, seed=seed)
        of_residuals(loss, z, torch.exp(2.0 * log_scale) * torch.ones_like(z)).backward()
        gradients.append(float(log_scale.grad))
    # Second derivatives at the truth: 2K + 4 of KL, 8 K^2 and more of the distance.
    curvature = 2.0 * K + 4.0 if divergence == "kl" else 8.0 * K**2 + 8.0 * K
    mean, error = mean_and_error(gradients)
    assert error / curvature < 0.0015
    assert abs(mean / curvature) < 0.004


@pytest.mark.parametrize("divergence", DIVERGENCES)
def test_loss_is_least_at_scale_one(divergence: str) -> None:
    """The same batches and draws at every scale of sigma."""
    scales = (0.9, 0.97, 1.0, 1.03, 1.1)
    losses = []
    for scale in scales:
        loss = FCal(100, 200, divergence, generator=generator())
        each = [float(of_residuals(loss, normal(500, 1, seed=seed) / scale)) for seed in range(300)]
        losses.append(sum(each) / len(each))
    assert min(losses) == losses[scales.index(1.0)]


def shape_gradient(published: bool, batches: int = 900) -> tuple[float, float]:
    """Mean gradient of the Wasserstein loss, with its error, in a direction that leaves the mean of z^2 as it is and
    makes their spread larger: sigmas that shrink where errors are large."""
    n, K = 150, 75
    loss = FCal(K, 200, "wasserstein", published=published, generator=generator())
    gradients = []
    for seed in range(batches):
        t = torch.zeros((), dtype=torch.float64, requires_grad=True)
        z = normal(n, 1, seed=seed)
        # E[z^2 (z^2 - 3)] = 3 - 3 = 0: the mean stays; the spread of z^2 grows with t.
        of_residuals(loss, z, torch.exp(-t * (z.square() - 3.0) / 10.0)).backward()
        gradients.append(float(t.grad))
    return mean_and_error(gradients)


def test_correction_removes_the_pull_on_the_spread() -> None:
    """The published loss wants lighter tails than normal ones; the corrected one almost nothing."""
    published, published_error = shape_gradient(published=True)
    corrected, _ = shape_gradient(published=False)
    assert published > 5.0 * published_error
    assert abs(corrected) < 0.5 * published


def test_a_missed_correlation_is_seen() -> None:
    """Independent components are claimed, each with its true variance; their correlation is 0.9."""
    L = torch.linalg.cholesky(torch.tensor([[1.0, 0.9], [0.9, 1.0]], dtype=torch.float64))
    errors = normal(4000, 2) @ L.T
    loss = FCal(100, 2000, generator=generator())
    true = (L @ L.T).expand(4000, 2, 2)
    claimed = torch.eye(2, dtype=torch.float64).expand(4000, 2, 2)
    zero = torch.zeros_like(errors)
    assert float(loss(zero, claimed, errors)) > float(loss(zero, true, errors)) + 0.05


def test_training_with_it_finds_heteroscedastic_sigmas() -> None:
    """Errors of 0.1 or 1.0, told apart by the input; the likelihood and f-Cal together find both, to 5 %."""
    random = generator()
    kind = torch.arange(2000) % 2
    errors = torch.randn(2000, 1, generator=random) * torch.tensor([0.1, 1.0])[kind][:, None]
    raw = torch.zeros(2, requires_grad=True)
    loss = Blend(GaussianNLL(), FCal(50, 100, generator=random), 0.02)
    optimiser = torch.optim.Adam([raw], 0.2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 200)
    for _ in range(200):
        batch = torch.randperm(2000, generator=random)[:400]
        variance = bounded_variance(raw[kind[batch]], 1e-4, 1e2)[:, None]
        optimiser.zero_grad()
        loss(torch.zeros(400, 1), variance, errors[batch]).backward()
        optimiser.step()
        schedule.step()
    sigmas = bounded_variance(raw.detach(), 1e-4, 1e2).sqrt()
    sample = [float(errors[kind == each].square().mean().sqrt()) for each in (0, 1)]
    assert sigmas.tolist() == pytest.approx(sample, rel=0.05)


@given(st.integers(0, 1000), st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_full_covariances_whiten(seed: int, d: int) -> None:
    """|z|^2 is the squared Mahalanobis distance; a diagonal matrix is the same as variances."""
    A, error = normal(5, d, d, seed=seed), normal(5, d, seed=seed + 1)
    covariance = A @ A.mT + 0.1 * torch.eye(d, dtype=torch.float64)
    z = standardised(torch.zeros_like(error), covariance, error)
    distance = (error[:, None, :] @ torch.linalg.inv(covariance) @ error[:, :, None]).flatten()
    torch.testing.assert_close(z.square().sum(dim=1), distance, rtol=1e-6, atol=1e-9)
    variances = covariance.diagonal(dim1=1, dim2=2)
    torch.testing.assert_close(
        standardised(error, torch.diag_embed(variances), -error), standardised(error, variances, -error)
    )


def test_same_generator_same_loss() -> None:
    z = normal(300, 1)
    first, second = (float(of_residuals(FCal(generator=generator()), z)) for _ in range(2))
    assert first == second


def test_bounded_variance() -> None:
    raw = torch.tensor([-100.0, 0.0, 100.0], requires_grad=True)
    variance = bounded_variance(raw, 1e-3, 10.0)
    assert variance.tolist() == pytest.approx([1e-3, 0.1, 10.0])
    variance.sum().backward()
    assert bool(torch.isfinite(raw.grad).all())


def test_likelihood_by_hand() -> None:
    # Two components with sigma 1 and 2, errors 1 and 2: (1 + 1 + 2 ln 2 + 2 ln 2 pi)/2.
    mean, target = torch.zeros(1, 2), torch.tensor([[1.0, 2.0]])
    expected = 0.5 * (2.0 + 2.0 * math.log(2.0) + 2.0 * math.log(2.0 * math.pi))
    for covariance in (torch.tensor([[1.0, 4.0]]), torch.tensor([[[1.0, 0.0], [0.0, 4.0]]])):
        assert float(GaussianNLL()(mean, covariance, target)) == pytest.approx(expected)


def test_likelihood_of_matrices_agrees_with_torch() -> None:
    A, target = normal(6, 4, 4), normal(6, 4, seed=4)
    covariance = A @ A.mT + torch.eye(4, dtype=torch.float64)
    expected = -torch.distributions.MultivariateNormal(torch.zeros(6, 4).double(), covariance).log_prob(target).mean()
    assert float(GaussianNLL()(torch.zeros_like(target), covariance, target)) == pytest.approx(float(expected))


def test_calibration_loss_by_hand() -> None:
    # Variances 1 and 4, errors 1 and 3: (|1 - 1| + |4 - 9|)/2; as matrices also twice |0 - 3|, over 4 entries.
    mean, target = torch.zeros(1, 2, requires_grad=True), torch.tensor([[1.0, 3.0]])
    variances = torch.tensor([[1.0, 4.0]], requires_grad=True)
    loss = CalibrationLoss()(mean, variances, target)
    assert float(loss.detach()) == pytest.approx(2.5)
    assert float(CalibrationLoss()(mean.detach(), torch.diag_embed(variances.detach()), target)) == pytest.approx(
        (0 + 5 + 3 + 3) / 4
    )
    loss.backward()
    assert mean.grad is None


def test_blend_is_weighted() -> None:
    batch = (torch.zeros(1, 1), torch.ones(1, 1), torch.full((1, 1), 2.0))
    blended = Blend(GaussianNLL(), CalibrationLoss(), 0.25)(*batch)
    assert float(blended) == pytest.approx(0.75 * (2.0 + 0.5 * math.log(2.0 * math.pi)) + 0.25 * 3.0)


@pytest.mark.parametrize(
    ("z", "variance", "K", "text"),
    [
        (torch.ones(50, 1), torch.ones(50, 1), 100, "need more than 100 residuals"),
        (torch.ones(50, 3), torch.ones(50, 3), 100, "no multiple of the 3 components"),
        (torch.full((50, 1), torch.nan), torch.ones(50, 1), 10, "50 of 50 numbers of the target are not finite"),
        (torch.ones(50, 1), torch.zeros(50, 1), 10, "a variance is 0, not positive"),
        (torch.ones(50, 2), -torch.eye(2).expand(50, 2, 2), 10, "50 of 50 covariances are not positive definite"),
        (torch.ones(50, 2), torch.ones(50, 1), 10, r"the covariance \(N, d\) or \(N, d, d\)"),
    ],
)
def test_errors_say_what_is_wrong(z: Tensor, variance: Tensor, K: int, text: str) -> None:
    with pytest.raises(CalibrationError, match=text):
        FCal(K)(torch.zeros_like(z), variance, z)


def test_settings_are_checked() -> None:
    for wrong in ({"K": 0}, {"H": 1}, {"divergence": "js"}):
        with pytest.raises(CalibrationError):
            FCal(**wrong)
    with pytest.raises(CalibrationError, match="between 0 and 1"):
        Blend(GaussianNLL(), FCal(), 1.5)


def test_a_loss_that_is_not_finite_is_refused() -> None:
    """All squares alike: the fitted variance is 0."""
    z = torch.ones(300, 1)
    with pytest.raises(CalibrationError, match="the loss is inf"):
        Blend(GaussianNLL(), FCal(), 0.5)(torch.zeros_like(z), torch.ones_like(z), z)
