"""Training of the covariance head, all the rest of the network as it is.

What it learns from are the detections that the node would publish, not the proposals of a training step: boxes that
were chosen for their score err otherwise than all. They are found once; then a step takes a few milliseconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from calibslam_detector.calibration.f_cal import FCal
from calibslam_detector.calibration.f_cal_cramer import FCalCramer
from calibslam_detector.calibration.losses import CalibrationLoss, GaussianNLL
from calibslam_detector.images.coco_data import CocoData, read_image, to_tensor
from calibslam_detector.model import weights_file
from calibslam_detector.model.box_covariance import decoupled
from calibslam_detector.model.network import CalibratedDetector, Regions
from calibslam_detector.training.checkpoint import TrainingError
from calibslam_detector.training.matching import free_of_border, match
from calibslam_detector.training.training_loop import LoopSettings, Task, batch_of
from calibslam_msgs_py.progress import followed

# Each is the likelihood and, with a weight, a demand for calibration (eq. 4.2.6). The weights put both on one scale:
# the squared Wasserstein distance is in squared units of a sum of K squares, that of Cramer and von Mises is below 1/3.
LOSSES: dict[str, tuple[Callable[[], torch.nn.Module] | None, float]] = {
    "nll": (None, 0.0),
    "f_cal_kl": (lambda: FCal(divergence="kl"), 0.5),
    "f_cal_w": (lambda: FCal(divergence="wasserstein"), 0.01),
    # Errors of boxes have outliers that nothing foretells, so components and sums cannot both be right.
    "f_cal_cramer": (lambda: FCalCramer((1, 100), weights=(1.0, 0.01)), 0.998),
    "calibration": (CalibrationLoss, 0.5),
}

# Boxes of whole objects that a demand for calibration must see at once: two of f-Cal's sums, 25 boxes of four each.
MIN_WHOLE = 50
HELD_OUT = 0.2  # share of the examples, those of the last images, that decide which weights are kept


@dataclass(frozen=True)
class Examples:
    """Detections that are of a labelled object, M of them in N images.

    Attributes:
        features: (M, F) of their regions.
        cues: (M, CUES).
        labels: (M,).
        residuals: (M, 4) true minus found, in deltas against the region's proposal.
        whole: (M,) whether the object lies inside the image with all its edges.
        descriptors: (N, C) of the images, see `familiarity`.
    """

    features: Tensor
    cues: Tensor
    labels: Tensor
    residuals: Tensor
    whole: Tensor
    descriptors: Tensor

    def __len__(self) -> int:
        return len(self.labels)


def find_examples(model: CalibratedDetector, data: CocoData, device: torch.device, skipped: Counter[str]) -> Examples:
    """Examples of a data set; images that cannot be read are counted in `skipped`."""
    model.to(device).eval()
    found = []
    with torch.no_grad():
        for truth in followed(data.images, "finding examples"):
            image = read_image(truth.file)
            if image is None:
                skipped["image that cannot be read"] += 1
                continue
            (regions,) = model.regions([to_tensor(image).to(device)])
            # The network sees another size.
            scale = np.tile(np.array(regions.size[::-1]) / np.array(image.shape[1::-1]), 2)
            true_boxes, labels = truth.boxes[~truth.crowd] * scale, truth.labels[~truth.crowd]
            detected, true = match(
                regions.boxes.double().cpu().numpy(), regions.labels.cpu().numpy(), true_boxes, labels
            )
            found.append(_examples(model, regions, detected, true_boxes[true]))
    if not found:
        raise weights_file.WeightsError("none of the images can be read")
    return Examples(*(torch.cat([getattr(part, name) for part in found]) for name in Examples.__dataclass_fields__))


def _examples(model: CalibratedDetector, regions: Regions, detected: np.ndarray, true_boxes: np.ndarray) -> Examples:
    """Examples of one image: the regions `detected` (M,), and their objects' boxes (M, 4)."""
    indices = torch.as_tensor(detected, device=regions.boxes.device)
    true = torch.as_tensor(true_boxes, dtype=regions.boxes.dtype, device=regions.boxes.device)
    coder = model.detector.roi_heads.box_coder
    proposals = regions.proposals[indices]
    residuals = coder.encode_single(true, proposals) - coder.encode_single(regions.boxes[indices], proposals)
    height, width = regions.size
    whole = torch.as_tensor(free_of_border(true_boxes, width, height).all(axis=1))
    return Examples(
        regions.features[indices].cpu(),
        regions.cues[indices].cpu(),
        regions.labels[indices].cpu(),
        residuals.cpu(),
        whole,
        regions.descriptor[None].cpu(),
    )


