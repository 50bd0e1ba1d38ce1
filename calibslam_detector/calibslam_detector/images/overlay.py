"""Boxes and their uncertainty drawn on an image (as in the document's figure 5.2)."""

from __future__ import annotations

import zlib

import cv2
import numpy as np

from calibslam_msgs_py.measurements import Array, Boxes

SIGMAS = 2.0  # the ellipses' size
CORNERS = ((0, 1), (2, 3))  # top left and bottom right: places in a box
SUBPIXEL_BITS = 4


def draw_overlay(image: np.ndarray, boxes: Boxes) -> np.ndarray:
    """A copy of an image (H, W, 3) uint8 BGR with each box, its class and score, and ellipses of 2 sigma about its top
    left and bottom right corners. Boxes without a covariance have no ellipses.
    """
    drawn = image.copy()
    for k in range(len(boxes)):
        colour = class_colour(boxes.class_ids[k])
        low, high = (_fixed_point(boxes.corners[k, list(corner)]) for corner in CORNERS)
        cv2.rectangle(drawn, low, high, colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        if boxes.has_covariance[k]:
            for corner in CORNERS:
                _draw_ellipse(
                    drawn, boxes.corners[k, list(corner)], boxes.covariances[k][np.ix_(corner, corner)], colour
                )
        draw_label(drawn, f"{boxes.class_ids[k]} {boxes.scores[k]:.2f}", boxes.corners[k, :2], colour)
    return drawn


def ellipse_axes(covariance: Array) -> tuple[Array, float]:
    """Half axes (2,) of the ellipse of 2 sigma [px], the longer first, and the angle of that [rad] from x to y."""
    variances, directions = np.linalg.eigh(covariance)
    longest = directions[:, 1]
    return SIGMAS * np.sqrt(variances[::-1]), float(np.arctan2(longest[1], longest[0]))


def class_colour(class_id: str) -> tuple[int, int, int]:
    """A bright BGR colour that is always the same for a class."""
    hue = zlib.crc32(class_id.encode()) % 180
    blue, green, red = cv2.cvtColor(np.array([[[hue, 200, 255]]], np.uint8), cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return blue, green, red


def _draw_ellipse(image: np.ndarray, centre: Array, covariance: Array, colour: tuple[int, int, int]) -> None:
    axes, angle = ellipse_axes(covariance)
    # An ellipse larger than the image is drawn as that large: OpenCV's numbers are limited.
    half_axes = _fixed_point(np.minimum(axes, float(max(image.shape))))
    cv2.ellipse(
        image, _fixed_point(centre), half_axes, np.degrees(angle), 0.0, 360.0, colour, 1, cv2.LINE_AA, SUBPIXEL_BITS
    )


def draw_label(image: np.ndarray, text: str, corner: Array, colour: tuple[int, int, int]) -> None:
    """Write a text above a point (2,) [px], in the image, on a dark field."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)
    x = int(np.clip(corner[0], 0, max(image.shape[1] - width, 0)))
    y = int(np.clip(corner[1] - 3, height + 1, image.shape[0] - 1))
    cv2.rectangle(image, (x, y - height - 2), (x + width, y + 2), (0, 0, 0), cv2.FILLED)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)


def _fixed_point(values: Array) -> tuple[int, int]:
    x, y = np.rint(np.asarray(values) * 2**SUBPIXEL_BITS).astype(int).tolist()
    return x, y
