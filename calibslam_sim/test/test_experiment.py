"""The `experiment` command: what it writes, that it repeats and goes on after an interruption, what it refuses."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from calibslam_sim import experiment
from calibslam_sim.experiments import fingerprint, kalman
from calibslam_sim.experiments.design import ExperimentError, Metric, repetition_seed, scale_name
from calibslam_sim.experiments.engine import run
from calibslam_sim.experiments.figures import condition_figure
from calibslam_sim.experiments.kalman import KalmanSettings
from calibslam_sim.experiments.outputs import mean_and_deviation, p_value
from calibslam_sim.experiments.run_store import REPETITIONS, SETTINGS, Repetition, RunStore
from calibslam_sim.experiments.statistics import half_interval, nees_interval, paired, summary

CODE = "0.1.0+abc"
QUICK = ("kalman", "--quick", "--steps", "5", "--seeds", "4")


def call(out: Path, *options: str) -> dict[str, Any]:
    assert experiment.main([*QUICK, "--out", str(out), *options]) == 0
    result: dict[str, Any] = json.loads((out / "result.json").read_text())
    return result


def numbers(result: dict[str, Any]) -> tuple[Any, ...]:
    return result["conditions"], result["paired"], result["filter_graph_max_difference"]


def test_conditions_may_have_any_name(tmp_path: Path) -> None:
    """Those of `image` are named by who calls it."""
    names = ("x$^$", "nll")
    result = {"repetitions": 3, "conditions": {name: {"ate_m": summary([0.1, 0.2, 0.3])} for name in names}}
    condition_figure(tmp_path / "figure.png", "$^$", result, {"ate_m": Metric("ATE", "m")}, names)
    assert (tmp_path / "figure.png").stat().st_size > 5000


# -- statistics by hand -----------------------------------------------------------------------------------------------


def test_summary_by_hand() -> None:
    found = summary([1.0, 2.0, 6.0])
    assert found["mean"] == pytest.approx(3.0)
    assert found["std"] == pytest.approx(math.sqrt((4.0 + 1.0 + 9.0) / 2.0))
    assert found["values"] == [1.0, 2.0, 6.0]
    assert summary([1.0, math.nan, 3.0]) == {"mean": 2.0, "std": pytest.approx(math.sqrt(2.0)), "values": [1, None, 3]}
    assert summary([5.0])["std"] is None


def test_paired_by_hand() -> None:
    # Differences -1, -2, -3: mean -2, deviation 1, t = -2 / (1 / sqrt(3)), 2 degrees of freedom; the two-sided
    # p of t with 2 degrees of freedom is 1 - |t| / sqrt(t^2 + 2). Signed ranks: all of one sign, 2 / 2^3.
    found = paired([1.0, 1.0, 1.0], [2.0, 3.0, 4.0])
    t = 2.0 * math.sqrt(3.0)
    assert found["mean_difference"] == pytest.approx(-2.0)
    assert found["p_value"] == pytest.approx(1.0 - t / math.sqrt(t * t + 2.0))
    assert found["wilcoxon_p_value"] == pytest.approx(0.25)


def test_paired_is_scipys_paired_t_test() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=40), rng.normal(0.3, size=40)
    assert paired(list(a), list(b))["p_value"] == pytest.approx(stats.ttest_rel(a, b).pvalue)


def test_paired_without_difference_or_values() -> None:
    assert paired([1.0, 2.0], [1.0, 2.0]) == {"mean_difference": 0.0, "p_value": 1.0, "wilcoxon_p_value": 1.0}
    assert paired([1.0, math.nan], [1.0, 2.0])["p_value"] is None


def test_repetitions_that_share_a_recording_by_hand() -> None:
    """Each of three leaves out another tenth: 0.9 / 0.1 + 1 / 3 times the variance of one, t = -2 / sqrt(28 / 3)."""
    found = paired([1.0, 1.0, 1.0], [2.0, 3.0, 4.0], left_out=0.1)
    t = 2.0 / math.sqrt(28.0 / 3.0)
    assert found["mean_difference"] == pytest.approx(-2.0)
    assert found["p_value"] == pytest.approx(1.0 - t / math.sqrt(t * t + 2.0))
    assert found["wilcoxon_p_value"] is None
    assert half_interval([1.0, 2.0, 3.0], left_out=0.1) == pytest.approx(4.303 * math.sqrt(28.0 / 3.0), rel=1e-3)


@pytest.mark.parametrize("left_out", [0.1, 2.0 / 3.0, 0.9])
def test_repetitions_that_share_a_recording_find_no_difference_where_there_is_none(left_out: float) -> None:
    """Means over most of 240 images whose differences are noise; taken for independent, four fifths of those that leave
    out a tenth are significant."""
    rng = np.random.default_rng(2)
    p, naive = [], []
    for _ in range(400):
        images = rng.normal(size=240)
        means = [float(images[rng.random(240) >= left_out].mean()) for _ in range(10)]
        p.append(paired(means, [0.0] * 10, left_out)["p_value"] or 0.0)
        naive.append(paired(means, [0.0] * 10)["p_value"] or 0.0)
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.08
    assert np.mean(np.array(naive) < 0.05) > (0.3 if left_out < 0.7 else 0.1)


def test_paired_finds_no_difference_where_there_is_none() -> None:
    """One in twenty p-values is below 0.05."""
    rng = np.random.default_rng(1)
    found = [paired(list(rng.normal(size=10)), list(rng.normal(size=10)))["p_value"] for _ in range(400)]
    assert stats.kstest(found, "uniform").pvalue > 0.01


def test_nees_interval() -> None:
    # 2.5 and 97.5 % of chi-squared with 3 degrees of freedom, from a printed table.
    assert nees_interval(3, 1) == pytest.approx((0.216, 9.348), abs=1e-3)
    low, high = nees_interval(3, 200)
    assert (low, high) == pytest.approx((3.0 - 1.96 * math.sqrt(6 / 200), 3.0 + 1.96 * math.sqrt(6 / 200)), abs=0.02)


def test_half_interval() -> None:
    assert half_interval([1.0, 3.0]) == pytest.approx(12.706 * math.sqrt(2.0) / math.sqrt(2.0), rel=1e-4)
    assert half_interval([1.0]) == 0.0


def test_numbers_in_tables() -> None:
    assert mean_and_deviation(0.98765, 0.356) == "0.988 ± 0.36"
    assert mean_and_deviation(1223.0, 5512.0) == "1220 ± 5500"
    assert mean_and_deviation(0.0909, 2.1e-13) == "0.0909 ± 2.1e-13"
    assert mean_and_deviation(3.0, None) == "3"
    assert mean_and_deviation(None, None) == "-"
    assert (p_value(0.012), p_value(3.2e-7), p_value(1e-40)) == ("0.012", "3e-07", "<1e-16")


# -- the command ------------------------------------------------------------------------------------------------------


def test_contract_of_the_result(tmp_path: Path) -> None:
    result = call(tmp_path / "a", "--jobs", "1")
    assert {"calibrated", "underconfident", "overconfident", "scale_0.125", "scale_8"} <= set(result["conditions"])
    for metrics in result["conditions"].values():
        assert {"mse"} <= set(metrics)
        for found in metrics.values():
            assert set(found) == {"mean", "std", "values"}
            assert len(found["values"]) == 4
            assert found["mean"] == pytest.approx(np.mean(found["values"]))
    pair = result["paired"]["calibrated_vs_underconfident"]["mse"]
    values = [result["conditions"][name]["mse"]["values"] for name in ("calibrated", "underconfident")]
    assert pair["mean_difference"] == pytest.approx(np.mean(np.subtract(*values)))
    assert 0.0 <= pair["p_value"] <= 1.0
    assert result["filter_graph_max_difference"] < 1e-9
    assert "experiment kalman --quick" in result["command"]
    assert result["seconds"] > 0.0
    assert (tmp_path / "a" / "kalman.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "a" / "result.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * len(result["conditions"])
    assert [float(row["mse"]) for row in rows if row["condition"] == "calibrated"] == values[0]


def test_the_number_of_processes_changes_nothing(tmp_path: Path) -> None:
    alone, together = call(tmp_path / "a", "--jobs", "1"), call(tmp_path / "b", "--jobs", "2")
    assert numbers(alone) == numbers(together)
    # Which gives its results in batches, as Ray's.
    other = call(tmp_path / "c", "--jobs", "1", "--backend", "sequential")
    assert numbers(other) == numbers(alone)


def test_another_seed_gives_other_numbers(tmp_path: Path) -> None:
    assert numbers(call(tmp_path / "a", "--jobs", "1")) != numbers(call(tmp_path / "b", "--jobs", "1", "--seed", "1"))


def test_it_goes_on_where_it_was_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = call(tmp_path / "whole", "--jobs", "1")

    def interrupted(*args: Any) -> Any:
        for number, repetition in enumerate(run(*args)):
            if number == 7:
                raise KeyboardInterrupt
            yield repetition

    out = tmp_path / "parts"
    monkeypatch.setattr(experiment, "run", interrupted)
    assert experiment.main([*QUICK, "--out", str(out), "--jobs", "1"]) == 130
    lines = (out / REPETITIONS).read_text().splitlines()
    assert len(lines) == 7
    (out / REPETITIONS).write_text("\n".join(lines) + '\n{"condition": "cal')  # as a crash leaves it

    computed = []

    def counted(*args: Any) -> Any:
        for repetition in run(*args):
            computed.append(repetition)
            yield repetition

    monkeypatch.setattr(experiment, "run", counted)
    assert numbers(call(out, "--jobs", "1")) == numbers(whole)
    assert len(computed) == 4 * len(whole["conditions"]) - 7
    computed.clear()
    more = call(out, "--jobs", "1", "--seeds", "5")
    assert len(computed) == len(whole["conditions"])
    assert more["conditions"]["calibrated"]["mse"]["values"][:4] == whole["conditions"]["calibrated"]["mse"]["values"]


def test_other_settings_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call(tmp_path, "--jobs", "1")
    assert experiment.main([*QUICK, "--out", str(tmp_path), "--jobs", "1", "--acceleration", "0.7"]) == 1
    message = capsys.readouterr().err
    assert "acceleration = 0.3 there, 0.7 now" in message
    assert "--overwrite" in message
    call(tmp_path, "--jobs", "1", "--acceleration", "0.7", "--overwrite")


def test_another_experiment_is_refused(tmp_path: Path) -> None:
    RunStore(tmp_path, "toy", KalmanSettings(), CODE, {})
    with pytest.raises(ExperimentError, match="holds the experiment toy"):
        RunStore(tmp_path, "kalman", KalmanSettings(), CODE, {})


def test_what_other_code_has_computed_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call(tmp_path, "--jobs", "1")
    header = json.loads((tmp_path / SETTINGS).read_text())
    assert header["code"] == fingerprint.fingerprint()
    for before in ({**header, "code": "0.0.9+123"}, {k: v for k, v in header.items() if k != "code"}):
        (tmp_path / SETTINGS).write_text(json.dumps(before))
        assert experiment.main([*QUICK, "--out", str(tmp_path), "--jobs", "1"]) == 1
        said = capsys.readouterr().err
        assert f"{before.get('code', 'unknown')} there, {header['code']} now" in said and "--overwrite" in said
    assert call(tmp_path, "--jobs", "1", "--overwrite")["code"] == header["code"]


def test_what_was_computed_from_other_files_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same path does not make it the same file."""
    file = tmp_path / "weights.pt"
    file.write_bytes(b"old")
    monkeypatch.setattr(kalman, "EXPERIMENT", replace(kalman.EXPERIMENT, inputs=lambda settings: {"weights": file}))
    out = tmp_path / "out"
    done = numbers(call(out, "--jobs", "1"))
    assert json.loads((out / SETTINGS).read_text())["inputs"] == fingerprint.file_hashes({"weights": file})
    file.write_bytes(b"new")
    assert experiment.main([*QUICK, "--out", str(out), "--jobs", "1"]) == 1
    said = capsys.readouterr().err
    assert "files that are others now, by their content (weights)" in said and "--overwrite" in said
    file.write_bytes(b"old")
    assert numbers(call(out, "--jobs", "1")) == done


