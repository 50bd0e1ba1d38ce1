"""How much of an object other objects hide."""

from __future__ import annotations

import numpy as np

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_msgs_py.measurements import Array
from calibslam_sim.simulation.sampling import unit_cube

POINTS = 27


def hidden_shares(ellipsoids: list[Ellipsoid], p_world_camera: Array) -> Array:
    """Share (F, N) of each ellipsoid's volume whose line of sight to the camera at (F, 3) [m] meets another.

    Measured at `POINTS` points of each ellipsoid.
    """
    points = [_points_inside(ellipsoid) for ellipsoid in ellipsoids]
    shares = np.zeros((len(p_world_camera), len(ellipsoids)))
    for i, target in enumerate(points):
        hidden = np.zeros((len(p_world_camera), len(target)), bool)
        for j, other in enumerate(ellipsoids):
            if i != j:
                hidden |= _segments_meet(other, p_world_camera, target)
        shares[:, i] = hidden.mean(axis=1)
    return shares


def _points_inside(ellipsoid: Ellipsoid) -> Array:
    """Points (POINTS, 3) in the world, spread evenly over the volume.

    No two of them share a direction, so that one behind the other cannot count for many.
    """
    u = unit_cube(POINTS)
    radius, height, angle = np.cbrt(u[:, 0]), 2.0 * u[:, 1] - 1.0, 2.0 * np.pi * u[:, 2]
    flat = np.sqrt(1.0 - height**2)
    sphere = radius[:, None] * np.column_stack([flat * np.cos(angle), flat * np.sin(angle), height])
    T = ellipsoid.T_world_object
    return np.asarray(sphere * ellipsoid.radii @ T[:3, :3].T + T[:3, 3])


def _segments_meet(ellipsoid: Ellipsoid, starts: Array, ends: Array) -> np.ndarray:
    """(F, M) whether the segment from starts (F, 3) to ends (M, 3) meets the ellipsoid."""
    T = ellipsoid.T_world_object
    # In coordinates where the ellipsoid is the unit sphere: is the nearest point of the segment inside?
    a = (starts - T[:3, 3]) @ T[:3, :3] / ellipsoid.radii
    b = (ends - T[:3, 3]) @ T[:3, :3] / ellipsoid.radii
    aa = np.sum(a * a, axis=1)[:, None]
    bb = np.sum(b * b, axis=1)[None, :]
    ab = a @ b.T
    length = aa + bb - 2.0 * ab
    s = np.clip((aa - ab) / length, 0.0, 1.0)
    return np.asarray(aa + 2.0 * s * (ab - aa) + s * s * length < 1.0)
