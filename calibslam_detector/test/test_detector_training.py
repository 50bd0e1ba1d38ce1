"""Training on tiny images: it learns, it can be interrupted, and what is wrong with the data is said or counted."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from full_disk import full_disk

from calibslam_detector import evaluate_detector, train
from calibslam_detector.images.coco_data import CocoData, DataError, ImageTruth, TrainingImages, load_coco_data
from calibslam_detector.model import weights_file
from calibslam_detector.model.network import CalibratedDetector
from calibslam_detector.model.region_cues import CUES
from calibslam_detector.model.weights_file import WeightsError
from calibslam_detector.training.checkpoint import TrainingError
from calibslam_detector.training.covariance_task import LOSSES, Examples, covariance_task
from calibslam_detector.training.training_loop import LoopSettings, Task, batch_of, optimise
from calibslam_msgs_py import progress
from calibslam_msgs_py.measurements import Boxes

COLOURS = {"cup": (40, 40, 220), "book": (220, 60, 40)}
FAST = ["--batch", "2", "--log-every", "1", "--warm-up", "0"]


def make_data(folder: Path, count: int = 4) -> dict[str, Any]:
    """Images of one coloured rectangle of each class, and their json."""
    rng = np.random.default_rng(5)
    (folder / "images").mkdir(parents=True)
    images, annotations = [], []
    for k in range(count):
        image = rng.integers(0, 60, (96, 128, 3), dtype=np.uint8)
        for label, colour in enumerate(COLOURS.values(), 1):
            x, y = int(rng.integers(2, 40)) + 50 * (label - 1), int(rng.integers(2, 50))
            w, h = (int(v) for v in rng.integers(20, 36, 2))
            cv2.rectangle(image, (x, y), (x + w - 1, y + h - 1), colour, cv2.FILLED)
            annotations.append(
                {"id": len(annotations) + 1, "image_id": k, "category_id": label, "bbox": [x, y, w, h], "iscrowd": 0}
            )
        cv2.imwrite(str(folder / "images" / f"{k}.png"), image)
        images.append({"id": k, "file_name": f"{k}.png", "width": 128, "height": 96})
    content = {
        "images": images,
        "annotations": annotations,
        "categories": [{"id": k, "name": name} for k, name in enumerate(COLOURS, 1)],
    }
    (folder / "annotations.json").write_text(json.dumps(content))
    return content


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    make_data(folder)
    return folder


def rows(run: Path) -> list[dict[str, str]]:
    with (run / "log.csv").open() as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def same_weights(a: Path, b: Path) -> bool:
    first, second = (weights_file.load(run / "weights.pt").state_dict() for run in (a, b))
    return all(torch.equal(value, second[name]) for name, value in first.items())


# -- data ---------------------------------------------------------------------------------------------------------


def test_what_is_wrong_with_annotations_is_counted(tmp_path: Path) -> None:
    content = make_data(tmp_path)
    good = len(content["annotations"])
    base = content["annotations"][0]
    content["annotations"] += [
        {**base, "image_id": 99},
        {**base, "category_id": 7},
        {**base, "bbox": [1, 2, 0, 5]},
        {**base, "bbox": [1, 2, float("nan"), 5]},
        {"image_id": 0, "category_id": 1},
    ]
    content["images"].append({"id": 50, "file_name": "gone.png"})
    (tmp_path / "annotations.json").write_text(json.dumps(content))
    data = load_coco_data(tmp_path / "annotations.json", tmp_path / "images")
    assert data.left_out == {
        "annotation of an unknown image": 1,
        "annotation of an unknown class": 1,
        "empty box": 2,
        "annotation without bbox": 1,
        "image file missing": 1,
    }
    assert data.class_names == ("cup", "book") and sum(len(image.boxes) for image in data.images) == good
    x, y, w, h = base["bbox"]
    assert data.images[0].boxes[0].tolist() == [x, y, x + w, y + h]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "are not JSON"),
        ("[]", "is not COCO json"),
        ('{"images": [], "annotations": [], "categories": [{"id": 1, "name": "cup"}]}', "no image with a box"),
    ],
)
def test_a_file_that_is_no_data_set_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DataError, match=message):
        load_coco_data(tmp_path / "a.json", tmp_path)
    with pytest.raises(DataError, match="cannot be read"):
        load_coco_data(tmp_path / "none.json", tmp_path)


def test_boxes_of_whole_objects_can_be_learnt(tmp_path: Path) -> None:
    content = make_data(tmp_path)
    with pytest.raises(DataError, match=r"annotation without amodal_bbox \(8\)"):
        load_coco_data(tmp_path / "annotations.json", tmp_path / "images", box_key="amodal_bbox")
    for annotation in content["annotations"]:
        annotation["amodal_bbox"] = [1, 2, 3, 4]
    (tmp_path / "annotations.json").write_text(json.dumps(content))
    data = load_coco_data(tmp_path / "annotations.json", tmp_path / "images", box_key="amodal_bbox")
    assert all((image.boxes == [1, 2, 4, 6]).all() for image in data.images)


def test_classes_are_those_of_the_detector(data: Path) -> None:
    known = load_coco_data(data / "annotations.json", data / "images", ("chair", "book"))
    assert {int(label) for image in known.images for label in image.labels} == {2}
    assert known.left_out["annotation of an unknown class"] == 4
    with pytest.raises(DataError, match="has no class of sofa"):
        load_coco_data(data / "annotations.json", data / "images", ("sofa",))


def test_mirrored_boxes_stay_on_their_objects(data: Path) -> None:
    images = TrainingImages(load_coco_data(data / "annotations.json", data / "images"))
    mirrored = 0
    for seed in range(8):
        image, target = images[(0, seed)]
        again, _ = images[(0, seed)]
        assert torch.equal(image, again)
        for box, label in zip(target["boxes"].int().tolist(), target["labels"].tolist(), strict=True):
            patch = image[:, box[1] : box[3], box[0] : box[2]].mean(dim=(1, 2))
            assert patch.argmax() == (0 if label == 1 else 2)  # red cup, blue book
        mirrored += int(target["boxes"][0, 0] > 40)
    assert 0 < mirrored < 8


def test_every_sample_comes_once_per_epoch() -> None:
    epoch = np.concatenate([batch_of(step, 3, 12, seed=1) for step in range(4)])
    assert sorted(epoch) == list(range(12))
    following = np.concatenate([batch_of(step, 3, 12, seed=1) for step in range(4, 8)])
    assert sorted(following) == list(range(12)) and not np.array_equal(epoch, following)
    across = np.concatenate([batch_of(step, 5, 12, seed=1) for step in range(12)])
    assert np.array_equal(np.bincount(across), np.full(12, 5))


# -- stage detector -----------------------------------------------------------------------------------------------


def test_an_interrupted_training_ends_as_one_in_one_go(data: Path, tmp_path: Path) -> None:
    options = [str(data), *FAST, "--steps", "4", "--checkpoint-every", "2"]
    assert train.main([*options, "--out", str(tmp_path / "once")]) == 0
    interrupted = [*options, "--out", str(tmp_path / "twice")]
    timer = threading.Thread(target=interrupt_after_a_line, args=(tmp_path / "twice" / "log.csv",))
    timer.start()
    assert train.main(interrupted) == 130
    timer.join()
    assert not (tmp_path / "twice" / "weights.pt").exists()
    assert train.main(interrupted) == 1  # neither begun again by mistake
    assert train.main([*interrupted, "--resume"]) == 0
    assert rows(tmp_path / "twice") == rows(tmp_path / "once")
    assert len(rows(tmp_path / "once")) == 4
    assert same_weights(tmp_path / "once", tmp_path / "twice")
    assert cv2.imread(str(tmp_path / "once" / "curves.png")) is not None
    # Nor gone on with as if it were another one.
    assert train.main([*interrupted, "--resume", "--seed", "9"]) == 1


def interrupt_after_a_line(log: Path) -> None:
    while not (log.exists() and len(log.read_text().splitlines()) > 1):
        threading.Event().wait(0.01)
    os.kill(os.getpid(), signal.SIGINT)


def test_a_corrupt_image_is_left_out_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_data(tmp_path / "data", 2)
    (tmp_path / "data" / "images" / "0.png").write_bytes(b"no image")
    assert train.main([str(tmp_path / "data"), *FAST, "--steps", "2", "--out", str(tmp_path / "run")]) == 0
    assert "left out: image that cannot be read (2)" in capsys.readouterr().out


def test_a_run_folder_is_not_overwritten(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.txt").touch()
    assert train.main([str(data), "--out", str(tmp_path)]) == 1
    assert "exists already: choose another folder" in capsys.readouterr().err
    assert train.main([str(data), "--out", str(tmp_path), "--resume"]) == 1
    assert "no checkpoint" in capsys.readouterr().err


def test_a_run_folder_that_cannot_be_written_is_said(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    run = tmp_path / "file" / "run"
    for main, name in ((train.main, "train"), (evaluate_detector.main, "evaluate_detector")):
        assert main([str(data), "--out", str(run), "--boxes", "bbox"]) == 1
        assert f"{name}: {run}: Not a directory; choose another path" in capsys.readouterr().err


def test_a_full_disk_leaves_the_old_file_alone(tmp_path: Path) -> None:
    content = {"a": torch.zeros(1_000_000)}
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(b"old")
    with full_disk(100_000), pytest.raises(OSError, match="File too large") as error:
        weights_file.write_content(content, path)
    assert error.value.filename == str(path)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_loss_that_is_not_finite_ends_training_with_the_last_good_state(tmp_path: Path) -> None:
    module = torch.nn.Linear(1, 1)
    losses = {step: float("nan") if step >= 3 else 1.0 for step in range(60)}
    task = Task(
        module,
        list(module.parameters()),
        lambda step: {"loss": losses[step] * module.weight.square().sum()},
        torch.device("cpu"),
    )
    with pytest.raises(TrainingError, match=r"no finite loss in 20 steps .* \(--resume\)"):
        optimise(task, LoopSettings(steps=60, checkpoint_every=1, log_every=1), tmp_path, {}, resume=False)
    assert torch.isfinite(module.weight).all()
    assert len(rows(tmp_path)) == 3
    # Where there is none, nobody is sent to it.
    losses = dict.fromkeys(losses, float("nan"))
    (tmp_path / "checkpoint.pt").unlink()
    with pytest.raises(TrainingError, match="; begin again with a smaller --learning-rate"):
        optimise(task, LoopSettings(steps=60), tmp_path, {}, resume=False)


def test_steps_with_nothing_to_learn_from_are_told_apart_and_evaluated(tmp_path: Path) -> None:
    """They are no losses that are not finite, and what they leave as it is can be the best that there is."""
    module = torch.nn.Linear(1, 1)
    evaluated: list[float] = []

    def held_out() -> float:
        evaluated.append(float(module.weight.detach()))
        return 0.0

    task = Task(
        module,
        list(module.parameters()),
        lambda step: {"loss": module.weight.square().sum()} if step < 3 else None,
        torch.device("cpu"),
        "begin in another folder with more boxes",
        held_out=held_out,
    )
    settings = LoopSettings(steps=60, evaluate_every=2, log_every=2)
    with pytest.raises(
        TrainingError,
        match=r"^nothing to learn from in 20 steps up to step 22; begin in another folder with more boxes$",
    ):
        optimise(task, settings, tmp_path, {}, resume=False)
    assert [row["step"] for row in rows(tmp_path)] == ["0", "2"]
    assert len(evaluated) == 11  # steps 0, 2 ... 20


def test_the_weights_of_the_best_held_out_loss_are_kept(tmp_path: Path) -> None:
    module = torch.nn.Linear(1, 1, bias=False)
    seen = []

    def held_out() -> float:
        seen.append(float(module.weight.detach()))
        return [3.0, 1.0, 2.0, 4.0, 5.0, 6.0][len(seen) - 1]

    def task() -> Task:
        losses = {"loss": lambda: module.weight.square().sum()}
        return Task(
            module,
            list(module.parameters()),
            lambda step: {name: loss() for name, loss in losses.items()},
            torch.device("cpu"),
            held_out=held_out,
        )

    settings = LoopSettings(steps=4, checkpoint_every=1, log_every=1, evaluate_every=1, warm_up=0, learning_rate=0.1)
    optimise(task(), settings, tmp_path, {}, resume=False)
    assert len(set(seen)) == 4 and float(module.weight.detach()) == seen[1]
    assert [row["held_out"] for row in rows(tmp_path)] == ["3", "1", "2", "4"]
    # What a checkpoint knows of it is not lost.
    torch.nn.init.zeros_(module.weight)
    optimise(task(), settings, tmp_path, {}, resume=True)
    assert float(module.weight.detach()) == seen[1]


def test_how_far_a_training_is_and_its_loss_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for limit in ("SECONDS_BETWEEN_UPDATES", "SECONDS_TO_JUDGE"):
        monkeypatch.setattr(progress, limit, 0.0)
    module = torch.nn.Linear(1, 1)
    task = Task(
        module,
        list(module.parameters()),
        lambda step: {"loss": (module.weight - 3.0).square().sum()},
        torch.device("cpu"),
    )
    optimise(task, LoopSettings(steps=4, log_every=2), tmp_path, {}, resume=False)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4 and all(re.fullmatch(r"training: +\d+%(, 0 s left)?, loss [\d.]+", line) for line in lines)


@pytest.mark.parametrize("log_every", [1, 3, 1000])
@pytest.mark.parametrize(("last", "kept"), [(2.0, 2), (0.5, 5)])
def test_what_is_logged_does_not_decide_which_weights_are_kept(
    log_every: int, last: float, kept: int, tmp_path: Path
) -> None:
    """Every second step counts, and the last one; those between, which are logged or not, are better and do not."""
    module = torch.nn.Linear(1, 1, bias=False)
    held_out = [5.0, 0.0, 1.0, 0.0, 3.0, last]
    after: list[float] = []  # weight after each step but the last

    def losses(step: int) -> dict[str, torch.Tensor]:
        if step:
            after.append(float(module.weight.detach()))
        return {"loss": module.weight.sum()}

    task = Task(module, list(module.parameters()), losses, torch.device("cpu"), held_out=lambda: held_out[len(after)])
    settings = LoopSettings(steps=6, log_every=log_every, evaluate_every=2, warm_up=0, learning_rate=0.1)
    optimise(task, settings, tmp_path, {}, resume=False)
    after.append(float(weights_file.read(tmp_path / "checkpoint.pt", "checkpoint")["module"]["weight"]))
    assert float(module.weight.detach()) == after[kept] and len(set(after)) == 6


def test_the_learning_rate_rises_and_falls() -> None:
    settings = LoopSettings(steps=100, learning_rate=1.0, warm_up=9)
    assert settings.rate(0) == pytest.approx(0.1)
    assert settings.rate(50) == pytest.approx(0.5)
    assert settings.rate(99) < 0.001


# -- stage covariance ---------------------------------------------------------------------------------------------


def examples(count: int) -> tuple[Examples, torch.Tensor]:
    """Residuals whose true standard deviations (M, 4) depend on the features."""
    generator = torch.Generator().manual_seed(3)
    features = torch.randn(count, 4, generator=generator).repeat(1, 64)
    sigma = torch.exp(0.5 * features[:, :4] - 1.0)
    residuals = sigma * torch.randn(count, 4, generator=generator)
    labels = torch.randint(1, 3, (count,), generator=generator)
    return Examples(
        features, torch.zeros(count, CUES), labels, residuals, torch.ones(count, dtype=torch.bool), torch.zeros(1, 128)
    ), sigma


@pytest.mark.parametrize("loss", list(LOSSES))
def test_the_head_learns_true_variances(loss: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = CalibratedDetector("compact", ("cup", "book"))
    before = {name: value.clone() for name, value in model.detector.state_dict().items()}
    learnt, sigma = examples(4000)
    settings = LoopSettings(steps=400, learning_rate=3e-3, warm_up=0, log_every=50)
    optimise(covariance_task(model, learnt, loss, 512, settings, torch.device("cpu")), settings, tmp_path, {}, False)
    with torch.no_grad():
        variances, _ = model.covariance_head.eval()(learnt.features, learnt.cues, learnt.labels)
    ratio = torch.log(variances.sqrt() / sigma)
    # sigma varies by a factor of e^0.5 about its mean; learnt, a good part of that is explained.
    assert ratio.std() < 0.4
    assert abs(ratio.mean()) < (0.5 if loss == "calibration" else 0.2)
    for name, value in model.detector.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_both_stages_and_evaluation(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On untrained weights: with every proposal a detection, some lie on an object."""
    torch.manual_seed(1)
    model = CalibratedDetector("compact", tuple(COLOURS))
    weights_file.save(model, tmp_path / "begin.pt")
    monkeypatch.setattr("calibslam_detector.training.matching.MIN_OVERLAP", 0.02)
    monkeypatch.setattr(train, "MIN_EXAMPLES", 2)
    options = ["--stage", "covariance", "--weights", str(tmp_path / "begin.pt"), "--loss", "nll", "--steps", "3"]
    out = tmp_path / "run"
    assert train.main([str(data), *options, "--log-every", "1", "--out", str(out)]) == 0
    trained = weights_file.load(out / "weights.pt")
    for name, value in model.detector.state_dict().items():
        assert torch.equal(trained.detector.state_dict()[name], value), name
    assert [set(row) for row in rows(out)] == [{"step", "learning_rate", "nll", "held_out"}] * 3
    (out / "weights.pt").unlink()
    assert train.main([str(data), *options, "--log-every", "1", "--out", str(out), "--resume"]) == 0
    arguments = [
        "--weights",
        str(out / "weights.pt"),
        "--out",
        str(tmp_path / "evaluation"),
        "--score-threshold",
        "0.05",
    ]
    assert evaluate_detector.main([str(data), *arguments]) == 0
    result = json.loads((tmp_path / "evaluation" / "metrics.json").read_text())
    assert result["images"] == 4 and 0.0 <= result["map"] <= 1.0


