"""Evenly spread points."""

from __future__ import annotations

import numpy as np

from calibslam_msgs_py.measurements import Array

G = 1.2207440846057596  # the positive root of g^4 = g + 1


def unit_cube(n: int) -> Array:
    """Points (n, 3) of low discrepancy in [0, 1)^3: multiples of 1/g^1, 2, 3 (R3 of Roberts, 2018)."""
    return np.asarray((0.5 + np.outer(np.arange(1, n + 1), G ** -np.arange(1.0, 4.0))) % 1.0)
