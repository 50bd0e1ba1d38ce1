"""Rendered images and their boxes as a data set in COCO format: `images/*.jpg` and `annotations.json`.

Beside what COCO defines, an annotation holds `amodal_bbox` (the whole object's, cut at the image border),
`visible_share` and `object_id`. What is hardly to be seen is marked `iscrowd`: neither wanted nor wrong.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_msgs_py.measurements import Array
from calibslam_sim.rendering.render import RenderedImage
from calibslam_sim.simulation.world import AROUND_TABLE, ON_TABLE, WorldObject

CLASSES = tuple(sorted({kind.class_id for kind in ON_TABLE + AROUND_TABLE}))
ANNOTATIONS, IMAGES = "annotations.json", "images"
MIN_VISIBLE = 0.3  # share of an object that is not hidden
MIN_IN_IMAGE = 0.15  # share of its box inside the image
MIN_SIZE = 8.0  # [px] of its visible part


class CocoError(Exception):
    """A data set that cannot be written; the text names the next step."""


class CocoWriter:
    """Writes a data set; `close` completes it.

    Args:
        folder: to write; must not hold anything.
        overwrite: replace a data set that is there (never anything else).

    Raises:
        CocoError: the folder holds something.
    """

    def __init__(self, folder: Path, overwrite: bool = False) -> None:
        content = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
        foreign = [name for name in content if name not in (ANNOTATIONS, IMAGES)]
        if folder.exists() and (not folder.is_dir() or foreign or (content and not overwrite)):
            raise CocoError(f"{folder} exists already and is not overwritten; choose another folder")
        if content:
            shutil.rmtree(folder)
        (folder / IMAGES).mkdir(parents=True)
        self._folder = folder
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def add(self, image: RenderedImage, world: tuple[WorldObject, ...]) -> None:
        """Add an image of this world."""
        number = len(self._images) + 1
        height, width = image.image.shape[:2]
        name = f"{number:06d}.jpg"
        (self._folder / IMAGES / name).write_bytes(image.jpeg())
        self._images.append({"id": number, "file_name": name, "width": width, "height": height})
        sizes = image.visible_boxes[:, 2:] - image.visible_boxes[:, :2]
        clear = (
            (image.visible_shares >= MIN_VISIBLE)
            & (image.in_image_shares >= MIN_IN_IMAGE)
            & (np.nan_to_num(sizes.min(axis=1)) >= MIN_SIZE)
        )
        for i in np.flatnonzero(image.visible_shares > 0.0):
            self._annotations.append(
                {
                    "id": len(self._annotations) + 1,
                    "image_id": number,
                    "category_id": CLASSES.index(world[i].class_id) + 1,
                    "bbox": _coco_box(image.visible_boxes[i]),
                    "area": float(np.prod(sizes[i])),
                    "iscrowd": int(not clear[i]),
                    "amodal_bbox": _coco_box(image.whole_boxes[i]),
                    "visible_share": float(image.visible_shares[i]),
                    "object_id": world[i].id,
                }
            )

    def close(self) -> None:
        """Write the annotations."""
        content = {
            "info": {"description": "CalibSLAM's rendered desks"},
            "images": self._images,
            "annotations": self._annotations,
            "categories": [{"id": k + 1, "name": name} for k, name in enumerate(CLASSES)],
        }
        (self._folder / ANNOTATIONS).write_text(json.dumps(content), encoding="utf-8")


def _coco_box(corners: Array) -> list[float]:
    """x, y, width, height [px] of xmin ymin xmax ymax."""
    xmin, ymin, xmax, ymax = corners.tolist()
    return [xmin, ymin, xmax - xmin, ymax - ymin]