def of_whole_objects(every: int) -> Examples:
    """1000 examples, of which every n-th is of an object wholly in the image."""
    return replace(examples(1000)[0], whole=torch.arange(1000) % every == 0)


@pytest.mark.parametrize(
    ("every", "batch", "says"),
    [
        (5, 512, "only 40 of the boxes held out are .*, --loss f_cal_cramer needs 50"),
        (2, 64, "of the 64 boxes of a step 32 are .*, --loss f_cal_cramer needs 50: give more --regions"),
    ],
)
def test_too_few_whole_objects_for_f_cal_are_said(every: int, batch: int, says: str) -> None:
    model, few = CalibratedDetector("compact", ("cup", "book")), of_whole_objects(every)
    with pytest.raises(TrainingError, match=says):
        covariance_task(model, few, "f_cal_cramer", batch, LoopSettings(), torch.device("cpu"))
    assert covariance_task(model, few, "nll", batch, LoopSettings(), torch.device("cpu")).losses(0) is not None


def test_cut_boxes_are_in_the_likelihood_and_not_in_f_cals_sums() -> None:
    """What their residuals are changes the one and not the other."""
    model, half = CalibratedDetector("compact", ("cup", "book")), of_whole_objects(2)
    cut = replace(half, residuals=torch.where(half.whole[:, None], half.residuals, 0.0))
    found = []
    for each in (half, cut):
        torch.manual_seed(0)
        task = covariance_task(model, each, "f_cal_cramer", 400, LoopSettings(), torch.device("cpu"))
        losses = task.losses(0)
        assert losses is not None
        found.append({name: float(value.detach()) for name, value in losses.items()})
    assert found[0]["calibration"] == found[1]["calibration"]
    assert abs(found[0]["nll"] - found[1]["nll"]) > 1e-4


