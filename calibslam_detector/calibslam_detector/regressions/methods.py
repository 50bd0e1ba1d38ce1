"""The methods that are compared: each makes standardised residuals, and mostly covariances, for test data.

All see the same labelled samples, split alike: `training`, from which means are learned, and `held_out`, with which
the likelihood (as all others) chooses its best epoch, and from which calibration is learned.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn

from calibslam_detector.calibration import metrics
from calibslam_detector.calibration.epistemic import ensemble, monte_carlo_dropout
from calibslam_detector.calibration.f_cal import FCal
from calibslam_detector.calibration.f_cal_cramer import FCalCramer
from calibslam_detector.calibration.losses import Blend, CalibrationLoss, GaussianNLL
from calibslam_detector.calibration.recalibration import IsotonicRecalibration, TemperatureScaling
from calibslam_detector.regressions.network import DROPOUT, Regressor, fine_tune, train
from calibslam_detector.regressions.tasks import TASKS, Samples, Task
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import Settings, setting

SUM_DEGREES = 50  # K of ECE(q), whatever that of the loss
ENERGY_SAMPLES = 20  # for each of some 10,000 test samples
MEMBERS = 3  # of an ensemble
DROPOUT_SAMPLES = 20
CHOOSING_SHARE = 0.2  # of the held-out samples still held out where all others are learned from
CALIBRATION_LOSS_WEIGHT = 0.5
# lambda where f-Cal trains the whole network on the training samples. With 0.002 little changes; with 0.2 the mean is
# lost: its error grew 2.4 and 1.4 times.
END_TO_END_WEIGHT = 0.02


@dataclass(frozen=True)
class RegressionSettings(Settings):
    """f-Cal, and the size of the regressions."""

    degrees: int = setting(50, "K, degrees of freedom of f-Cal's sums", low=2)
    sums: int = setting(200, "H, sums that f-Cal draws", low=2)
    weight: float = setting(
        0.5, "lambda of f-Cal with KL, and with the distance of Cramer and von Mises", low=0.0, high=1.0
    )
    batch: int = setting(1000, "held-out samples in a step of fine-tuning", low=2)
    steps: int = setting(300, "of fine-tuning the variances", low=1)
    size: float = setting(1.0, "factor on the numbers of samples", low=0.05)
    effort: float = setting(1.0, "factor on the number of epochs", low=0.05)


@dataclass(frozen=True)
class Case:
    """One repetition of a regression: its samples, and the network that the likelihood has trained."""

    task: Task
    training: Samples
    held_out: Samples
    test: Samples
    network: Regressor
    settings: RegressionSettings
    seed: int

    def train(self, loss: nn.Module, seed_offset: int = 0, dropout: float = 0.0) -> Regressor:
        """Another network, trained as the likelihood's."""
        return train(self.task, self.training, self.held_out, loss, self.seed + seed_offset, dropout)

    def fine_tune(self, loss: nn.Module) -> Regressor:
        """The likelihood's network with variances trained further on the held-out samples."""
        return fine_tune(self.network, self.held_out, loss, self.seed, self.settings.steps, self.settings.batch)


@dataclass(frozen=True)
class Prediction:
    """For the test samples: errors (N, d), standardised residuals (N, d), and variances (N, d) unless what is
    predicted is no normal distribution.
    """

    errors: Array
    z: Array
    variances: Array | None


def case(name: str, settings: RegressionSettings, seed: int) -> Case:
    """Samples and the likelihood's network, of a key of `TASKS`; the same for every method."""
    return Case(*_common(name, settings.size, settings.effort, seed), settings, seed)


def sized(name: str, size: float, effort: float) -> Task:
    """A key of `TASKS` with factors on its numbers of samples and of epochs."""
    task = TASKS[name]
    sizes = {part: max(1, round(size * getattr(task, part))) for part in ("training", "held_out", "test")}
    return replace(task, **sizes, epochs=max(1, round(effort * task.epochs)))


def check(name: str, method: str, settings: RegressionSettings) -> None:
    """Whether steps have the residuals that a method (key of `METHODS`) needs on a regression (key of `TASKS`).

    Raises:
        CalibrationError: f-Cal's sums cannot be made of them.
    """
    task, K = sized(name, settings.size, settings.effort), settings.degrees
    loss: nn.Module
    if method == "f_cal_cramer":
        loss = FCalCramer((1, K), generator=torch.Generator())
    elif method.startswith("f_cal"):
        loss = FCal(K, generator=torch.Generator())
    else:
        return
    n = min(task.batch, task.training) if method == "f_cal_end_to_end" else min(settings.batch, task.held_out)
    residuals = torch.zeros(n, task.components)
    loss(residuals, torch.ones_like(residuals), residuals)


@lru_cache(maxsize=32)
def _common(name: str, size: float, effort: float, seed: int) -> tuple[Task, Samples, Samples, Samples, Regressor]:
    """What does not depend on f-Cal's settings; kept, as every method begins with it."""
    task = sized(name, size, effort)
    generator = torch.Generator().manual_seed(seed)
    training, held_out = task.draw(task.training + task.held_out, generator).split(task.training)
    test = task.draw(task.test, generator)
    return task, training, held_out, test, train(task, training, held_out, GaussianNLL(), seed)


