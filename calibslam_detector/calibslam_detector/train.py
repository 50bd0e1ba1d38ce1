"""`train`: trains a detector on images with boxes in COCO format.

Two stages: `detector` teaches the plain detector to find boxes; `covariance` then teaches, with all the rest as it
is, how wrong they may be, on other images than the detector has learnt from. Several GPUs: start the first stage
with torchrun.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from calibslam_detector.calibration.residuals import CalibrationError
from calibslam_detector.images.coco_data import BOX_KEYS, CocoData, DataError, load_coco_data
from calibslam_detector.model import weights_file
from calibslam_detector.model.detector import use_threads
from calibslam_detector.model.network import ARCHITECTURES, CalibratedDetector
from calibslam_detector.model.weights_file import WeightsError
from calibslam_detector.training.checkpoint import TrainingError
from calibslam_detector.training.covariance_task import LOSSES, covariance_task, find_examples, stored_examples
from calibslam_detector.training.detector_task import Processes, detector_task
from calibslam_detector.training.training_loop import Interrupted, LoopSettings, optimise
from calibslam_msgs_py.command import INTERRUPTED, ArgumentParser, command
from calibslam_msgs_py.files import partial_of
from calibslam_msgs_py.settings import Settings, add_arguments, from_arguments, setting

MIN_EXAMPLES = 500  # of the covariance head; a fifth of them are held out, and two sums of f-Cal need 50
CHECKPOINT, EXAMPLES = "checkpoint.pt", "examples.pt"
# What a run may have written that ended before its first checkpoint: nothing that is lost if it begins again.
BEGUN = {
    "settings.json",
    "log.csv",
    "curves.png",
    EXAMPLES,
    *(partial_of(Path(n)).name for n in (EXAMPLES, CHECKPOINT)),
}
DIGITS = 12  # of a checksum that are told


@dataclass(frozen=True)
class TrainSettings(Settings):
    """What is trained on what."""

    architecture: str = setting("compact", "network, where none is given to begin with", choices=tuple(ARCHITECTURES))
    batch: int = setting(8, "images per step and process, in stage detector", low=1)
    workers: int = setting(0, "processes that read images", low=0)
    threads: int = setting(0, "of the CPU; 0: one less than it has cores", low=0)
    regions: int = setting(512, "detections per step, in stage covariance", low=64)
    loss: str = setting("f_cal_cramer", "of the covariance head", choices=tuple(LOSSES))
    boxes: str = setting(BOX_KEYS[0], "which boxes are learnt: of visible parts or of whole objects", choices=BOX_KEYS)


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `train`; returns the exit code."""
    arguments = _arguments(argv)
    try:
        settings = from_arguments(arguments, TrainSettings)
        loop = from_arguments(arguments, LoopSettings)
        use_threads(settings.threads)
        stage = _train_detector if arguments.stage == "detector" else _train_covariance
        stage(arguments, settings, loop)
    except (DataError, WeightsError, TrainingError, CalibrationError) as error:
        print(f"train: {error}", file=sys.stderr)
        return 1
    except Interrupted as reason:
        print(f"train: {reason}", file=sys.stderr)
        return INTERRUPTED
    return 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = ArgumentParser(prog="train", description=__doc__)
    parser.add_argument("data", type=Path, metavar="DIR", help="annotations.json and images/; or see --annotations")
    parser.add_argument("--annotations", type=Path, metavar="FILE", help="COCO json (default: DIR/annotations.json)")
    parser.add_argument("--images", type=Path, metavar="DIR", help="images (default: DIR/images)")
    parser.add_argument(
        "--stage", choices=("detector", "covariance"), default="detector", help="what is taught (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder to write")
    parser.add_argument("--resume", action="store_true", help="go on with RUN's checkpoint")
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument("--weights", type=Path, metavar="FILE", help="detector of CalibSLAM to begin with")
    begin.add_argument("--coco-weights", type=Path, metavar="FILE", help="torchvision's weights to begin with")
    add_arguments(parser, TrainSettings)
    add_arguments(parser, LoopSettings)
    return parser.parse_args(argv)


def _train_detector(arguments: argparse.Namespace, settings: TrainSettings, loop: LoopSettings) -> None:
    processes = Processes.join()
    try:
        torch.manual_seed(loop.seed)
        model, data = _begin(arguments, settings)
        torch.manual_seed(loop.seed + processes.rank)
        if processes.rank == 0:
            _open_run(arguments.out, arguments.resume, settings, loop)
            _tell(data)
        skipped: Counter[str] = Counter()
        task = detector_task(model, data, settings.batch, settings.workers, loop, processes, skipped)
        optimise(task, loop, arguments.out, _identity(settings, loop, data, _annotations(data)), arguments.resume)
        if processes.rank == 0:
            _finish(arguments.out, model, skipped)
    finally:
        processes.leave()


