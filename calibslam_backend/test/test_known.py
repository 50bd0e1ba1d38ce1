"""What is known of a map's quadrics together: the motion of the whole map, and the tree of what is left."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.graph.keys import q
from calibslam_backend.graph.known import (
    Known,
    MapPrior,
    conditional,
    conditional_factor,
    moved_with_map,
    prior_of,
    tree,
)
from calibslam_msgs_py.measurements import Array


def blocks_of(joint: Array, d: int) -> Array:
    """(N d, N d) -> (N, N, d, d)."""
    n = len(joint) // d
    return joint.reshape(n, d, n, d).swapaxes(1, 2)


def random_walk(steps: list[float]) -> Array:
    """(N, N) covariances of numbers that each add an error of such a variance to the one before."""
    sums = np.cumsum(steps)
    return np.minimum(sums[:, None], sums[None, :])


def quadrics(n: int, seed: int = 0) -> list[Array]:
    """n vectors (9,) of ellipsoids in a room."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(n):
        T = gtsam.Pose3.Expmap(rng.normal(size=6)).matrix()
        result.append(Ellipsoid(T, rng.uniform(0.1, 0.5, 3)).vector())
    return result


def covariance(vectors: list[Array], frame: Array, own: float = 0.01, seed: int = 1) -> Array:
    """(9 N, 9 N) of quadrics that are moved together and err by themselves."""
    G = np.concatenate([moved_with_map(vector) for vector in vectors])
    rng = np.random.default_rng(seed)
    return np.asarray(G @ frame @ G.T + np.diag(rng.uniform(0.5, 2.0, 9 * len(vectors)) * own**2))


FRAME = np.diag([0.1, 0.2, 0.15, 1.0, 2.0, 0.5]) ** 2


def test_moved_with_the_map_against_a_motion() -> None:
    (vector,) = quadrics(1)
    ellipsoid = Ellipsoid.from_vector(vector)
    step = 1e-6

    def moved(tangent: Array) -> Array:
        turned = gtsam.Pose3(gtsam.Rot3.Expmap(tangent[:3]), tangent[3:]).matrix() @ ellipsoid.T_world_object
        return Ellipsoid(turned, ellipsoid.radii).vector()

    columns = [(moved(step * unit) - moved(-step * unit)) / (2.0 * step) for unit in np.eye(6)]
    np.testing.assert_allclose(moved_with_map(vector), np.stack(columns, axis=1), atol=1e-8)


def test_neighbours_of_a_random_walk_belong_together() -> None:
    """Each depends on the one before alone, whatever their order."""
    order = np.array([3, 0, 4, 1, 2])
    joint = random_walk([1.0, 0.5, 2.0, 1.0, 0.7])[np.ix_(order, order)]
    found = tree(blocks_of(joint, 1))
    assert {frozenset(order[list(pair)].tolist()) for pair in found} == {frozenset((i, i + 1)) for i in range(4)}
    done = {0}
    for child, parent in found:
        assert parent in done
        done.add(child)
    assert done == set(range(5))


def test_independent_variables_and_one_alone() -> None:
    assert len(tree(blocks_of(np.eye(4), 1))) == 3
    assert tree(blocks_of(np.eye(2), 2)) == []


@pytest.mark.parametrize("n", [1, 2, 7])
def test_together_they_are_what_was_known(n: int) -> None:
    vectors = quadrics(n)
    blocks = blocks_of(covariance(vectors, FRAME), 9)
    ids = list(range(7, 7 + n))
    found = prior_of(ids, vectors, blocks)
    assert sorted(found.quadrics) == ids
    for i, j in enumerate(ids):
        np.testing.assert_allclose(found.with_frame()[j].covariance, blocks[i, i], atol=2e-8)
        assert np.linalg.eigvalsh(found.quadrics[j].covariance)[0] > 0.0


