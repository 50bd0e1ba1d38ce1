"""Ellipsoids as dual quadrics, and the nine numbers by which they are estimated (document, section 2.3.1).

An ellipsoid has a pose (R, t) and three semi-axes r, and so the shape S = R diag(r^2) R^T.

For estimation it is the vector (t, L): its centre in the map and its logarithmic shape L = R diag(log r) R^T, so that
S = exp(2 L). The document's parameters (rotation, centre, radii; eq. 2.3.2) have no rotation where radii are equal,
and turn the axes of an object by leaps where they nearly are; L is smooth there, any L is an ellipsoid, and a Gaussian
prior on it means the same however the object is turned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibslam_backend.geometry.shape import ROOT2
from calibslam_msgs_py.measurements import Array

# Which entry of the vector (6,) of L (see `shape`) each of the nine of the matrix is, and times what.
_ENTRIES = np.array([0, 3, 4, 3, 1, 5, 4, 5, 2])
_SCALES = np.where(_ENTRIES < 3, 1.0, 1.0 / ROOT2)


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid: `T_world_object` (4, 4), semi-axes `radii` (3,) [m]."""

    T_world_object: Array
    radii: Array

    @classmethod
    def from_vector(cls, vector: Array) -> Ellipsoid:
        """From (t, L), radii ascending."""
        logarithms, axes = np.linalg.eigh(matrix_from_vector(vector[3:]))
        T = np.eye(4)
        T[:3, :3] = axes * np.sign(np.linalg.det(axes))
        T[:3, 3] = vector[:3]
        return cls(T, np.exp(logarithms))

    def vector(self) -> Array:
        """(9,) (t, L) in the world."""
        R = self.T_world_object[:3, :3]
        L = (R * np.log(self.radii)) @ R.T
        return np.concatenate([self.T_world_object[:3, 3], vector_from_matrix(L)])


def mean_radius(vectors: Array) -> Array:
    """Geometric mean of the semi-axes (...) [m] of quadrics (..., 9): a third of the trace of L is its logarithm."""
    return np.asarray(np.exp(vectors[..., 3:6].sum(axis=-1) / 3.0))


def vector_from_matrix(L: Array) -> Array:
    """Symmetric (3, 3) -> (6,) of the same norm."""
    return np.concatenate([np.diag(L), ROOT2 * np.array([L[0, 1], L[0, 2], L[1, 2]])])


def matrix_from_vector(v: Array) -> Array:
    """(..., 6) -> symmetric (..., 3, 3)."""
    return np.asarray((v[..., _ENTRIES] * _SCALES).reshape(*v.shape[:-1], 3, 3))


def covariance_of_pose_and_radii(vector: Array, covariance: Array) -> Array:
    """Covariance (9, 9) of (t, L) -> that of (rotation, translation in the body, radii) of `Ellipsoid.from_vector`.

    With equal radii a rotation is not observable and has no covariance; no axis is less certain than one turned
    uniformly over the half circle after which an ellipsoid looks the same, variance pi^2 / 12.
    """
    ellipsoid = Ellipsoid.from_vector(vector)
    R = ellipsoid.T_world_object[:3, :3]
    l = np.log(ellipsoid.radii)  # noqa: E741 - as in the text above
    J = np.zeros((9, 9))
    J[3:6, :3] = R.T
    basis = np.stack([R.T @ matrix_from_vector(v) @ R for v in np.eye(6)])  # dL seen in the body, by component
    for n, (i, j, k) in enumerate(((1, 2, 0), (2, 0, 1), (0, 1, 2))):
        # R -> R Exp(phi) changes L in the body by phi_k (l_i - l_j) at (i, j).
        gap = l[i] - l[j]
        J[n, 3:] = basis[:, i, j] / (gap if abs(gap) > 1e-9 else 1e-9)
        J[6 + k, 3:] = basis[:, k, k] * ellipsoid.radii[k]
    result = J @ covariance @ J.T
    uniform = np.pi**2 / 12.0
    shrink = np.sqrt(uniform / (uniform + np.diag(result)[:3]))
    scale = np.concatenate([shrink, np.ones(6)])
    return np.asarray(result * np.outer(scale, scale))


def covariance_of_vector(T_map_object: Array, radii: Array, covariance: Array) -> Array:
    """`covariance_of_pose_and_radii` turned back: covariance (9, 9) of (t, L), positive definite.

    Where radii are nearly equal, that says less than there was, as no rotation is less certain than uniform: L comes
    back too sure. What is to be gone on with is kept as it is (`known`).
    """
    R, l = T_map_object[:3, :3], np.log(radii)  # noqa: E741
    J = np.zeros((9, 9))
    J[:3, 3:6] = R
    for n, (i, j, k) in enumerate(((1, 2, 0), (2, 0, 1), (0, 1, 2))):
        turned = np.zeros((3, 3))
        turned[i, j] = turned[j, i] = l[i] - l[j]
        grown = np.zeros((3, 3))
        grown[k, k] = 1.0 / radii[k]
        J[3:, n] = vector_from_matrix(R @ turned @ R.T)
        J[3:, 6 + k] = vector_from_matrix(R @ grown @ R.T)
    # Where radii are equal, no rotation changes L: give those directions a little freedom.
    return np.asarray(J @ covariance @ J.T + 1e-9 * np.eye(9))
