"""Boxes of keyframes beside the quadrics that they show: errors, and what each noise model says of them.

A box belongs to the quadric whose projected box overlaps it most, one to one, of the same class: what the back end
decided in a run is not kept in its folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibslam_backend.association.matching import assign, predicted_corners
from calibslam_backend.association.tracking import overlap
from calibslam_backend.geometry.box_measurement import BoxMeasurement, prepare
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.graph.noise import spread
from calibslam_msgs_py.measurements import Array, Boxes, Camera

MIN_OVERLAP = 0.3  # intersection over union below which a box does not show a quadric
LARGEST_RESIDUAL = 5.0  # that enters a correlation: it should not hang on a few gross errors
FEWEST_PAIRS = 100  # of edges, for a correlation
MIN_BOXES = 5  # an object with fewer has no spread to speak of


@dataclass(frozen=True)
class Sightings:
    """M boxes with their quadrics.

    Attributes:
        image: (M,) number of the image.
        box: (M,) number of the box in its image.
        quadric: (M,) number of the quadric.
        corners: (M, 4) measured, undistorted [px].
        errors: (M, 4) measured minus projected [px]; NaN for an edge that may be the border of the image.
        covariances: (M, 4, 4) that the boxes carry [px^2]; NaN where unknown.
    """

    image: NDArray[np.int_]
    box: NDArray[np.int_]
    quadric: NDArray[np.int_]
    corners: Array
    errors: Array
    covariances: Array

    def heuristic(self) -> Array:
        """(M,) standard deviation of QuadricSLAM [px], the same for all boxes of an object (eq. 4.3.1)."""
        return self._of_objects({int(n): spread(self.corners[self.quadric == n]) for n in set(self.quadric.tolist())})

    def calibrated(self) -> Array:
        """(M,) standard deviation of an edge, rms over the edges [px]; NaN where unknown."""
        return np.asarray(np.sqrt(np.trace(self.covariances, axis1=1, axis2=2) / 4.0))

    def often_seen(self) -> list[int]:
        """Numbers of the quadrics with enough boxes, those of the largest heuristic deviation first."""
        counts = {int(n): int(c) for n, c in zip(*np.unique(self.quadric, return_counts=True), strict=True)}
        sigma = dict(zip(self.quadric.tolist(), self.heuristic().tolist(), strict=True))
        return sorted((n for n, count in counts.items() if count >= MIN_BOXES), key=lambda n: -sigma[n])

    def neighbour_correlation(self) -> float:
        """Correlation of the errors of a box and of the next image's of the same object, in units of their deviations;
        NaN where there are too few.

        A factor graph takes it for zero. Where it is not, n boxes say less than n independent ones would.
        """
        z = self.errors / np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))
        z = np.clip(z, -LARGEST_RESIDUAL, LARGEST_RESIDUAL)
        order = np.lexsort((self.image, self.quadric))
        first, second = order[:-1], order[1:]
        together = (self.quadric[first] == self.quadric[second]) & (self.image[second] == self.image[first] + 1)
        a, b = z[first[together]].ravel(), z[second[together]].ravel()
        known = ~(np.isnan(a) | np.isnan(b))
        if np.count_nonzero(known) < FEWEST_PAIRS:
            return float("nan")
        return float(np.corrcoef(a[known], b[known])[0, 1])

    def _of_objects(self, values: dict[int, float]) -> Array:
        return np.array([values[n] for n in self.quadric.tolist()])


def find_sightings(
    images: Sequence[Boxes], poses: Array, quadrics: Sequence[Ellipsoid], classes: Sequence[str] | None, camera: Camera
) -> Sightings:
    """Which boxes show which quadrics.

    Args:
        images: F images' boxes.
        poses: (F, 4, 4) of the camera in the frame of the quadrics.
        quadrics: as estimated, or the true ones.
        classes: of the quadrics; None: not known, any class matches.
        camera: that took the images.
    """
    vectors = [quadric.vector() for quadric in quadrics]
    rows: list[tuple[int, int, int]] = []
    corners, errors, covariances = [], [], []
    for k, (boxes, pose) in enumerate(zip(images, np.ascontiguousarray(poses), strict=True)):
        stated = np.where(boxes.has_covariance[:, None, None], boxes.covariances, np.eye(4))
        measured = prepare(boxes, stated, camera)
        predicted = [[predicted_corners(pose, vector, camera.K, box) for box in measured] for vector in vectors]
        cost = np.full((len(vectors), len(measured)), np.inf)
        for q, of_quadric in enumerate(predicted):
            for b, found in enumerate(of_quadric):
                if classes is None or classes[q] == boxes.class_ids[b]:
                    cost[q, b] = _cost(found, measured[b])
        for q, b in assign(cost):
            found = predicted[q][b]
            assert found is not None  # its cost is finite
            rows.append((k, b, q))
            corners.append(measured[b].corners)
            errors.append(np.where(measured[b].clip, np.nan, measured[b].corners - found))
            covariances.append(boxes.covariances[b])
    image, box, quadric = np.reshape(np.array(rows, int), (-1, 3)).T
    return Sightings(
        image, box, quadric, np.reshape(corners, (-1, 4)), np.reshape(errors, (-1, 4)),
        np.reshape(covariances, (-1, 4, 4)),
    )  # fmt: skip


def _cost(predicted: Array | None, box: BoxMeasurement) -> float:
    """1 - intersection over union; infinite where that is too small, or the quadric not in sight."""
    if predicted is None or not (predicted[2:] > predicted[:2]).all():
        return float("inf")
    shared = float(overlap(predicted[None], box.corners[None])[0, 0])
    return 1.0 - shared if shared >= MIN_OVERLAP else float("inf")
