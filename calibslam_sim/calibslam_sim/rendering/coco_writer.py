"""Rendered images and their boxes as a data set in COCO format: `images/*.jpg` and `annotations.json`.

Beside what COCO defines, an annotation holds `amodal_bbox` (the whole object's, cut at the image border),
`visible_share` and `object_id`. What is hardly to be seen is marked `iscrowd`: neither wanted nor wrong.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_msgs_py.files import write_whole
from calibslam_msgs_py.measurements import Array
from calibslam_sim.rendering.render import RenderedImage
from calibslam_sim.simulation.world import AROUND_TABLE, ON_TABLE, WorldObject

CLASSES = tuple(sorted({kind.class_id for kind in ON_TABLE + AROUND_TABLE}))
ANNOTATIONS, IMAGES = "annotations.json", "images"
DESCRIPTION = "CalibSLAM's rendered desks"  # by which a data set is known for one of ours
MIN_VISIBLE = 0.3  # share of an object that is not hidden
MIN_IN_IMAGE = 0.15  # share of its box inside the image
MIN_SIZE = 8.0  # [px] of its visible part


class CocoError(Exception):
    """A data set that cannot be written; the text names the next step."""


class CocoWriter:
    """Writes a data set; `close` completes it. Nothing is changed before the first image.

    Args:
        folder: to write; must not hold anything.
        overwrite: replace a data set of ours that is there: the images that its annotations name, and these.

    Raises:
        CocoError: the folder holds something else.
    """

    def __init__(self, folder: Path, overwrite: bool = False) -> None:
        self._folder = folder
        self._replaced = _files_of_data_set(folder, overwrite)
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def add(self, image: RenderedImage, world: tuple[WorldObject, ...]) -> None:
        """Add an image of this world."""
        if not self._images:
            (self._folder / IMAGES).mkdir(parents=True, exist_ok=True)
            for file in self._replaced:
                file.unlink(missing_ok=True)
        number = len(self._images) + 1
        height, width = image.image.shape[:2]
        name = f"{number:06d}.jpg"
        write_whole(self._folder / IMAGES / name, image.jpeg())
        sizes = image.visible_boxes[:, 2:] - image.visible_boxes[:, :2]
        clear = (
            (image.visible_shares >= MIN_VISIBLE)
            & (image.in_image_shares >= MIN_IN_IMAGE)
            & (np.nan_to_num(sizes.min(axis=1)) >= MIN_SIZE)
        )
        annotations = [
            {
                "id": len(self._annotations) + k + 1,
                "image_id": number,
                "category_id": CLASSES.index(world[i].class_id) + 1,
                "bbox": _coco_box(image.visible_boxes[i]),
                "area": float(np.prod(sizes[i])),
                "iscrowd": int(not clear[i]),
                "amodal_bbox": _coco_box(image.whole_boxes[i]),
                "visible_share": float(image.visible_shares[i]),
                "object_id": world[i].id,
            }
            for k, i in enumerate(np.flatnonzero(image.visible_shares > 0.0))
        ]
        # All at once: `close` may follow on an interruption.
        self._annotations += annotations
        self._images.append({"id": number, "file_name": name, "width": width, "height": height})

    def close(self) -> int:
        """Write the annotations of the images there are, also of an interrupted data set; returns their number.

        Where there are none, nothing is written.
        """
        if not self._images:
            return 0
        content = {
            "info": {"description": DESCRIPTION},
            "images": self._images,
            "annotations": self._annotations,
            "categories": [{"id": k + 1, "name": name} for k, name in enumerate(CLASSES)],
        }
        # A cut file would tell nobody which images are ours.
        write_whole(self._folder / ANNOTATIONS, json.dumps(content).encode())
        return len(self._images)


def _files_of_data_set(folder: Path, overwrite: bool) -> list[Path]:
    """What has to go before a data set is written to a folder, the annotations last: they tell what is ours.

    Raises:
        CocoError: it holds what is not to be replaced.
    """
    if not folder.exists():
        return []
    refused = CocoError(f"{folder} exists already and is not overwritten; choose another folder")
    if not folder.is_dir():
        raise refused
    content = [path for path in folder.iterdir() if path.name != IMAGES]
    images = folder / IMAGES
    content += images.iterdir() if images.is_dir() else [images] if images.exists() else []
    if not content:
        return []
    if not overwrite:
        raise refused
    ours = _named_by(folder / ANNOTATIONS)
    foreign = sorted(path for path in content if path not in ours or path.is_dir())
    if foreign:
        raise CocoError(
            f"{folder} is not overwritten: {foreign[0]} is not of a data set that was written here; remove it "
            "yourself, or choose another folder"
        )
    return sorted(content, key=lambda path: path.name == ANNOTATIONS)


def _named_by(annotations: Path) -> set[Path]:
    """Annotations of ours and the images that they name; nothing where they are not ours."""
    try:
        content = json.loads(annotations.read_text(encoding="utf-8"))
        if content["info"]["description"] != DESCRIPTION:
            return set()
        return {annotations} | {annotations.with_name(IMAGES) / image["file_name"] for image in content["images"]}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _coco_box(corners: Array) -> list[float]:
    """x, y, width, height [px] of xmin ymin xmax ymax."""
    xmin, ymin, xmax, ymax = corners.tolist()
    return [xmin, ymin, xmax - xmin, ymax - ymin]