def covariance_task(
    model: CalibratedDetector, examples: Examples, loss: str, batch: int, settings: LoopSettings, device: torch.device
) -> Task:
    """The loss of `LOSSES` on batches of examples; only the covariance head changes.

    The weights of the least loss of held-out examples are kept: a head of so many weights soon knows its examples
    by heart, and then claims too much of others.

    Raises:
        TrainingError: too few of the examples, or of those of a step, are of whole objects for this loss.
    """
    model.to(device).eval().requires_grad_(False)
    head = model.covariance_head.train().requires_grad_(True)
    risk = GaussianNLL()
    make, weight = LOSSES[loss]
    calibration = make() if make is not None else None

    learnt = len(examples) - round(HELD_OUT * len(examples))
    batch = min(batch, learnt)
    if calibration is not None:
        _check_whole(examples.whole, learnt, batch, loss)

    def evaluate(chosen: Tensor) -> dict[str, Tensor]:
        """Both terms of eq. 4.2.6, of residuals that are independent of each other."""
        features, cues, labels, residuals = (
            part[chosen].to(device) for part in (examples.features, examples.cues, examples.labels, examples.residuals)
        )
        variances, couplings = head(features, cues, labels)
        independent = decoupled(residuals, couplings)
        zero = torch.zeros_like(independent)
        found = {"nll": (1.0 - weight) * risk(zero, variances, independent)}
        if calibration is not None:
            # Cut edges have no error at all, so no squared sum of theirs is chi-squared.
            whole = examples.whole[chosen].to(device)
            found["calibration"] = weight * calibration(zero[whole], variances[whole], independent[whole])
        return found

    def losses(step: int) -> dict[str, Tensor] | None:
        chosen = torch.from_numpy(batch_of(step, batch, learnt, settings.seed))
        # By chance a batch may have fewer than most of them.
        if calibration is not None and int(examples.whole[chosen].sum()) < MIN_WHOLE:
            return None
        return evaluate(chosen)

    @torch.no_grad()
    def held_out() -> float:
        head.eval()
        with torch.random.fork_rng():
            torch.manual_seed(settings.seed)  # of f-Cal's sums, each time the same
            found = evaluate(torch.arange(learnt, len(examples)))
        head.train()
        return float(sum(found.values()))

    way_out = (
        "a step has too few boxes of objects wholly in the image: begin in another folder with more --regions, or with "
        "--loss nll"
    )
    return Task(head, list(head.parameters()), losses, device, way_out, held_out=held_out)


def _check_whole(whole: Tensor, learnt: int, batch: int, loss: str) -> None:
    """Whether examples (M,), of which the first `learnt` are learnt from, and steps have enough of whole objects."""
    needs = f"--loss {loss} needs {MIN_WHOLE}"
    held_out = int(whole[learnt:].sum())
    if held_out < MIN_WHOLE:
        raise TrainingError(
            f"only {held_out} of the boxes held out are of objects wholly in the image, {needs}: give more images, or "
            "take --loss nll"
        )
    of_step = batch * float(whole[:learnt].double().mean())
    if of_step < MIN_WHOLE:
        raise TrainingError(
            f"of the {batch} boxes of a step {of_step:.0f} are of objects wholly in the image, {needs}: give more "
            "--regions (and images, if there are no more boxes), or take --loss nll"
        )


def stored_examples(path: Path, origin: dict[str, Any], make: Callable[[], Examples]) -> Examples:
    """The examples of a file, made and written where there is none: what a resumed training goes on with.

    Args:
        path: the file.
        origin: what they are made of, and must have been made of.
        make: finds them.

    Raises:
        WeightsError: the file cannot be read.
        TrainingError: it holds examples of something else.
    """
    if not path.exists():
        weights_file.write_content({"origin": origin, **vars(make())}, path)
    content = weights_file.read(path, "examples")
    found = content.pop("origin", {})
    differing = [
        f"{name} {found.get(name)} there, {value} now" for name, value in origin.items() if found.get(name) != value
    ]
    if differing:
        raise TrainingError(
            f"{path} holds boxes found with other options ({'; '.join(differing)}); go on with the same ones, or begin "
            "in another folder"
        )
    return Examples(**content)
