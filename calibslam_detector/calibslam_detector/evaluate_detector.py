"""`evaluate_detector`: how good a detector's boxes are (mean average precision) and how honest their covariances.

Calibration is measured in pixels, on found boxes of objects that lie inside the image with all their edges: a cut
edge has no error.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from calibslam_detector.calibration import metrics
from calibslam_detector.calibration.reliability import plot, reliability
from calibslam_detector.images.coco_data import BOX_KEYS, CocoData, DataError, load_coco_data, read_image
from calibslam_detector.model.detector import Detector, DetectorSettings, DeviceError
from calibslam_detector.model.weights_file import SHIPPED, WeightsError
from calibslam_detector.training.matching import free_of_border, match
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.measurements import Array, Boxes, InvalidMeasurement
from calibslam_msgs_py.progress import followed
from calibslam_msgs_py.settings import Settings, add_arguments, from_arguments, setting

LEAST_SCORE = 0.05  # of boxes that count for the precision, as torchvision has it
LEARNT = "learnt"
SUM = 100  # squared residuals in a sum of ECE(q), as the published code has it


@dataclass(frozen=True)
class EvaluationSettings(Settings):
    """What is compared."""

    score_threshold: float = setting(0.5, "boxes of a smaller score count for the precision only", low=LEAST_SCORE)
    boxes: str = setting(
        LEARNT,
        "true boxes: those the detector learnt, of visible parts, or of whole objects",
        choices=(LEARNT, *BOX_KEYS),
    )


@dataclass(frozen=True)
class Errors:
    """Errors (N, 4) of boxes [px], true minus found, and their covariances (N, 4, 4)."""

    errors: Array
    covariances: Array


def detect_all(detector: Detector, data: CocoData) -> tuple[list[Boxes | None], float]:
    """Boxes of each image, None where a file is no image to detect on; and the share of images with a strangeness
    above 1.
    """
    found: list[Boxes | None] = []
    strangeness = []
    for truth in followed(data.images, "detecting"):
        image = read_image(truth.file)
        if image is None:
            found.append(None)
            continue
        try:
            boxes, strange = detector(image)
        except InvalidMeasurement:
            found.append(None)
            continue
        found.append(boxes)
        strangeness.append(strange)
    return found, float(np.mean(np.array(strangeness) > 1.0)) if strangeness else 0.0


def errors_of_whole_objects(found: list[Boxes | None], data: CocoData, score_threshold: float) -> Errors:
    """Errors of boxes that are of an object wholly inside the image."""
    errors, covariances = [], []
    for boxes, truth in zip(found, data.images, strict=True):
        if boxes is None:
            continue
        boxes = boxes.select(np.flatnonzero(boxes.scores >= score_threshold))
        labels = np.array([data.class_names.index(name) + 1 for name in boxes.class_ids], np.int64)
        true_boxes = truth.boxes[~truth.crowd]
        detected, true = match(boxes.corners, labels, true_boxes, truth.labels[~truth.crowd])
        whole = free_of_border(true_boxes[true], boxes.width, boxes.height).all(axis=1)
        errors.append((true_boxes[true] - boxes.corners[detected])[whole])
        covariances.append(boxes.covariances[detected][whole])
    return Errors(np.concatenate([np.empty((0, 4)), *errors]), np.concatenate([np.empty((0, 4, 4)), *covariances]))


def calibration_metrics(sample: Errors) -> dict[str, float]:
    """The numbers of docs/detector.md; of fewer than SUM / 4 boxes nothing but how many there are."""
    result: dict[str, float] = {"boxes": float(len(sample.errors))}
    if 4 * len(sample.errors) < SUM:
        return result
    z = metrics.whitened(sample.errors, sample.covariances)
    half, most = metrics.coverage(z, np.array([0.5, 0.9]))
    return result | {
        "ece_z": metrics.ece_z(z),
        "ece_q": metrics.ece_q(z, SUM, rng=np.random.default_rng(0)),
        "coverage_50": float(half),
        "coverage_90": float(most),
        "nll": metrics.negative_log_likelihood(sample.errors, sample.covariances),
        "energy_score_px": metrics.energy_score(sample.errors, sample.covariances, np.random.default_rng(0)),
        "sharpness_px": metrics.sharpness(sample.covariances),
        "rmse_px": float(np.sqrt(np.square(sample.errors).mean())),
        "median_error_px": float(np.median(np.abs(sample.errors))),
    }


def precision(found: list[Boxes | None], data: CocoData) -> dict[str, float]:
    """COCO's mean average precision, over overlaps from 0.5 to 0.95 and at 0.5."""
    truth = COCO()
    truth.dataset = _as_coco(data)
    results = [
        {
            "image_id": image.id,
            "category_id": data.class_names.index(boxes.class_ids[k]) + 1,
            "bbox": [*boxes.corners[k, :2], *(boxes.corners[k, 2:] - boxes.corners[k, :2])],
            "score": float(boxes.scores[k]),
        }
        for image, boxes in zip(data.images, found, strict=True)
        if boxes is not None
        for k in range(len(boxes))
    ]
    if not results:
        return {"map": 0.0, "map_50": 0.0}
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        truth.createIndex()
        evaluation = COCOeval(truth, truth.loadRes(results), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return {"map": float(evaluation.stats[0]), "map_50": float(evaluation.stats[1])}


def _as_coco(data: CocoData) -> dict[str, Any]:
    """The data set as it was read, with the boxes that count."""
    annotations: list[dict[str, Any]] = []
    for image in data.images:
        for box, label, crowd in zip(image.boxes, image.labels, image.crowd, strict=True):
            size = box[2:] - box[:2]
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": image.id,
                    "category_id": int(label),
                    "bbox": [*box[:2], *size],
                    "area": float(np.prod(size)),
                    "iscrowd": int(crowd),
                }
            )
    return {
        "info": {},
        "images": [{"id": image.id} for image in data.images],
        "annotations": annotations,
        "categories": [{"id": k + 1, "name": name} for k, name in enumerate(data.class_names)],
    }


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `evaluate_detector`; returns the exit code."""
    parser = ArgumentParser(prog="evaluate_detector", description=__doc__)
    parser.add_argument("data", type=Path, metavar="DIR", help="annotations.json and images/")
    parser.add_argument(
        "--weights",
        type=Path,
        default=SHIPPED,
        metavar="FILE",
        help="detector that `train` wrote (default: the shipped)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="for metrics.json and reliability.png")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="(default: %(default)s)")
    add_arguments(parser, EvaluationSettings)
    arguments = parser.parse_args(argv)
    settings = from_arguments(arguments, EvaluationSettings)
    try:
        detector = Detector.from_file(arguments.weights, DetectorSettings(LEAST_SCORE, arguments.device))
        boxes = detector.boxes if settings.boxes == LEARNT else settings.boxes
        data = load_coco_data(
            arguments.data / "annotations.json", arguments.data / "images", detector.class_names, boxes
        )
    except (DataError, WeightsError, DeviceError) as error:
        print(f"evaluate_detector: {error}", file=sys.stderr)
        return 1
    found, strange_share = detect_all(detector, data)
    sample = errors_of_whole_objects(found, data, settings.score_threshold)
    counts = {"images": len(data.images), "strange_share": strange_share}
    result = {**counts, **precision(found, data), **calibration_metrics(sample)}
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "metrics.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if "ece_z" in result:
        z = metrics.whitened(sample.errors, sample.covariances)
        curves = {"edges": reliability(z.reshape(-1, 1)), "boxes": reliability(z)}
        plot(curves, arguments.out / "reliability.png", f"{arguments.weights.name} on {arguments.data.name}")
    for name, value in result.items():
        print(f"{name:16s} {value:.4g}")
    if unreadable := sum(boxes is None for boxes in found):
        print(f"left out: image that cannot be read, or is too narrow ({unreadable})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
