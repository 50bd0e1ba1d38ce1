"""What a map says before anything new is seen: how well its quadrics are known, and what their errors have in common.

The quadrics of a map share most of their error: that of the camera when it saw them. Taken for independent, N of them
would tell sqrt(N) times better than any of them where the map is, and a map that is begun with again and again would
become surer each time, of nothing.

What all have in common is a motion g of the whole map. Nothing that is seen in the map can tell it any more, so it is
taken out. (A camera that begins at the map's origin can: there it is an error of the quadrics again.) With G the
derivative of all quadrics by g, the best estimate of g from their errors (Gauss and Markov) has the covariance
F = (G^T S^-1 G)^-1 and does not correlate with what is left of them, so that exactly

    S = G F G^T + R.

F stays as it is, is part of every covariance that is published, and adds up with each start. The graph goes on with R,
of which all together would tie every quadric to every other, and updates would take the longer the more there are. So
each keeps its covariance with one other, the one that it has most information in common with. Of all trees that is the
one whose distribution is nearest to the joint one (least Kullback-Leibler divergence; Chow and Liu 1968): each quadric,
and each pair of neighbours in the tree, is known as well as it was. Given its parent p, quadric j is

    q_j - v_j = A (q_p - v_p) + e,    A = R_jp R_pp^-1,    e ~ N(0, R_jj - A R_pj).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from calibslam_backend.geometry.ellipsoid import matrix_from_vector, vector_from_matrix
from calibslam_msgs_py.covariance import symmetric
from calibslam_msgs_py.measurements import Array

# Deviations of a motion of the map [rad, m]: of more, nothing is known.
LARGEST_MOTION = np.array([1.0] * 3 + [100.0] * 3)
LEAST = 1e-8  # variance [m^2] that is left of every number, where the motion of the map tells all of it


@dataclass(frozen=True)
class Known:
    """A quadric that is known.

    Attributes:
        vector: (9,) its estimate, v_j.
        covariance: (9, 9) of it, R_jj.
        parent: the quadric that it depends on; None: on none.
        cross: (9, 9) R_jp: rows are its own, columns the parent's; zero without a parent.
    """

    vector: Array
    covariance: Array
    parent: int | None = None
    cross: Array = field(default_factory=lambda: np.zeros((9, 9)))


@dataclass(frozen=True)
class MapPrior:
    """What a map says of its quadrics.

    Attributes:
        frame: (6, 6) covariance F of a motion of the whole map, [rotation, translation] at its origin.
        quadrics: each beside that, R; parents before those that depend on them.
    """

    frame: Array
    quadrics: Mapping[int, Known]

    def with_frame(self) -> dict[int, Known]:
        """The quadrics with all that they err by."""
        G = {j: moved_with_map(known.vector) for j, known in self.quadrics.items()}
        whole = {}
        for j, known in self.quadrics.items():
            whole[j] = replace(known, covariance=known.covariance + G[j] @ self.frame @ G[j].T)
            if known.parent is not None:
                whole[j] = replace(whole[j], cross=known.cross + G[j] @ self.frame @ G[known.parent].T)
        return whole

    def check(self) -> None:
        """Raises ValueError if a quadric depends on one that is not there before it, or as `conditional`."""
        done: dict[int, Known] = {}
        for j, known in self.quadrics.items():
            if known.parent is not None:
                if known.parent not in done:
                    raise ValueError(f"the prior of quadric {j} depends on one that has none, or on itself")
                try:
                    conditional(known, done[known.parent])
                except ValueError as error:
                    raise ValueError(f"the prior of quadric {j}: {error}") from None
            done[j] = known


NOTHING_KNOWN = MapPrior(np.zeros((6, 6)), {})


def moved_with_map(vector: Array) -> Array:
    """(9, 6) derivative G of a quadric by a motion of the whole map."""
    L = matrix_from_vector(vector[3:])
    G = np.zeros((9, 6))
    for n, turn in enumerate(np.eye(3)):
        turned = np.cross(turn, L, axisb=0, axisc=0)
        G[3:, n] = vector_from_matrix(turned + turned.T)  # [w] L - L [w]
        G[:3, n] = np.cross(turn, vector[:3])
    G[:3, 3:] = np.eye(3)
    return G


def prior_of(quadrics: Sequence[int], vectors: Sequence[Array], blocks: Array) -> MapPrior:
    """What is left of a map to begin with.

    Args:
        quadrics: N ids, at least one.
        vectors: N estimates (9,).
        blocks: (N, N, 9, 9) covariances S of and between them.
    """
    n = len(quadrics)
    G = np.concatenate([moved_with_map(vector) for vector in vectors])
    S = blocks.swapaxes(1, 2).reshape(9 * n, 9 * n)
    weighted = np.linalg.solve(S, G)
    frame = _covariance_of_frame(symmetric(G.T @ weighted))
    # S - G F G^T as a square: far from the origin the difference is much smaller than what it is of.
    rest = np.eye(9 * n) - G @ frame @ weighted.T
    R = rest @ S @ rest.T + LEAST * np.eye(9 * n)
    left = R.reshape(n, 9, n, 9).swapaxes(1, 2)
    known = {quadrics[0]: Known(vectors[0], left[0, 0])}
    for child, parent in tree(left):
        j, p, alone = quadrics[child], quadrics[parent], Known(vectors[child], left[child, child])
        depending = replace(alone, parent=p, cross=left[child, parent])
        known[j] = depending if _is_one_distribution(depending, known[p]) else alone
    return MapPrior(frame, known)


def _covariance_of_frame(information: Array) -> Array:
    """F (6, 6), in those directions that the quadrics tell: of balls in a row, a turn about it is none of them."""
    scale = np.outer(LARGEST_MOTION, LARGEST_MOTION)
    told, axes = np.linalg.eigh(scale * information)
    return np.asarray(scale * ((axes * np.where(told > 1.0, 1.0 / np.maximum(told, 1.0), 0.0)) @ axes.T))


def _is_one_distribution(known: Known, parent: Known) -> bool:
    """Rounding can make it none."""
    try:
        conditional(known, parent)
    except ValueError:
        return False
    return True


def tree(blocks: Array) -> list[tuple[int, int]]:
    """Pairs (child, parent) of the tree of Chow and Liu whose root is the first variable, parents before children.

    Args:
        blocks: (N, N, d, d) covariances of N variables.
    """
    n, d = len(blocks), blocks.shape[-1]
    own = np.linalg.slogdet(blocks[range(n), range(n)])[1]
    weights = np.zeros((n, n))
    for i in range(n - 1):
        others = range(i + 1, n)
        pairs = np.empty((n - 1 - i, 2 * d, 2 * d))
        pairs[:, :d, :d], pairs[:, :d, d:] = blocks[i, i], blocks[i, others]
        pairs[:, d:, :d], pairs[:, d:, d:] = blocks[others, i], blocks[others, others]
        shared = 0.5 * (own[i] + own[others] - np.linalg.slogdet(pairs)[1])
        weights[i, others] = -1.0 - np.maximum(shared, 0.0)  # of independent variables too: zero would be no edge
    order, parents = breadth_first_order(minimum_spanning_tree(weights), 0, directed=False)
    return [(int(child), int(parents[child])) for child in order[1:]]


def conditional(known: Known, parent: Known) -> tuple[Array, Array]:
    """A (9, 9), and the square root (9, 9) W of the information of e, W^T W its inverse covariance.

    Raises:
        ValueError: the two covariances and the one between them are none of one distribution.
    """
    refused = ValueError("its covariance with its parent is larger than their own allow")
    with np.errstate(over="ignore", invalid="ignore"):
        A = np.linalg.solve(parent.covariance, known.cross.T).T
        left = known.covariance - A @ known.cross.T
    if not np.isfinite(left).all():
        raise refused
    try:
        root = np.linalg.cholesky(left)
    except np.linalg.LinAlgError:
        raise refused from None
    return np.asarray(A), np.asarray(np.linalg.inv(root))


def conditional_factor(key: int, known: Known, parent_key: int, parent: Known) -> gtsam.NonlinearFactor:
    """Quadric `key`, given its parent; raises ValueError as `conditional`."""
    A, W = conditional(known, parent)
    values = gtsam.Values()
    values.insert(key, known.vector)
    values.insert(parent_key, parent.vector)
    unit = gtsam.noiseModel.Unit.Create(len(W))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(key, W, parent_key, -W @ A, np.zeros(len(W)), unit), values)
