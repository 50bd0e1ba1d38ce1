"""A measured box, made ready for estimation: undistorted, whitened, its edges at the image border marked."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibslam_msgs_py.measurements import Array, Boxes, Camera

# A detector draws the border that cuts an object as inaccurately as the object's own edges: an edge nearer to it than
# so many of its standard deviations may be the border. (Taken for the object's own, two fifths of those within one are
# gross errors on real recordings, a seventh between two and three, and as few as anywhere else beyond; docs/method.md.)
BORDER_SIGMAS = 3.0
BORDER = 2.0  # [px], for detectors that are sure of themselves


@dataclass(frozen=True)
class BoxMeasurement:
    """One box in the pinhole image.

    Attributes:
        corners: (4,) xmin ymin xmax ymax, undistorted [px].
        whitener: (4, 4) W with W^T W the inverse covariance [1/px].
        bounds: (4,) the image borders at this box, undistorted [px].
        clip: (4,) bool, edges that may be of the border: the object may go on beyond it.
    """

    corners: Array
    whitener: Array
    bounds: Array
    clip: NDArray[np.bool_]

    @functools.cached_property
    def covariance(self) -> Array:
        """(4, 4) of the corners [px^2]."""
        return np.asarray(np.linalg.inv(self.whitener.T @ self.whitener))

    @functools.cached_property
    def packed(self) -> Array:
        """(7, 4) rows: corners, bounds, clip, whitener. For compiled code: one array instead of four."""
        return np.vstack([self.corners, self.bounds, self.clip, self.whitener])


def stacked(boxes: Sequence[BoxMeasurement]) -> list[NDArray[Any]]:
    """Corners (N, 4), whiteners (N, 4, 4), bounds (N, 4) and clip (N, 4) of N boxes, at least one."""
    return [np.stack([getattr(box, name) for box in boxes]) for name in ("corners", "whitener", "bounds", "clip")]


def cut_alike(boxes: Sequence[BoxMeasurement]) -> list[list[int]]:
    """The indices of boxes of one image, those together whose edges are cut alike: one prediction does for them all."""
    groups: dict[bytes, list[int]] = {}
    for n, box in enumerate(boxes):
        groups.setdefault(box.clip.tobytes(), []).append(n)
    return list(groups.values())


def undistorted(corners: Array, camera: Camera) -> Array:
    """(N, 4) boxes in the distorted image -> (N, 4) in the pinhole image [px].

    An edge of a box is a line that distortion bends. It is moved by its middle, near which the outline of an
    ellipsoid touches it.
    """
    if not np.any(camera.distortion) or not len(corners):
        return corners.copy()
    x = 0.5 * (corners[:, 0] + corners[:, 2])
    y = 0.5 * (corners[:, 1] + corners[:, 3])
    middles = np.stack([corners[:, 0], y, x, corners[:, 1], corners[:, 2], y, x, corners[:, 3]], axis=1)
    points = cv2.undistortPoints(middles.reshape(-1, 1, 2), camera.K, camera.distortion, P=camera.K)
    points = points.reshape(-1, 4, 2)
    return np.stack([points[:, 0, 0], points[:, 1, 1], points[:, 2, 0], points[:, 3, 1]], axis=1)


def prepare(boxes: Boxes, covariances: Array, camera: Camera) -> list[BoxMeasurement]:
    """The boxes of one image with the covariances (N, 4, 4) [px^2] to be used for them."""
    corners = undistorted(boxes.corners, camera)
    image = np.array([0.0, 0.0, camera.width, camera.height])
    x = 0.5 * (boxes.corners[:, 0] + boxes.corners[:, 2])
    y = 0.5 * (boxes.corners[:, 1] + boxes.corners[:, 3])
    zero = np.zeros(len(boxes))
    # The border beside each box: a box as wide and high as the image, around the middle of this one.
    vertical = undistorted(np.stack([zero, 2 * y - image[3], zero + image[2], image[3] + zero], axis=1), camera)
    horizontal = undistorted(np.stack([2 * x - image[2], zero, image[2] + zero, zero + image[3]], axis=1), camera)
    bounds = np.stack([vertical[:, 0], horizontal[:, 1], vertical[:, 2], horizontal[:, 3]], axis=1)
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    clip = boxes.to_border <= np.maximum(BORDER, BORDER_SIGMAS * deviations)
    whiteners = np.linalg.inv(np.linalg.cholesky(covariances))
    return [BoxMeasurement(*each) for each in zip(corners, whiteners, bounds, clip, strict=True)]