@pytest.mark.parametrize("away", [1e2, 1e4])
def test_far_away_they_are_known_as_well(away: float) -> None:
    """A small turn of the map is there a shift of kilometres, beside which quadrics are known to a centimetre."""
    vectors = quadrics(8)
    for vector in vectors:
        vector[0] += away
    blocks = blocks_of(covariance(vectors, FRAME), 9)
    found = prior_of(range(8), vectors, blocks)
    whole = found.with_frame()
    for j, known in found.quadrics.items():
        np.testing.assert_allclose(whole[j].covariance, blocks[j, j], atol=1e-4 * np.abs(blocks[j, j]).max())
        assert np.linalg.eigvalsh(known.covariance)[0] > 0.0
        if known.parent is not None:
            conditional(known, found.quadrics[known.parent])


def test_the_motion_of_the_map_is_found() -> None:
    """With many quadrics it is known as well as it is: what each errs by itself averages out."""
    vectors = quadrics(40)
    found = prior_of(range(40), vectors, blocks_of(covariance(vectors, FRAME), 9))
    np.testing.assert_allclose(found.frame, FRAME, atol=1e-4)
    assert max(np.trace(known.covariance) for known in found.quadrics.values()) < 40.0 * 0.01**2


def test_the_graph_of_the_tree_has_these_covariances() -> None:
    vectors = quadrics(12)
    found = prior_of(range(12), vectors, blocks_of(covariance(vectors, FRAME), 9))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for j, known in found.quadrics.items():
        values.insert(q(j), known.vector)
        if known.parent is None:
            noise = gtsam.noiseModel.Gaussian.Covariance(known.covariance)
            graph.push_back(gtsam.PriorFactorVector(q(j), known.vector, noise))
        else:
            graph.push_back(conditional_factor(q(j), known, q(known.parent), found.quadrics[known.parent]))
    assert graph.error(values) == pytest.approx(0.0, abs=1e-12)
    marginals = gtsam.Marginals(graph, values)
    for j, known in found.quadrics.items():
        np.testing.assert_allclose(marginals.marginalCovariance(q(j)), known.covariance, atol=1e-9)
        if known.parent is not None:
            both = marginals.jointMarginalCovariance([q(j), q(known.parent)])
            np.testing.assert_allclose(both.at(q(j), q(known.parent)), known.cross, atol=1e-9)


def test_a_motion_that_no_quadric_tells_is_not_known() -> None:
    """A ball that is turned about its centre is the same: nothing is said of such turns, instead of any number."""
    ball = np.zeros(9)
    ball[:3] = 0.0, 0.0, 5.0
    found = prior_of([3], [ball], np.eye(9)[None, None] * 0.01)
    assert np.trace(found.frame) < 0.1
    np.testing.assert_allclose(found.with_frame()[3].covariance, np.eye(9) * 0.01, atol=2e-8)


def test_what_depends_on_nothing_or_on_itself_is_refused() -> None:
    own = Known(np.zeros(9), np.eye(9))
    for quadrics in ({1: replace(own, parent=1)}, {1: replace(own, parent=2), 2: own}):
        with pytest.raises(ValueError, match="depends on one that has none, or on itself"):
            MapPrior(np.zeros((6, 6)), quadrics).check()


@pytest.mark.parametrize("size", [1e200, 1e308, np.nan])
def test_covariances_beyond_all_numbers_are_refused(size: float) -> None:
    own = Known(np.zeros(9), np.eye(9))
    with pytest.raises(ValueError, match="larger than their own allow"):
        conditional(replace(own, parent=0, cross=np.full((9, 9), size)), own)


def test_covariances_that_cannot_be_are_refused() -> None:
    parent = Known(np.zeros(9), np.eye(9))
    conditional(Known(np.zeros(9), np.eye(9), 0, 0.99 * np.eye(9)), parent)
    with pytest.raises(ValueError, match="larger than their own allow"):
        conditional(Known(np.zeros(9), np.eye(9), 0, 1.01 * np.eye(9)), parent)
