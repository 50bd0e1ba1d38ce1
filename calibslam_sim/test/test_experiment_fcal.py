"""The experiment `fcal`: its conditions are there, repeat themselves, and its figures are drawn."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from calibslam_sim.experiments import fcal
from calibslam_sim.experiments.design import ExperimentError, repetition_seed
from calibslam_sim.experiments.fcal import VARIANTS, FcalSettings, comparisons, conditions, run

SMALL = FcalSettings(degrees=20, sums=50, batch=100, steps=10, size=0.2, effort=0.05)


def test_comparisons_are_of_conditions() -> None:
    known = conditions(SMALL)
    assert len(set(known)) == len(known)
    pairs = comparisons(SMALL)
    assert len(set(pairs)) == len(pairs)
    assert {name for pair in pairs for name in pair} <= set(known)
    assert ("bokeh_f_cal_kl", "bokeh_nll") in pairs and set(VARIANTS) <= set(known)


def test_variants_change_what_they_say() -> None:
    """A variant equals f-Cal with that setting; the mean, and so the RMSE, is the same."""
    seed = repetition_seed(0, 3)
    variant = run(SMALL, "curve_f_cal_kl_weight_0.9", seed)
    assert variant == run(replace(SMALL, weight=0.9), "curve_f_cal_kl", seed)
    plain = run(SMALL, "curve_f_cal_kl", seed)
    assert variant["ece_z"] != plain["ece_z"] and variant["rmse"] == plain["rmse"]


def test_a_condition_that_is_not_there_is_refused() -> None:
    with pytest.raises(KeyError):
        run(SMALL, "curve_magic", repetition_seed(0, 0))


def test_sums_that_cannot_be_made_are_said() -> None:
    """Before anything is computed, and with what to do."""
    for settings, says in (
        (FcalSettings(degrees=25), "bokeh_f_cal_kl: K = 25 is no multiple of the 2 components"),
        (FcalSettings(size=0.05), "curve_f_cal_end_to_end: sums of K = 50 squares need more than 50 residuals"),
        (FcalSettings(batch=80), "curve_f_cal_cramer: two sums of K = 50 squares need 100 residuals of 1; got 80"),
    ):
        with pytest.raises(ExperimentError, match=f"{says}.*; change --degrees, --size or --batch"):
            conditions(settings)
    assert conditions(FcalSettings(size=0.05, degrees=20)) == conditions(FcalSettings())


def test_figures(tmp_path: Path) -> None:
    numbers = {"mean": 0.1, "std": 0.01, "values": [0.09, 0.11]}
    found = dict.fromkeys(fcal.METRICS, numbers)
    result = {"settings": asdict(SMALL), "repetitions": 2, "conditions": {"curve_nll": found, "curve_f_cal_kl": found}}
    fcal.figure(result, tmp_path / "fcal.png")
    drawn = {path.name for path in tmp_path.iterdir()}
    diagrams = {f"reliability_{task}_{kind}.png" for task in ("curve", "bokeh") for kind in "zq"}
    assert drawn == {"fcal.png"} | diagrams