def test_a_step_that_has_too_few_whole_objects_by_chance_is_left_out() -> None:
    """Half of 100 on average, and 50 are needed: about half of the steps have fewer."""
    model, half = CalibratedDetector("compact", ("cup", "book")), of_whole_objects(2)
    task = covariance_task(model, half, "f_cal_cramer", 100, LoopSettings(), torch.device("cpu"))
    left_out = sum(task.losses(step) is None for step in range(40))
    assert 5 < left_out < 35


@pytest.mark.parametrize("changed", ["weights", "annotations"])
def test_neither_another_detector_nor_other_annotations_are_gone_on_with(
    changed: str, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("calibslam_detector.training.matching.MIN_OVERLAP", 0.02)
    monkeypatch.setattr(train, "MIN_EXAMPLES", 2)
    torch.manual_seed(1)
    weights_file.save(CalibratedDetector("compact", tuple(COLOURS)), tmp_path / "begin.pt")
    (tmp_path / "annotations.json").write_bytes((data / "annotations.json").read_bytes())
    options = [str(data), "--annotations", str(tmp_path / "annotations.json"), "--stage", "covariance"]
    options += ["--weights", str(tmp_path / "begin.pt"), "--loss", "nll", "--steps", "2"]
    assert train.main([*options, "--out", str(tmp_path / "run")]) == 0
    if changed == "weights":
        weights_file.save(CalibratedDetector("compact", tuple(COLOURS)), tmp_path / "begin.pt")
    else:
        content = json.loads((tmp_path / "annotations.json").read_text())
        content["annotations"][0]["bbox"][0] += 3
        (tmp_path / "annotations.json").write_text(json.dumps(content))
    thing = "detector" if changed == "weights" else "annotations"
    assert train.main([*options, "--out", str(tmp_path / "run"), "--resume"]) == 1
    said = capsys.readouterr().err
    assert "examples.pt holds boxes found with other options" in said and f"{thing} " in said
    # The checkpoint knows it, too.
    (tmp_path / "run" / "examples.pt").unlink()
    assert train.main([*options, "--out", str(tmp_path / "run"), "--resume"]) == 1
    assert f"is of a training with checksum of the {thing} = " in capsys.readouterr().err


def test_a_run_that_failed_before_its_first_checkpoint_begins_again(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibslam_detector.training.matching.MIN_OVERLAP", 0.02)
    weights_file.save(CalibratedDetector("compact", tuple(COLOURS)), tmp_path / "begin.pt")
    options = [str(data), "--stage", "covariance", "--weights", str(tmp_path / "begin.pt"), "--loss", "nll"]
    options += ["--steps", "1", "--out", str(tmp_path / "run")]
    assert train.main(options) == 1  # too few boxes
    assert (tmp_path / "run" / "examples.pt").exists()
    monkeypatch.setattr(train, "MIN_EXAMPLES", 2)
    assert train.main(options) == 0


def test_only_sure_boxes_of_whole_objects_are_judged_for_calibration(tmp_path: Path) -> None:
    """Of five objects one lies whole in the image and is found surely, one is cut, one is found with a small score, one
    not at all, and one is a crowd."""
    true = np.array([[10, 10, 40, 40], [0, 50, 30, 80], [60, 10, 90, 40], [60, 50, 90, 80], [100, 50, 120, 80.0]])
    labels = np.ones(5, np.int64)
    truth = ImageTruth(1, tmp_path / "1.png", true, labels, np.array([False, False, False, False, True]))
    found = Boxes(
        stamp=0,
        width=128,
        height=96,
        corners=true[[0, 1, 2, 4]] + 1.0,
        covariances=np.arange(1.0, 5.0)[:, None, None] * np.eye(4),
        class_ids=("cup",) * 4,
        scores=np.array([0.9, 0.9, 0.4, 0.9]),
        object_ids=("",) * 4,
    )
    data = CocoData(tmp_path / "a.json", ("cup",), (truth, truth))
    sure = evaluate_detector.errors_of_whole_objects([found, None], data, 0.5)
    np.testing.assert_array_equal(sure.errors, np.full((1, 4), -1.0))
    np.testing.assert_array_equal(sure.covariances, np.eye(4)[None])
    less_sure = evaluate_detector.errors_of_whole_objects([found, None], data, 0.3)
    np.testing.assert_array_equal(less_sure.covariances, np.array([1.0, 3.0])[:, None, None] * np.eye(4))


def test_stage_covariance_needs_a_detector(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train.main([str(data), "--stage", "covariance", "--out", str(tmp_path / "run")]) == 1
    assert "--weights FILE" in capsys.readouterr().err


def test_covariances_are_of_the_boxes_that_were_learnt(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads((data / "annotations.json").read_text())
    for annotation in content["annotations"]:
        annotation["amodal_bbox"] = annotation["bbox"]
    (tmp_path / "amodal.json").write_text(json.dumps(content))
    given = [str(data), "--annotations", str(tmp_path / "amodal.json")]
    boxes = ["--boxes", "amodal_bbox"]
    assert train.main([*given, *boxes, *FAST, "--steps", "1", "--out", str(tmp_path / "whole")]) == 0
    weights = tmp_path / "whole" / "weights.pt"
    assert weights_file.load(weights).boxes == "amodal_bbox"
    options = ["--stage", "covariance", "--weights", str(weights), "--out", str(tmp_path / "run")]
    assert train.main([*given, *options]) == 1
    assert "say --boxes amodal_bbox" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    # And they are what a detector is judged by: this data set has none.
    assert evaluate_detector.main([str(data), "--weights", str(weights), "--out", str(tmp_path / "evaluation")]) == 1
    assert "annotation without amodal_bbox (8)" in capsys.readouterr().err


def test_too_few_boxes_found_again_are_said(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights_file.save(CalibratedDetector("compact", tuple(COLOURS)), tmp_path / "begin.pt")
    options = ["--stage", "covariance", "--weights", str(tmp_path / "begin.pt"), "--out", str(tmp_path / "run")]
    assert train.main([str(data), *options]) == 1
    assert "were found again by the detector" in capsys.readouterr().err


# -- files --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[CalibratedDetector, Path]:
    model = CalibratedDetector("compact", tuple(COLOURS)).eval()
    path = tmp_path_factory.mktemp("weights") / "w.pt"
    weights_file.save(model, path)
    return model, path


def test_a_file_gives_the_same_detector(saved: tuple[CalibratedDetector, Path], tmp_path: Path) -> None:
    model, path = saved
    loaded = weights_file.load(path)
    image = [torch.rand(3, 96, 128)]
    model.detector.roi_heads.score_thresh = loaded.detector.roi_heads.score_thresh = 0.0
    with torch.no_grad():
        for a, b in zip(model.detect(image), loaded.detect(image), strict=True):
            assert all(torch.equal(a[name], b[name]) for name in a) and len(a["boxes"]) > 0
    weights_file.save(model, tmp_path / "half.pt", half=True)
    assert (tmp_path / "half.pt").stat().st_size < 0.55 * path.stat().st_size
    assert (tmp_path / "half.pt").stat().st_size < 25e6
    half = weights_file.load(tmp_path / "half.pt")
    assert next(half.parameters()).dtype == torch.float32


def test_files_that_cannot_be_used_are_refused(saved: tuple[CalibratedDetector, Path], tmp_path: Path) -> None:
    _, path = saved
    content = torch.load(path, weights_only=True)
    weights = content["weights"]
    name = "detector.roi_heads.box_predictor.cls_score.weight"
    bad = {
        "is not a detector of CalibSLAM": weights,
        "has version 9": {**content, "version": 9},
        "lacks boxes": {k: v for k, v in content.items() if k != "boxes"},
        "lacks class_names": {k: v for k, v in content.items() if k != "class_names"},
        "unknown architecture 'yolo'": {**content, "architecture": "yolo"},
        "does not fit mobilenet_v3_large_320_fpn": {**content, "architecture": "mobilenet_v3_large_320_fpn"},
        "does not fit compact": {**content, "class_names": ["cup"]},
        "holds NaN": {**content, "weights": {**weights, name: weights[name] * float("nan")}},
    }
    for message, value in bad.items():
        torch.save(value, tmp_path / "bad.pt")
        with pytest.raises(WeightsError, match=message):
            weights_file.load(tmp_path / "bad.pt")
    (tmp_path / "cut.pt").write_bytes(path.read_bytes()[:100_000])
    (tmp_path / "text.pt").write_text("hello")
    (tmp_path / "evil.pt").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    for file in ("cut.pt", "text.pt", "evil.pt"):
        with pytest.raises(WeightsError, match="damaged or not written by torch"):
            weights_file.load(tmp_path / file)
    with pytest.raises(WeightsError, match="cannot be read"):
        weights_file.load(tmp_path / "none.pt")


def test_weights_of_torchvision_load(data: Path, tmp_path: Path) -> None:
    """Its file is a plain state dict of 91 classes, without counts of batches where normalisation is frozen."""
    torch.manual_seed(2)
    model = CalibratedDetector("mobilenet_v3_large_320_fpn", tuple(map(str, range(90))), frozen_norm=True)
    torch.save(model.detector.state_dict(), tmp_path / "coco.pth")
    loaded = weights_file.load_coco(tmp_path / "coco.pth", "mobilenet_v3_large_320_fpn")
    assert loaded.frozen_norm and loaded.class_names[0] == "person" and "cup" in loaded.class_names
    for name, value in model.detector.state_dict().items():
        assert torch.equal(loaded.detector.state_dict()[name], value)
    with pytest.raises(WeightsError, match="no COCO weights of compact"):
        weights_file.load_coco(tmp_path / "coco.pth", "compact")
    options = ["--architecture", "mobilenet_v3_large_320_fpn", "--coco-weights", str(tmp_path / "coco.pth")]
    assert train.main([str(data), *options, *FAST, "--steps", "1", "--out", str(tmp_path / "run")]) == 0
    trained = weights_file.load(tmp_path / "run" / "weights.pt")
    assert trained.class_names == tuple(COLOURS) and trained.frozen_norm
    frozen = "detector.backbone.body.0.1.weight"
    assert torch.equal(trained.state_dict()[frozen], loaded.state_dict()[frozen])