def test_the_fingerprint_tells_sources_apart(tmp_path: Path) -> None:
    """Content and names count, what is no source and where it lies do not."""
    hashes = []
    for n, files in enumerate(({"a.py": "1"}, {"a.py": "1", "a.txt": "2"}, {"a.py": "2"}, {"b.py": "1"}, {})):
        folder = tmp_path / str(n)
        folder.mkdir()
        for name, content in files.items():
            (folder / name).write_text(content)
        hashes.append(fingerprint.sources_hash([("package", folder)]))
    assert hashes[0] == hashes[1] and len(set(hashes)) == 4
    assert all(re.fullmatch("[0-9a-f]{12}", each) for each in hashes)


def test_a_folder_that_is_none_of_ours_is_refused(tmp_path: Path) -> None:
    (tmp_path / SETTINGS).write_text("[1, 2]")
    with pytest.raises(ExperimentError, match="not of an experiment"):
        RunStore(tmp_path, "kalman", KalmanSettings(), CODE, {})


def test_a_bad_line_is_named(tmp_path: Path) -> None:
    RunStore(tmp_path, "kalman", KalmanSettings(), CODE, {}).add(Repetition("calibrated", 0, {"mse": math.nan}, 0.1))
    store = RunStore(tmp_path, "kalman", KalmanSettings(), CODE, {})
    assert math.isnan(store.values(["calibrated"], 1)["calibrated"]["mse"][0])
    with (tmp_path / REPETITIONS).open("a") as file:
        file.write("nonsense\n")
    with pytest.raises(ExperimentError, match=f"{REPETITIONS}:2"):
        RunStore(tmp_path, "kalman", KalmanSettings(), CODE, {})


