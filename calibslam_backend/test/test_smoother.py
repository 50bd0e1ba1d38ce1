"""Named factors: what is added, taken out and built anew, against the batch optimum of the same factors."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibslam_backend.graph.keys import q, x
from calibslam_backend.graph.smoother import Smoother
from calibslam_msgs_py.measurements import Array

X = [x(k) for k in range(6)]
Q = q(0)
STEP = gtsam.Pose3.Expmap(np.array([0.05, 0.1, -0.05, 0.3, 0.0, 0.1]))
NAMES = ["origin", "fix", "other", *(("motion", k) for k in range(1, 6))]
LOOSE, TIGHT = gtsam.noiseModel.Isotropic.Sigma(6, 0.1), gtsam.noiseModel.Isotropic.Sigma(6, 0.01)


def smoother() -> Smoother:
    return Smoother({"x": (6, 0.0), "q": (9, 0.0)})


def chain(n: int = 6) -> Smoother:
    """n poses one step apart, each added with an update of its own, from starts that are off."""
    s = smoother()
    rng = np.random.default_rng(0)
    pose = gtsam.Pose3()
    for k in range(n):
        s.insert(X[k], pose.retract(0.02 * rng.normal(size=6)))
        if k:
            s.add(("motion", k), gtsam.BetweenFactorPose3(X[k - 1], X[k], STEP, LOOSE))
        else:
            s.add("origin", gtsam.PriorFactorPose3(X[0], pose, TIGHT))
        s.update([X[k]], ())
        pose = pose.compose(STEP)
    return s


def settle(s: Smoother) -> None:
    for _ in range(5):
        for name in NAMES:
            s.renew(name)
        s.update([], ())


def marginals(s: Smoother, keys: list[int]) -> Array:
    return np.stack([s.marginal(key) for key in keys])


def distance(a: gtsam.Values, b: gtsam.Values) -> float:
    return max(float(np.abs(gtsam.Pose3.Logmap(a.atPose3(x).between(b.atPose3(x)))).max()) for x in X if b.exists(x))


def fix_on(k: int, x: float) -> gtsam.NonlinearFactor:
    """A measurement that pose k is x metres to the side of where motions put it."""
    place = gtsam.Pose3.Expmap(np.zeros(6))
    for _ in range(k):
        place = place.compose(STEP)
    return gtsam.PriorFactorPose3(X[k], place.compose(gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0]))), LOOSE)


def test_a_chain_is_where_its_motions_put_it() -> None:
    s = chain()
    settle(s)
    expected = gtsam.Pose3.Expmap(np.zeros(6))
    for k in range(6):
        np.testing.assert_allclose(s.values.atPose3(X[k]).matrix(), expected.matrix(), atol=1e-6)
        expected = expected.compose(STEP)


def test_values_know_new_variables_before_the_update() -> None:
    s = smoother()
    assert not s.values.exists(X[0])
    s.insert(X[0], gtsam.Pose3())
    assert s.values.exists(X[0])


def test_a_factor_taken_out_leaves_no_trace() -> None:
    """Before or after an update: the estimate and the covariances are those without it."""
    without = chain()
    settle(without)
    before, after = chain(), chain()
    before.add("fix", fix_on(5, 0.5))
    assert not before.has("fix")
    before.remove("fix")
    after.add("fix", fix_on(5, 0.5))
    after.update([X[5]], ())
    assert after.has("fix") and distance(after.values, without.values) > 0.05
    after.remove("fix")
    assert not after.has("fix")
    for s in (before, after):
        settle(s)
        assert distance(s.values, without.values) < 1e-6
        np.testing.assert_allclose(marginals(s, X), marginals(without, X), rtol=1e-5, atol=1e-12)


def test_a_name_can_be_used_again_once_it_is_free() -> None:
    s = chain()
    s.add("fix", fix_on(5, 0.5))
    with pytest.raises(ValueError, match="there is a factor fix already"):
        s.add("fix", fix_on(5, 0.2))
    s.update([], ())
    with pytest.raises(ValueError, match="there is a factor fix already"):
        s.add("fix", fix_on(5, 0.2))
    s.remove("fix")
    s.add("fix", fix_on(5, 0.2))  # out and in with one update
    settle(s)
    fresh = chain()
    fresh.add("fix", fix_on(5, 0.2))
    settle(fresh)
    assert distance(s.values, fresh.values) < 1e-6
    with pytest.raises(KeyError):
        s.remove("nothing")


def test_a_variable_goes_with_its_factors() -> None:
    """A quadric in the tree, and one that never got there."""
    s = chain()
    noise = gtsam.noiseModel.Isotropic.Sigma(9, 1.0)
    for updated in (True, False):
        s.insert(Q, np.ones(9))
        s.add("prior", gtsam.PriorFactorVector(Q, np.zeros(9), noise))
        if updated:
            s.update([Q], ())
            np.testing.assert_allclose(s.marginal(Q), np.eye(9), atol=1e-9)
            np.testing.assert_allclose(s.values.atVector(Q), 0.0, atol=1e-9)
        s.remove("prior")
        s.forget(Q)
        assert not s.values.exists(Q)
        s.update([], ())
        assert not s.values.exists(Q)


def test_the_optimum_needs_factors_renewed() -> None:
    """Linear factors stay as they were linearised; renewed at the newest estimate, they lead to the optimum."""
    s = chain()
    s.add("fix", fix_on(5, 1.0))
    s.update([], ())
    optimum = s.optimise(s.values)
    for _ in range(10):
        s.update([], ())
    assert distance(s.values, optimum) > 1e-3
    settle(s)
    assert distance(s.values, optimum) < 1e-3


def test_renewing_what_is_not_in_the_tree_is_nothing() -> None:
    s, t = chain(), chain()
    s.add("fix", fix_on(5, 0.1))
    s.renew("fix")  # waits to be linearised anyway
    s.renew("unknown")
    t.add("fix", fix_on(5, 0.1))
    for each in (s, t):
        each.update([], ())
    assert distance(s.values, t.values) < 1e-12


@pytest.mark.parametrize("held", [True, False])
def test_tangents_do_not_depend_on_the_base_of_coordinates(held: bool) -> None:
    """Whether ISAM2 moves the base of a pose or not, renewed factors find the same optimum and covariances."""
    s = chain()
    s.add("fix", fix_on(5, 0.3))
    for _ in range(8):
        for name in NAMES:
            s.renew(name)
        s.update([], X if held else ())
    fresh = chain()
    fresh.add("fix", fix_on(5, 0.3))
    fresh.rebuild(fresh.optimise(fresh.values), [X[5]])
    assert distance(s.values, fresh.values) < 2e-3
    np.testing.assert_allclose(marginals(s, X), marginals(fresh, X), rtol=0.1, atol=1e-5)


def test_built_anew_it_is_the_same() -> None:
    """Estimate and marginals of a rebuilt tree are those of the one that grew, and it goes on as that does."""
    grown, rebuilt = chain(), chain()
    for s in (grown, rebuilt):
        s.add("fix", fix_on(4, 0.2))
        s.update([], ())
        s.remove("fix")
        s.add("other", fix_on(3, 0.3))
    settle(grown)
    rebuilt.rebuild(rebuilt.values, [X[5]])
    assert rebuilt.has("other") and not rebuilt.has("fix")
    settle(rebuilt)
    assert distance(rebuilt.values, grown.values) < 1e-6
    np.testing.assert_allclose(marginals(rebuilt, X), marginals(grown, X), rtol=1e-5, atol=1e-12)
    for s in (grown, rebuilt):
        s.remove("other")
        settle(s)
    assert distance(rebuilt.values, grown.values) < 1e-6


def test_joint_covariances_hold_the_marginals() -> None:
    s = chain()
    joint = s.joint([X[2], X[4]])
    np.testing.assert_allclose(joint.at(X[2], X[2]), s.marginal(X[2]), atol=1e-12)
    np.testing.assert_allclose(joint.at(X[2], X[4]), joint.at(X[4], X[2]).T, atol=1e-12)
    assert np.abs(joint.at(X[2], X[4])).max() > 1e-3  # what one step moved moves the later poses too


def test_optimise_finds_the_optimum_and_leaves_the_tree() -> None:
    s = chain()
    s.add("fix", fix_on(5, 0.5))
    s.update([], ())
    tree = s.values
    start = gtsam.Values(tree)
    start.update(X[3], tree.atPose3(X[3]).retract(0.1 * np.ones(6)))
    optimum = s.optimise(start)
    assert s.values is tree
    settle(s)
    assert distance(s.values, optimum) < 1e-3


def test_an_indeterminate_system_is_an_error_that_a_rebuild_cures() -> None:
    """Two poses that hang together, but on nothing."""
    s = chain(4)
    for k in (4, 5):
        s.insert(X[k], gtsam.Pose3())
    s.add(("motion", 5), gtsam.BetweenFactorPose3(X[4], X[5], STEP, LOOSE))
    with pytest.raises(RuntimeError, match="Indeterminate linear system"):
        s.update([X[5]], ())
    s.add(("motion", 4), gtsam.BetweenFactorPose3(X[3], X[4], STEP, LOOSE))
    s.rebuild(s.values, [X[5]])
    settle(s)
    whole = chain()
    settle(whole)
    assert distance(s.values, whole.values) < 1e-6
    np.testing.assert_allclose(marginals(s, X), marginals(whole, X), rtol=1e-5, atol=1e-12)
