"""Detectors in files: architecture, classes and weights, loaded without executing anything that is in them."""

from __future__ import annotations

import hashlib
import pickle
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection import (
    FasterRCNN_MobileNet_V3_Large_320_FPN_Weights,
    FasterRCNN_ResNet50_FPN_V2_Weights,
)

from calibslam_detector.model.network import ARCHITECTURES, CalibratedDetector
from calibslam_msgs_py.files import whole

FORMAT, VERSION = "calibslam_detector", 2
# Architectures of which torchvision offers weights trained on COCO, and their classes, background first.
COCO = {
    "mobilenet_v3_large_320_fpn": FasterRCNN_MobileNet_V3_Large_320_FPN_Weights.COCO_V1,
    "resnet50_fpn_v2": FasterRCNN_ResNet50_FPN_V2_Weights.COCO_V1,
}
KEYS = {"format", "version", "architecture", "class_names", "frozen_norm", "boxes", "weights"}
# The detector that comes with this package; MODEL_CARD.md beside it says what it can do.
SHIPPED = Path(__file__).parents[1] / "default_weights" / "compact.pt"
# Another covariance head for it, trained by the likelihood alone, to compare with.
SHIPPED_NLL_HEAD = SHIPPED.with_name("compact_nll_head.pt")
HEAD_FORMAT, HEAD_VERSION = "calibslam_covariance_head", 1


class WeightsError(ValueError):
    """A weights file that cannot be used; the text names it and the next step."""


def save(model: CalibratedDetector, path: Path, half: bool = False) -> None:
    """Write a detector; with `half`, at half precision and half the size."""
    weights = {name: _halved(w) if half else w.detach().cpu() for name, w in model.state_dict().items()}
    content = {
        "format": FORMAT,
        "version": VERSION,
        "architecture": model.architecture,
        "class_names": list(model.class_names),
        "frozen_norm": model.frozen_norm,
        "boxes": model.boxes,
        "weights": weights,
    }
    write_content(content, path)


def save_head(model: CalibratedDetector, path: Path) -> None:
    """Write the covariance head alone, at half precision: the shipped detector, with this head, in a small file.

    Raises:
        ValueError: the model is not the shipped detector with another head.
    """
    if not model.finds_boxes_as(load(SHIPPED)):
        raise ValueError("only heads of the shipped detector are written alone; use save()")
    content = {
        "format": HEAD_FORMAT,
        "version": HEAD_VERSION,
        "detector": checksum(SHIPPED),
        "weights": {name: _halved(weight) for name, weight in model.covariance_head.state_dict().items()},
    }
    write_content(content, path)


def write_content(content: dict[str, Any], path: Path) -> None:
    """Write with torch, so that the file is whole or as it was.

    Raises:
        OSError: it cannot be written.
    """
    with whole(path) as partial, partial.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:
            reason = error.__context__
            if isinstance(reason, OSError):  # torch hides that the disk is full
                raise OSError(reason.errno, reason.strerror, str(path)) from error
            raise


def load(path: Path = SHIPPED) -> CalibratedDetector:
    """The detector of a file, on the CPU, ready to detect; of a head alone, the shipped detector with that head.

    Raises:
        WeightsError: no such file, not one of ours, damaged, or of another architecture than it says.
    """
    content = read(path, "weights file")
    if isinstance(content, dict) and content.get("format") == HEAD_FORMAT:
        return _shipped_with_head(content, path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise WeightsError(
            f"{path} is not a detector of CalibSLAM; weights of torchvision go to `train --coco-weights`"
        )
    if content.get("version") != VERSION:
        raise WeightsError(f"{path} has version {content.get('version')!r}; this release reads {VERSION}")
    if missing := KEYS - set(content):
        raise WeightsError(f"{path} is damaged: it lacks {', '.join(sorted(missing))}")
    architecture = content["architecture"]
    if architecture not in ARCHITECTURES:
        raise WeightsError(f"{path} is of unknown architecture {architecture!r}; known: {', '.join(ARCHITECTURES)}")
    model = CalibratedDetector(
        architecture, tuple(content["class_names"]), bool(content["frozen_norm"]), str(content["boxes"])
    )
    _fill(model, content["weights"], path, architecture)
    return model.eval()


def _shipped_with_head(content: dict[str, Any], path: Path) -> CalibratedDetector:
    if content.get("version") != HEAD_VERSION or content.get("detector") != checksum(SHIPPED):
        raise WeightsError(f"{path} is a covariance head of another release's detector; train it again")
    model = load(SHIPPED)
    _fill(model.covariance_head, content.get("weights"), path, "the covariance head of the shipped detector")
    return model


def load_coco(path: Path, architecture: str) -> CalibratedDetector:
    """A detector with torchvision's weights for COCO, and an untrained covariance head.

    Args:
        path: file as torchvision downloads it.
        architecture: which the file is for.

    Raises:
        WeightsError: see `load`.
    """
    if architecture not in COCO:
        raise WeightsError(f"there are no COCO weights of {architecture}; there are of {', '.join(COCO)}")
    state = read(path, "COCO weights")
    names = tuple(COCO[architecture].meta["categories"][1:])
    # Weights without counts of batches come from torchvision's frozen normalisation.
    frozen = isinstance(state, dict) and not any(name.endswith("num_batches_tracked") for name in state)
    model = CalibratedDetector(architecture, names, frozen_norm=frozen)
    _fill(model.detector, state, path, architecture)
    return model.eval()


def read(path: Path, what: str) -> Any:
    """What torch saved in a file, tensors and plain data only.

    Raises:
        WeightsError: it cannot be read.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise WeightsError(f"{what} {path} cannot be read: {error.strerror or error}") from None
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise WeightsError(f"{what} {path} is damaged or not written by torch: {reason}") from None


def _fill(module: torch.nn.Module, weights: Any, path: Path, architecture: str) -> None:
    """Load weights, all of them and no others."""
    try:
        current = module.state_dict()
        converted = {name: w.to(current[name].dtype) if name in current else w for name, w in weights.items()}
        module.load_state_dict(converted)
    except (RuntimeError, AttributeError) as error:
        reasons = str(error).splitlines()
        reason = reasons[1].strip() if len(reasons) > 1 else reasons[0]
        raise WeightsError(f"{path} does not fit {architecture}: {reason[:200]}") from None
    if bad := [name for name, w in module.state_dict().items() if not torch.isfinite(w).all()]:
        raise WeightsError(f"{path} holds NaN or infinity in {bad[0]}: its training has failed")


def checksum(path: Path) -> str:
    """Of what is in a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def checksum_of_weights(module: torch.nn.Module) -> str:
    """Of all weights and numbers of a module, whatever device they are on."""
    digest = hashlib.sha256()
    for name, value in module.state_dict().items():
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _halved(weight: Tensor) -> Tensor:
    weight = weight.detach().cpu()
    return weight.half() if weight.is_floating_point() else weight
