"""Images with boxes in COCO format: any image folder and its json. What is wrong is counted, or refused."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from calibslam_detector.images.image_conversion import AS_STORED
from calibslam_msgs_py.measurements import Array

# Which box of an annotation is learnt: COCO's, of the visible part, or that of the whole object inside the image,
# which `render_dataset` writes beside it.
BOX_KEYS = ("bbox", "amodal_bbox")
Sample = tuple[Tensor, dict[str, Tensor]]


class DataError(ValueError):
    """A data set that cannot be used; the text names the file and what is wrong."""


@dataclass(frozen=True)
class ImageTruth:
    """One image.

    Attributes:
        id: in the json.
        file: the image.
        boxes: (N, 4) xmin ymin xmax ymax [px].
        labels: (N,) from 1 on, by the data set's class names.
        crowd: (N,) whether a box is neither wanted nor wrong.
    """

    id: int
    file: Path
    boxes: Array
    labels: np.ndarray
    crowd: np.ndarray


@dataclass(frozen=True)
class CocoData:
    """A data set.

    Attributes:
        annotations: the json file.
        class_names: by label, from 1 on.
        images: usable ones.
        left_out: why and how often something was left out.
    """

    annotations: Path
    class_names: tuple[str, ...]
    images: tuple[ImageTruth, ...]
    left_out: Counter[str] = field(default_factory=Counter)


def load_coco_data(
    annotations: Path, images: Path, class_names: tuple[str, ...] | None = None, box_key: str = BOX_KEYS[0]
) -> CocoData:
    """Read a data set.

    Args:
        annotations: COCO json.
        images: folder that its file names are relative to.
        class_names: of a detector, whose labels count; other classes are left out. None: those of the json.
        box_key: of BOX_KEYS.

    Raises:
        DataError: nothing can be learnt from it.
    """
    content = _read(annotations)
    try:
        names = {int(category["id"]): str(category["name"]) for category in content["categories"]}
        records = {int(image["id"]): image["file_name"] for image in content["images"]}
        found = content["annotations"]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{annotations} is not COCO json: {type(error).__name__} {error}") from None
    if class_names is None:
        class_names = tuple(names[number] for number in sorted(names))
    if not set(class_names) & set(names.values()):
        raise DataError(
            f"{annotations} has no class of {', '.join(class_names[:5])}...; it has {', '.join(names.values())}"
        )
    label_of = {number: class_names.index(name) + 1 for number, name in names.items() if name in class_names}
    left_out: Counter[str] = Counter()
    boxes: dict[int, list[tuple[Array, int, bool]]] = {number: [] for number in records}
    for annotation in found:
        reason, box = _box(annotation, box_key, boxes, label_of)
        if box is None:
            left_out[reason] += 1
            continue
        boxes[annotation["image_id"]].append(
            (box, label_of[annotation["category_id"]], bool(annotation.get("iscrowd", 0)))
        )
    usable = []
    for number, name in sorted(records.items()):
        file = images / name
        if not file.is_file():
            left_out["image file missing"] += 1
            continue
        of_image = boxes[number]
        usable.append(
            ImageTruth(
                number,
                file,
                np.array([box for box, _, _ in of_image]).reshape(-1, 4),
                np.array([label for _, label, _ in of_image], np.int64),
                np.array([crowd for _, _, crowd in of_image], bool),
            )
        )
    if not any((~image.crowd).any() for image in usable):
        reasons = ", ".join(f"{reason} ({count})" for reason, count in left_out.items()) or "it is empty"
        raise DataError(f"{annotations}: no image with a box in {images}: {reasons}")
    return CocoData(annotations, class_names, tuple(usable), left_out)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"annotations {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise DataError(f"annotations {path} are not JSON: {error}") from None


def _box(annotation: Any, key: str, images: dict[int, Any], labels: dict[int, int]) -> tuple[str, Array | None]:
    """Corners of an annotation's box, or why it has none."""
    try:
        if annotation["image_id"] not in images:
            return "annotation of an unknown image", None
        if annotation["category_id"] not in labels:
            return "annotation of an unknown class", None
        x, y, width, height = (float(value) for value in annotation[key])
    except (KeyError, TypeError, ValueError):
        return f"annotation without {key}", None
    if not np.isfinite([x, y, width, height]).all() or width <= 0.0 or height <= 0.0:
        return "empty box", None
    return "", np.array([x, y, x + width, y + height])


def read_image(file: Path) -> np.ndarray | None:
    """(H, W, 3) uint8 RGB, turned as it is stored, as COCO's boxes are; None where the file is no image."""
    image = cv2.imread(str(file), AS_STORED)
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def to_tensor(image: np.ndarray) -> Tensor:
    """(3, H, W) in [0, 1] of (H, W, 3) uint8 RGB."""
    return torch.from_numpy(image).permute(2, 0, 1).float() / 255.0


class TrainingImages(Dataset[Sample | None]):
    """Images as torchvision's detectors learn from them; None where a file is no image.

    Item (k, seed): image k, mirrored and with another brightness and contrast as the seed decides, which makes a
    sample the same whoever reads it, whenever.
    """

    def __init__(self, data: CocoData) -> None:
        self._images = data.images

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, item: tuple[int, int]) -> Sample | None:
        k, seed = item
        truth = self._images[k]
        image = read_image(truth.file)
        if image is None:
            return None
        rng = np.random.default_rng((seed, k))
        width = image.shape[1]
        boxes = truth.boxes[~truth.crowd].copy()
        if rng.random() < 0.5:
            image = np.ascontiguousarray(image[:, ::-1])
            boxes[:, [0, 2]] = width - boxes[:, [2, 0]]
        tensor = to_tensor(image)
        gain, offset = rng.uniform(0.7, 1.4), rng.uniform(-0.08, 0.08)
        tensor = (tensor * gain + offset).clamp(0.0, 1.0)
        target = {
            "boxes": torch.as_tensor(boxes, dtype=torch.float32).reshape(-1, 4),
            "labels": torch.as_tensor(truth.labels[~truth.crowd]),
        }
        return tensor, target