def test_what_is_wrong_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = (["--seeds", "0"], ["--jobs", "0"], ["--qui"])
    out = ["--out", str(tmp_path / "x")]
    for arguments in (["nonsense", *out], *(["kalman", *out, *w] for w in wrong), ["kalman"], []):
        with pytest.raises(SystemExit) as stop:
            experiment.main(arguments)
        assert stop.value.code == 2
    assert "kalman" in capsys.readouterr().err
    assert experiment.main([*QUICK, "--out", str(tmp_path), "--backend", "nonsense"]) == 1
    assert "--backend nonsense" in capsys.readouterr().err


def test_an_error_says_where(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no condition") as caught:
        list(run("kalman", KalmanSettings(), [("nonsense", 3)], 1, "loky"))
    assert "condition nonsense, repetition 3" in caught.value.__notes__[0]


def test_seeds_are_spawned() -> None:
    spawned = np.random.SeedSequence(5).spawn(4)[3]
    assert repetition_seed(5, 3).generate_state(4).tolist() == spawned.generate_state(4).tolist()


# -- kalman -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("condition", kalman.conditions(KalmanSettings()))
def test_filter_and_graph_agree(condition: str) -> None:
    settings = KalmanSettings(steps=40)
    assert kalman.run(settings, condition, repetition_seed(1, 2))["filter_graph_difference"] < 1e-9


def test_first_step_of_the_filter_by_hand() -> None:
    # On each axis: P' = F diag(1, 1) F' + Q = [[2 + q/3, 1 + q/2], [.., 1 + q]] with q = 0.09, so the gain is
    # K = (2.03, 1.045) / (2.03 + 4) for R = 4.
    model = kalman.constant_velocity(KalmanSettings(position_sigma=2.0))
    states, covariances = kalman.kalman_filter(model, np.array([[3.0, -6.0]]))
    K = np.array([2.03, 1.045]) / 6.03
    np.testing.assert_allclose(states[0], [3 * K[0], -6 * K[0], 3 * K[1], -6 * K[1]])
    np.testing.assert_allclose(covariances[0][0, 0], (1.0 - K[0]) * 2.03)
    np.testing.assert_allclose(covariances[0][2, 2], 1.09 - K[1] * 1.045)
    np.testing.assert_allclose(covariances[0][0, 1], 0.0)


def test_the_truth_is_best_and_honest() -> None:
    """MSE at scale 1 below both neighbours (paired t, p < 0.01); NEES inside its interval there only."""
    settings = KalmanSettings(steps=30)
    truth = kalman.constant_velocity(settings)
    errors: dict[float, list[float]] = {scale: [] for scale in (0.5, 1.0, 2.0)}
    nees: dict[float, list[float]] = {scale: [] for scale in errors}
    for number in range(300):
        states, measured = kalman.simulate(truth, settings.steps, np.random.default_rng(repetition_seed(0, number)))
        for scale, found in errors.items():
            filtered, covariances = kalman.kalman_filter(kalman.believed(truth, scale_name(scale)), measured)
            error = filtered - states
            found.append(float(np.mean(error[:, :2] ** 2)))
            nees[scale].append(float(error[-1] @ np.linalg.solve(covariances[-1], error[-1])))
    for other in (0.5, 2.0):
        found_pair = paired(errors[1.0], errors[other])
        assert found_pair["mean_difference"] < 0.0 and found_pair["p_value"] < 0.01
    low, high = nees_interval(4, 300)
    assert [low <= np.mean(nees[scale]) <= high for scale in (0.5, 1.0, 2.0)] == [False, True, False]
