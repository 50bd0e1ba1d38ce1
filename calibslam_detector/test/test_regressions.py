"""The two regressions: what is drawn, that training repeats itself, and that f-Cal is better calibrated."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from calibslam_detector.calibration.f_cal import kl, wasserstein
from calibslam_detector.regressions.methods import METHODS, RegressionSettings, case, f_cal, run
from calibslam_detector.regressions.network import Regressor
from calibslam_detector.regressions.tasks import BLURS, LABEL_SIGMA_PER_BLUR, SIDE, TASKS, UNIT, bokeh, curve

SMALL = RegressionSettings(degrees=20, sums=50, batch=60, steps=20, size=0.1, effort=0.1)


def test_curve_has_the_noise_it_says() -> None:
    samples = curve(20000, torch.Generator().manual_seed(0))
    x = samples.x
    mean = torch.sin(torch.pi * x) + 0.5 * torch.sin(7.0 * torch.pi * x) + 0.3 * torch.cos(12.0 * torch.pi * x)
    z = (samples.y - mean) / samples.sigma
    # The variance of a mean of 20000 squared normals is 2/20000.
    assert float(z.square().mean()) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 20000))
    assert float(samples.sigma.min()) >= 0.05 and float(samples.sigma.max()) <= 0.5


def test_bokeh_shows_its_noise() -> None:
    """The disc is where the label says; a picture with more blur is darker and its label worse."""
    samples = bokeh(4000, torch.Generator().manual_seed(0))
    assert samples.x.shape == (4000, 1, SIDE, SIDE) and samples.y.shape == (4000, 2)
    sigma_px = samples.sigma * UNIT
    assert float(sigma_px.min()) >= LABEL_SIGMA_PER_BLUR * BLURS[0] - 1e-6
    assert float(sigma_px.max()) <= LABEL_SIGMA_PER_BLUR * BLURS[1] + 1e-6
    peaks = samples.x.flatten(1).max(dim=1)
    assert float(torch.corrcoef(torch.stack([peaks.values, samples.sigma[:, 0]]))[0, 1]) < -0.8
    sharp = samples.sigma[:, 0] < 0.06
    column, row = peaks.indices[sharp] % SIDE + 0.5, peaks.indices[sharp] // SIDE + 0.5
    label = samples.y[sharp] * UNIT + SIDE / 2.0
    assert float(torch.hypot(label[:, 0] - column, label[:, 1] - row).median()) < 1.5


@pytest.mark.parametrize("method", list(METHODS))
def test_every_method_runs(method: str) -> None:
    result = run("curve", method, SMALL, seed=1)
    assert 0.0 <= result["ece_z"] <= 0.5 and 0.0 <= result["ece_q"] <= 0.5
    assert math.isnan(result["nll"]) == (method == "isotonic")


@pytest.mark.parametrize("task", list(TASKS))
def test_fewer_samples_than_a_batch_are_learnt_from(task: str) -> None:
    repetition = case(task, RegressionSettings(size=0.05), 3)
    assert len(repetition.training) < repetition.task.batch
    with torch.random.fork_rng():
        torch.manual_seed(3)
        fresh = Regressor(repetition.training)
    trained = repetition.network.state_dict()
    assert all(not torch.equal(value, trained[name]) for name, value in fresh.state_dict().items())


def test_wasserstein_pulls_as_kl_does_on_a_common_factor() -> None:
    """Sums of K squares of residuals 2 % too large have the variance 2K 1.02^4 and are off by K (1.02^2 - 1)."""
    repetition = case("curve", RegressionSettings(size=0.05, effort=0.05, degrees=40), 3)
    variance, bias = torch.tensor(80.0 * 1.02**4), torch.tensor(40.0 * (1.02**2 - 1.0))
    pulls = []
    for name, divergence in (("kl", kl), ("wasserstein", wasserstein)):
        weight = f_cal(repetition, name, 0.3).weight
        pulls.append(weight / (1.0 - weight) * float(divergence(variance, bias**2, 40.0)))
    assert pulls[1] == pytest.approx(pulls[0], rel=0.1)


def test_same_seed_same_numbers() -> None:
    assert run("bokeh", "f_cal_kl", SMALL, 3) == run("bokeh", "f_cal_kl", SMALL, 3)


@pytest.mark.parametrize("task", list(TASKS))
def test_f_cal_is_better_calibrated_than_likelihood(task: str) -> None:
    """Two seeds: ECE(z) and ECE(q) at most 0.7 and 0.4 of the likelihood's, the same mean.

    The full comparison is the experiment `fcal`.
    """
    settings = RegressionSettings()
    results = {m: [run(task, m, settings, seed) for seed in range(2)] for m in ("nll", "f_cal_kl")}
    mean = {m: {name: np.mean([r[name] for r in found]) for name in found[0]} for m, found in results.items()}
    assert mean["f_cal_kl"]["ece_z"] < 0.7 * mean["nll"]["ece_z"]
    assert mean["f_cal_kl"]["ece_q"] < 0.4 * mean["nll"]["ece_q"]
    assert mean["f_cal_kl"]["rmse"] == pytest.approx(mean["nll"]["rmse"])
    assert mean["f_cal_kl"]["nll"] < mean["nll"]["nll"]
