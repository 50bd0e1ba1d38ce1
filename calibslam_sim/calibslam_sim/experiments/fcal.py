"""`fcal`: chapter 4 of the document. Losses and recalibrations on two regressions, as the f-Cal paper compares them.

A condition is a regression and a method; docs/calibration.md says what each does and which data it sees.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from calibslam_detector.calibration.reliability import plot, reliability
from calibslam_detector.calibration.residuals import CalibrationError
from calibslam_detector.regressions import methods
from calibslam_detector.regressions.methods import METHODS, SUM_DEGREES, RegressionSettings
from calibslam_detector.regressions.tasks import TASKS
from calibslam_sim.experiments.design import (
    Experiment,
    ExperimentError,
    ExperimentSettings,
    Metric,
    Metrics,
    Seed,
    repetition_seed,
)
from calibslam_sim.experiments.figures import condition_figure


@dataclass(frozen=True)
class FcalSettings(RegressionSettings, ExperimentSettings):
    """f-Cal and the size of the regressions."""


VARIED = "curve"  # the regression on which f-Cal's settings are varied
F_CAL, WASSERSTEIN, PUBLISHED = "f_cal_kl", "f_cal_wasserstein", "f_cal_wasserstein_published"
# Method and what is changed. The last two draw nearly all of a batch, where the published loss is least right.
CHANGES: tuple[tuple[str, dict[str, Any]], ...] = (
    (F_CAL, {"degrees": 20}),
    (F_CAL, {"degrees": 90}),
    (F_CAL, {"sums": 50}),
    (F_CAL, {"sums": 1000}),
    (F_CAL, {"weight": 0.1}),
    (F_CAL, {"weight": 0.9}),
    (WASSERSTEIN, {"degrees": 90, "batch": 100}),
    (PUBLISHED, {"degrees": 90, "batch": 100}),
)
VARIANTS = {
    "_".join([VARIED, method, *(f"{name}_{value:g}" for name, value in changed.items())]): (method, changed)
    for method, changed in CHANGES
}
SHOWN = ("nll", "f_cal_kl", "f_cal_wasserstein", "temperature")  # in the reliability diagrams


def run(settings: FcalSettings, condition: str, seed: Seed) -> Metrics:
    """One condition on one seed."""
    task, method, changed = _meant(condition)
    return methods.run(task, method, replace(_regression(settings), **changed), _number(seed))


def _meant(condition: str) -> tuple[str, str, dict[str, Any]]:
    """The regression of a condition, its method, and the settings that it changes."""
    task, _, method = condition.partition("_")
    return (task, *VARIANTS[condition]) if condition in VARIANTS else (task, method, {})


def _regression(settings: FcalSettings) -> RegressionSettings:
    """Without what concerns the experiment only, so that equal regressions are equal settings."""
    return RegressionSettings(**{each.name: getattr(settings, each.name) for each in fields(RegressionSettings)})


def _number(seed: Seed) -> int:
    return int(seed.generate_state(1)[0])


def conditions(settings: FcalSettings) -> list[str]:
    """Every method on every regression, then the variants.

    Raises:
        ExperimentError: K does not fit the numbers of samples, or of components.
    """
    names = [f"{task}_{method}" for task in TASKS for method in METHODS] + list(VARIANTS)
    for name in names:  # before any process is started
        task, method, changed = _meant(name)
        try:
            methods.check(task, method, replace(_regression(settings), **changed))
        except CalibrationError as error:
            raise ExperimentError(f"{name}: {error}; change --degrees, --size or --batch") from error
    return names


def comparisons(settings: FcalSettings) -> list[tuple[str, str]]:
    """f-Cal against every method and its variants; with against without the correction."""
    pairs = [(f"{task}_{F_CAL}", f"{task}_{method}") for task in TASKS for method in METHODS if method != F_CAL]
    pairs += [(f"{VARIED}_{F_CAL}", variant) for variant, (method, _) in VARIANTS.items() if method == F_CAL]
    corrected = [name for name in conditions(settings) if WASSERSTEIN in name and PUBLISHED not in name]
    return pairs + [(name, name.replace(WASSERSTEIN, PUBLISHED)) for name in corrected]


def figure(result: dict[str, Any], path: Path) -> None:
    """Calibration errors of all conditions, and beside it reliability diagrams of the first repetition."""
    shown = {name: METRICS[name] for name in ("ece_z", "ece_q", "rmse")}
    condition_figure(path, EXPERIMENT.title, result, shown, list(result["conditions"]))
    settings = FcalSettings(**result["settings"])
    seed = _number(repetition_seed(settings.seed, 0))
    for task in TASKS:
        repetition = methods.case(task, _regression(settings), seed)
        predictions = {method: METHODS[method](repetition).z for method in SHOWN}
        for name, K in (("z", None), ("q", SUM_DEGREES)):
            curves = {method: reliability(z, K) for method, z in predictions.items()}
            title = f"{task}: residuals" if K is None else f"{task}: sums of {K} squares"
            plot(curves, path.with_name(f"reliability_{task}_{name}.png"), title)


METRICS = {
    "ece_z": Metric("ECE(z)"),
    "ece_q": Metric("ECE(q)"),
    "rmse": Metric("RMSE"),
    "mean_squared_z": Metric("mean z²", is_error=False),
    "coverage_90": Metric("coverage at 90 %", is_error=False),
    "nll": Metric("NLL"),
    "energy_score": Metric("energy score"),
    "sharpness": Metric("sharpness", is_error=False),
}

EXPERIMENT = Experiment(
    title="Losses for covariances on two regressions (chapter 4)",
    settings=FcalSettings,
    quick={"size": 0.2, "effort": 0.2, "steps": 60, "batch": 100, "degrees": 20},
    seeds=10,
    quick_seeds=2,
    metrics=METRICS,
    conditions=conditions,
    run=run,
    comparisons=comparisons,
    figure=figure,
)