def _train_covariance(arguments: argparse.Namespace, settings: TrainSettings, loop: LoopSettings) -> None:
    if arguments.weights is None and arguments.coco_weights is None:
        raise TrainingError("stage covariance needs a trained detector: --weights FILE or --coco-weights FILE")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model, data = _begin(arguments, settings)
    origin = {"detector": weights_file.checksum_of_weights(model.detector)[:DIGITS], **_annotations(data)}
    _open_run(arguments.out, arguments.resume, settings, loop)
    _tell(data)
    skipped: Counter[str] = Counter()
    examples = stored_examples(
        arguments.out / EXAMPLES,
        {**origin, "boxes": settings.boxes, "images": len(data.images)},
        lambda: find_examples(model, data, device, skipped),
    )
    if len(examples) < MIN_EXAMPLES:
        raise TrainingError(
            f"only {len(examples)} boxes were found again by the detector; {MIN_EXAMPLES} are needed: begin with more "
            "images, in another folder"
        )
    print(f"{len(examples)} boxes found again, {int(examples.whole.sum())} of them of objects wholly in the image")
    model.familiarity.fit(examples.descriptors.to(device))
    torch.manual_seed(loop.seed)
    task = covariance_task(model, examples, settings.loss, settings.regions, loop, device)
    optimise(task, loop, arguments.out, _identity(settings, loop, data, origin), arguments.resume)
    _finish(arguments.out, model, skipped)


def _identity(settings: TrainSettings, loop: LoopSettings, data: CocoData, origin: dict[str, str]) -> dict[str, Any]:
    """What must stay the same for a training to be gone on with; `origin`: checksums of what it begins with."""
    content = {**asdict(settings), "steps": loop.steps, "seed": loop.seed}
    del content["workers"], content["threads"]
    checksums = {f"checksum of the {name}": value for name, value in origin.items()}
    return {**content, "images": len(data.images), "classes": list(data.class_names), **checksums}


def _annotations(data: CocoData) -> dict[str, str]:
    return {"annotations": weights_file.checksum(data.annotations)[:DIGITS]}


def _finish(folder: Path, model: CalibratedDetector, skipped: Counter[str]) -> None:
    weights_file.save(model, folder / "weights.pt")
    for reason, count in skipped.items():
        print(f"left out: {reason} ({count})")
    print(f"{folder / 'weights.pt'}: {model.architecture}, {', '.join(model.class_names)}")


def _begin(arguments: argparse.Namespace, settings: TrainSettings) -> tuple[CalibratedDetector, CocoData]:
    """The network to begin with, and the data, labelled by its classes."""
    annotations = arguments.annotations or arguments.data / "annotations.json"
    images = arguments.images or arguments.data / "images"
    if arguments.weights is not None:
        model = weights_file.load(arguments.weights)
        if arguments.stage == "covariance" and model.boxes != settings.boxes:
            raise TrainingError(
                f"{arguments.weights} has learnt {model.boxes}, and its covariances must be of the same boxes: "
                f"say --boxes {model.boxes}"
            )
        model.boxes = settings.boxes
        return model, load_coco_data(annotations, images, model.class_names, settings.boxes)
    if arguments.stage == "covariance":
        model = weights_file.load_coco(arguments.coco_weights, settings.architecture)
        return model, load_coco_data(annotations, images, model.class_names, settings.boxes)
    data = load_coco_data(annotations, images, box_key=settings.boxes)
    if arguments.coco_weights is None:
        return CalibratedDetector(settings.architecture, data.class_names, boxes=settings.boxes), data
    trained = weights_file.load_coco(arguments.coco_weights, settings.architecture)
    model = CalibratedDetector(settings.architecture, data.class_names, trained.frozen_norm, settings.boxes)
    # All but what depends on the number of classes.
    shapes = {name: value.shape for name, value in model.state_dict().items()}
    fitting = {name: value for name, value in trained.state_dict().items() if value.shape == shapes[name]}
    model.load_state_dict(fitting, strict=False)
    return model, data


def _open_run(folder: Path, resume: bool, settings: TrainSettings, loop: LoopSettings) -> None:
    """Make the run folder, and write down what is done."""
    there = {path.name for path in folder.iterdir()} if folder.exists() else set()
    if not resume and there - BEGUN:
        way_out = "go on with --resume, or choose another folder" if CHECKPOINT in there else "choose another folder"
        raise TrainingError(f"{folder} exists already: {way_out}")
    if resume and CHECKPOINT not in there:
        raise TrainingError(f"{folder} has no checkpoint to resume; leave --resume out")
    folder.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {**asdict(settings), **asdict(loop), "torch": torch.__version__}
    (folder / "settings.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _tell(data: CocoData) -> None:
    boxes = sum(int((~image.crowd).sum()) for image in data.images)
    print(f"{data.annotations}: {len(data.images)} images, {boxes} boxes, {len(data.class_names)} classes")
    for reason, count in sorted(data.left_out.items()):
        print(f"left out: {reason} ({count})")


if __name__ == "__main__":
    sys.exit(main())
