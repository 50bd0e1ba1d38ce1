"""vision_msgs/Detection2DArray -> Boxes: what most detectors for ROS 2 publish."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from calibslam_msgs_py.geometry_conversions import stamp_from_msg
from calibslam_msgs_py.measurements import Boxes, Camera, InvalidMeasurement

DETECTIONS_2D = "vision_msgs/msg/Detection2DArray"
SMALLEST_ROTATION = 1e-3  # [rad]: below, a box is upright


def boxes_from_detections_2d(msg: Any, camera: Camera) -> tuple[Boxes, dict[str, int]]:
    """Boxes without covariance of a Detection2DArray, and how many were left out for which reason.

    A box is of the class of its hypothesis with the highest score; its `id` is taken as object_id. Reasons: `rotated`
    (box edges are not those of the image), `no_hypothesis`.

    Args:
        msg: of the layout since ROS 2 Humble; it does not tell the image's size.
        camera: that took the image.

    Raises:
        InvalidMeasurement: `layout`, if it is of an older vision_msgs.
    """
    corners, class_ids, scores, object_ids = [], [], [], []
    rejected: Counter[str] = Counter()
    try:
        for detection in msg.detections:
            if not detection.results:
                rejected["no_hypothesis"] += 1
                continue
            best = max((result.hypothesis for result in detection.results), key=lambda hypothesis: hypothesis.score)
            centre, size = detection.bbox.center, np.array([detection.bbox.size_x, detection.bbox.size_y])
            if abs(centre.theta) > SMALLEST_ROTATION:
                rejected["rotated"] += 1
                continue
            middle = np.array([centre.position.x, centre.position.y])
            corners.append(np.concatenate([middle - size / 2.0, middle + size / 2.0]))
            class_ids.append(str(best.class_id))
            scores.append(float(best.score))
            object_ids.append(str(detection.id))
    except AttributeError as error:
        raise InvalidMeasurement("layout", f"not the Detection2DArray of Humble or later: {error}") from None
    boxes = Boxes(
        stamp=stamp_from_msg(msg.header.stamp),
        width=camera.width,
        height=camera.height,
        corners=np.array(corners, dtype=np.float64).reshape(-1, 4),
        covariances=np.full((len(corners), 4, 4), np.nan),
        class_ids=tuple(class_ids),
        scores=np.array(scores, dtype=np.float64),
        object_ids=tuple(object_ids),
        frame_id=str(msg.header.frame_id),
    )
    return boxes, dict(rejected)