def predicted(predict: Callable[[Tensor], tuple[Tensor, Tensor]], samples: Samples) -> Prediction:
    """What a network says about samples."""
    with torch.no_grad():
        mean, variance = predict(samples.x)
    errors, variances = (samples.y - mean).double().numpy(), variance.double().numpy()
    return Prediction(errors, metrics.whitened(errors, variances), variances)


def f_cal(case: Case, divergence: str, weight: float, *, published: bool = False) -> Blend:
    """Eq. 4.2.6 with the likelihood as empirical risk."""
    settings = case.settings
    if divergence == "wasserstein":
        # The same pull on a common factor: W_2^2 is 4 K times as steep as KL.
        weight = weight / (weight + 4.0 * settings.degrees * (1.0 - weight))
    loss = FCal(
        settings.degrees,
        settings.sums,
        divergence,
        published=published,
        generator=torch.Generator().manual_seed(case.seed),
    )
    return Blend(GaussianNLL(), loss, weight)


def _nll(case: Case) -> Prediction:
    return predicted(case.network, case.test)


def _f_cal_kl(case: Case) -> Prediction:
    return predicted(case.fine_tune(f_cal(case, "kl", case.settings.weight)), case.test)


def _f_cal_wasserstein(case: Case) -> Prediction:
    return predicted(case.fine_tune(f_cal(case, "wasserstein", case.settings.weight)), case.test)


def _f_cal_wasserstein_published(case: Case) -> Prediction:
    loss = f_cal(case, "wasserstein", case.settings.weight, published=True)
    return predicted(case.fine_tune(loss), case.test)


def _f_cal_cramer(case: Case) -> Prediction:
    distance = FCalCramer((1, case.settings.degrees), generator=torch.Generator().manual_seed(case.seed))
    return predicted(case.fine_tune(Blend(GaussianNLL(), distance, case.settings.weight)), case.test)


def _f_cal_end_to_end(case: Case) -> Prediction:
    return predicted(case.train(f_cal(case, "kl", END_TO_END_WEIGHT)), case.test)


def _nll_fine_tuned(case: Case) -> Prediction:
    return predicted(case.fine_tune(GaussianNLL()), case.test)


def _nll_all_samples(case: Case) -> Prediction:
    more, choosing = case.held_out.split(round(len(case.held_out) * (1.0 - CHOOSING_SHARE)))
    network = train(case.task, case.training + more, choosing, GaussianNLL(), case.seed)
    return predicted(network, case.test)


def _calibration_loss(case: Case) -> Prediction:
    return predicted(case.train(Blend(GaussianNLL(), CalibrationLoss(), CALIBRATION_LOSS_WEIGHT)), case.test)


def _temperature(case: Case) -> Prediction:
    factor = TemperatureScaling.fit(predicted(case.network, case.held_out).z).factor
    return predicted(lambda x: (lambda mean, variance: (mean, factor**2 * variance))(*case.network(x)), case.test)


def _isotonic(case: Case) -> Prediction:
    plain = predicted(case.network, case.test)
    recalibrate = IsotonicRecalibration.fit(predicted(case.network, case.held_out).z)
    return Prediction(plain.errors, recalibrate(plain.z), None)


def _ensemble(case: Case) -> Prediction:
    members = [case.network, *(case.train(GaussianNLL(), 1000 * i) for i in range(1, MEMBERS))]
    return predicted(lambda x: ensemble(members, x), case.test)


def _dropout(case: Case) -> Prediction:
    network = case.train(GaussianNLL(), dropout=DROPOUT)
    return predicted(lambda x: monte_carlo_dropout(network, x, DROPOUT_SAMPLES, case.seed), case.test)


METHODS: dict[str, Callable[[Case], Prediction]] = {
    "nll": _nll,
    "f_cal_kl": _f_cal_kl,
    "f_cal_wasserstein": _f_cal_wasserstein,
    "f_cal_wasserstein_published": _f_cal_wasserstein_published,
    "f_cal_cramer": _f_cal_cramer,
    "f_cal_end_to_end": _f_cal_end_to_end,
    "nll_fine_tuned": _nll_fine_tuned,
    "nll_all_samples": _nll_all_samples,
    "temperature": _temperature,
    "isotonic": _isotonic,
    "calibration_loss": _calibration_loss,
    "ensemble": _ensemble,
    "dropout": _dropout,
}


def run(task: str, method: str, settings: RegressionSettings, seed: int) -> dict[str, float]:
    """Metrics of a method (key of `METHODS`) on a regression (key of `TASKS`); NaN: not defined for this method."""
    prediction = METHODS[method](case(task, settings, seed))
    z, errors, variances = prediction.z, prediction.errors, prediction.variances
    result = {
        "ece_z": metrics.ece_z(z),
        "ece_q": metrics.ece_q(z, SUM_DEGREES),
        "rmse": float(np.sqrt(np.mean(np.square(errors)))),
        "mean_squared_z": float(np.mean(np.square(z))),
        "coverage_90": float(metrics.coverage(z, np.array([0.9]))[0]),
    }
    if variances is None:
        return result | {"nll": math.nan, "energy_score": math.nan, "sharpness": math.nan}
    return result | {
        "nll": metrics.negative_log_likelihood(errors, variances),
        "energy_score": metrics.energy_score(errors, variances, np.random.default_rng(seed), ENERGY_SAMPLES),
        "sharpness": metrics.sharpness(variances),
    }
