"""An image in, boxes with covariances out."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from calibslam_detector.images.coco_data import to_tensor
from calibslam_detector.model import weights_file
from calibslam_detector.model.network import CalibratedDetector
from calibslam_msgs_py.covariance import symmetric
from calibslam_msgs_py.measurements import Boxes, InvalidMeasurement
from calibslam_msgs_py.settings import Settings, setting

# [px of the network's input] of an image's shorter side; torchvision cannot resize to less than one.
LEAST_SIDE = 2.0
DEVICES = ("auto", "cpu", "cuda")


class DeviceError(ValueError):
    """A device that is not there."""


@dataclass(frozen=True)
class DetectorSettings(Settings):
    """What is detected, and where that is computed."""

    score_threshold: float = setting(0.5, "boxes of a smaller score are left out", low=0.0, high=1.0)
    device: str = setting("auto", "auto: CUDA where it is, else CPU", choices=DEVICES)
    threads: int = setting(0, "of the CPU; 0: one less than it has cores, for the other nodes", low=0)


def use_threads(threads: int) -> None:
    """Compute with so many threads; 0: one less than there are cores."""
    # One too many costs more than one too few, since they wait for each other: on 2 busy cores an image takes 0.6 s
    # with two and 0.14 s with one (in training 3 s and 0.1 s); where nothing else runs 0.06 s and 0.09 s.
    others = max(len(os.sched_getaffinity(0)) - 1, 1)
    torch.set_num_threads(threads or min(others, torch.get_num_threads()))


class Detector:
    """Detects with a network.

    Args:
        model: the network.
        settings: what is detected, and where.

    Raises:
        DeviceError: there is no CUDA.
    """

    def __init__(self, model: CalibratedDetector, settings: DetectorSettings) -> None:
        self.device = _device(settings.device)
        use_threads(settings.threads)
        self.class_names, self.boxes = model.class_names, model.boxes
        self._model = model.to(self.device).eval()
        self._model.detector.roi_heads.score_thresh = settings.score_threshold

    @classmethod
    def from_file(cls, path: Path, settings: DetectorSettings) -> Detector:
        """With the weights of a file.

        Raises:
            WeightsError: they cannot be used.
            DeviceError: there is no CUDA.
        """
        return cls(weights_file.load(path), settings)

    def __call__(self, image: np.ndarray, stamp: int = 0, frame_id: str = "camera") -> tuple[Boxes, float]:
        """Boxes, the best first, of an image (H, W, 3) uint8 RGB that was taken at `stamp` [ns], and how strange it is:
        covariances are calibrated for images like those learnt from, of which 95 % have a strangeness below 1.

        Raises:
            InvalidMeasurement: an image so long and narrow that nothing would be left of it.
        """
        short, long = sorted(image.shape[:2])
        resizing = self._model.detector.transform
        if short * min(resizing.min_size[-1] / short, resizing.max_size / long) < LEAST_SIDE:
            raise InvalidMeasurement(
                "image_size", f"image of {image.shape[1]} x {image.shape[0]} pixels, too narrow to detect anything"
            )
        with torch.inference_mode():
            (found,) = self._model.detect([to_tensor(image).to(self.device)])
        covariances = found["covariances"].double().cpu().numpy()
        boxes = Boxes(
            stamp=stamp,
            width=image.shape[1],
            height=image.shape[0],
            corners=found["boxes"].double().cpu().numpy(),
            covariances=symmetric(covariances),
            class_ids=tuple(self.class_names[int(label) - 1] for label in found["labels"]),
            scores=found["scores"].double().cpu().numpy(),
            object_ids=("",) * len(covariances),
            frame_id=frame_id,
        )
        return boxes, float(found["strangeness"])


def _device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise DeviceError("there is no CUDA device that torch can use; set device to auto or cpu")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and torch.cuda.is_available()) else "cpu")
