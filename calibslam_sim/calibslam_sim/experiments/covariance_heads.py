"""One detector with several covariance heads: the same boxes, found once, with what each head says of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from calibslam_detector.images.coco_data import to_tensor
from calibslam_detector.model import weights_file
from calibslam_detector.model.box_covariance import rescaled
from calibslam_detector.model.detector import Detector, DetectorSettings
from calibslam_msgs_py.covariance import symmetric
from calibslam_msgs_py.measurements import Boxes
from calibslam_sim.experiments.design import ExperimentError


class CovarianceHeads:
    """Detects on the CPU with one thread, so that the same image gives the same boxes everywhere.

    Args:
        files: name -> weights file; they differ in the covariance head only.

    Raises:
        ExperimentError: a file cannot be used, or is of another detector.
    """

    def __init__(self, files: Mapping[str, Path]) -> None:
        try:
            self._models = {name: weights_file.load(path) for name, path in files.items()}
        except weights_file.WeightsError as error:
            raise ExperimentError(str(error)) from error
        (first, model), *others = self._models.items()
        for name, other in others:
            if not model.finds_boxes_as(other):
                raise ExperimentError(
                    f"{files[name]} finds other boxes than {files[first]}: only their covariances are to be compared; "
                    "train both with --stage covariance from the same --weights"
                )
        self._detector = Detector(model, DetectorSettings(device="cpu", threads=1))
        self._model = model

    def __call__(self, image: np.ndarray, stamp: int) -> dict[str, Boxes]:
        """Name of each head -> boxes of an image (H, W, 3) uint8 RGB that was taken at `stamp` [ns]."""
        height, width = image.shape[:2]
        with torch.inference_mode():
            (regions,) = self._model.regions([to_tensor(image)])
            plain = {"boxes": regions.boxes, "labels": regions.labels, "scores": regions.scores}
            (found,) = self._model.detector.transform.postprocess([plain], [regions.size], [(height, width)])
            covariances = {
                name: rescaled(model.covariances(regions), regions.size, (height, width)).double().numpy()
                for name, model in self._models.items()
            }
        names = self._detector.class_names
        return {
            name: Boxes(
                stamp=stamp,
                width=width,
                height=height,
                corners=found["boxes"].double().numpy(),
                covariances=symmetric(of_head),
                class_ids=tuple(names[int(label) - 1] for label in found["labels"]),
                scores=found["scores"].double().numpy(),
                object_ids=("",) * len(of_head),
            )
            for name, of_head in covariances.items()
        }
