"""Whether what an update gave can be believed: no pose leaps, no quadric runs away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibslam_backend.geometry.ellipsoid import matrix_from_vector
from calibslam_msgs_py.measurements import Array

# A quadric beyond these is no object any more [m].
LARGEST_RADIUS, LARGEST_DISTANCE, SMALLEST_RADIUS = 10.0, 200.0, 1e-4
LARGEST_STEP = 0.5  # [rad, m] of a pose in one update; an undamped step that is larger cannot be trusted


def is_object(vectors: Array, cameras: Array) -> NDArray[np.bool_]:
    """(M,) whether quadrics (M, 9) have the size of objects, and places not too far from cameras (M, 3) that saw them
    [m]; NaN: none did."""
    finite: NDArray[np.bool_] = np.all(np.isfinite(vectors), axis=1)
    known = np.where(finite[:, None], vectors, 0.0)
    radii = np.exp(np.linalg.eigvalsh(matrix_from_vector(known[:, 3:])))
    away = np.linalg.norm(known[:, :3] - cameras, axis=1)
    return np.asarray(
        finite
        & (radii.min(axis=1) > SMALLEST_RADIUS)
        & (radii.max(axis=1) < LARGEST_RADIUS)
        & ~(away >= LARGEST_DISTANCE)
    )


def leapt(old: Array, new: Array) -> bool:
    """Whether one of the poses (N, 4, 4) has moved by more than `LARGEST_STEP`."""
    moved = np.linalg.norm(new[:, :3, 3] - old[:, :3, 3], axis=1)
    # The norm of the difference of two rotations is 2 sqrt(2) sin(angle / 2).
    turned = np.linalg.norm(new[:, :3, :3] - old[:, :3, :3], axis=(1, 2)) / np.sqrt(2.0)
    return not bool((moved < LARGEST_STEP).all() and (turned < LARGEST_STEP).all())
