"""Which landmark a box belongs to: predictions against sampling, the gate against chi-squared, votes by hand."""

from __future__ import annotations

import itertools
from collections import Counter

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2
from small_world import CAMERA, around, objects

from calibslam_backend.association.matching import (
    SIZE_RATIO,
    AssociationSettings,
    Prediction,
    Votes,
    assign,
    at_one_place,
    class_costs,
    distances,
    new_object_cost,
    predict,
    same_object,
    unambiguous,
)
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part, image_bounds
from calibslam_msgs_py.measurements import Array

BOUNDS = image_bounds(CAMERA.width, CAMERA.height)
POSE, VECTOR = around(1)[0], objects()[4].vector()
COVARIANCE = np.array([[4.0, 1, 0.5, 0], [1, 9, 0, 0.5], [0.5, 0, 5, -1], [0, 0.5, -1, 6]])


def box(corners: Array, covariance: Array = COVARIANCE) -> BoxMeasurement:
    return BoxMeasurement(corners, np.linalg.inv(np.linalg.cholesky(covariance)), BOUNDS, np.zeros(4, bool))


def seen(pose: Array, vector: Array) -> Array:
    return np.asarray(box_of_visible_part(pose, vector, CAMERA.K, BOUNDS, ALL_EDGES)[1])


def test_prediction_against_sampling() -> None:
    """5,000 poses and quadrics drawn together; 10 % is 5 standard deviations of a sampled variance."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(15, 15))
    covariance = (A @ A.T + np.eye(15)) * 1e-7
    prediction = predict(POSE, VECTOR, covariance, CAMERA.K, box(np.zeros(4)), 0.0)
    assert prediction is not None
    np.testing.assert_allclose(prediction[0], seen(POSE, VECTOR))
    pose = gtsam.Pose3(POSE)
    samples = [
        seen(pose.retract(step[:6]).matrix(), VECTOR + step[6:])
        for step in rng.multivariate_normal(np.zeros(15), covariance, size=5000)
    ]
    sampled = np.cov(np.stack(samples).T)
    sigmas = np.sqrt(np.diag(sampled))
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(prediction[1] / scale, sampled / scale, atol=0.1)


def test_an_ellipsoid_is_only_a_model() -> None:
    """Its own error: a share of width and height, on top of what is uncertain."""
    corners = seen(POSE, VECTOR)
    prediction = predict(POSE, VECTOR, np.zeros((15, 15)), CAMERA.K, box(corners), 0.1)
    assert prediction is not None
    width, height = corners[2:] - corners[:2]
    np.testing.assert_allclose(prediction[1], np.diag([width, height, width, height]) ** 2 * 0.01, atol=1e-9)
    behind = POSE.copy()
    behind[:3, 3] = POSE[:3, 3] + 5.0 * POSE[:3, 2]
    assert predict(behind, VECTOR, np.zeros((15, 15)), CAMERA.K, box(corners), 0.1) is None


@pytest.mark.parametrize("gate", [0.9, 0.99])
def test_the_gate_lets_its_share_of_right_boxes_pass(gate: float) -> None:
    """4,000 boxes with prediction and measurement errors as stated: 3.3 standard deviations of a share allowed."""
    rng = np.random.default_rng(1)
    corners, predicted = np.array([200.0, 150.0, 330.0, 260.0]), np.diag([3.0, 2.0, 4.0, 1.0]) ** 2
    errors = rng.multivariate_normal(np.zeros(4), predicted + COVARIANCE, size=4000)
    prediction = Prediction(corners, predicted, "cup")
    boxes = [box(corners + e) for e in errors]
    cost = distances([prediction], boxes, ["cup"] * 4000, AssociationSettings(gate=gate))
    share = np.isfinite(cost).mean()
    assert abs(share - gate) < 3.3 * np.sqrt(gate * (1.0 - gate) / 4000)
    # The same boxes by hand.
    S = predicted + COVARIANCE
    squared = np.einsum("ni,ni->n", errors, np.linalg.solve(S, errors.T).T)
    np.testing.assert_array_equal(np.isfinite(cost[0]), squared < chi2.ppf(gate, 4))
    passed = squared < chi2.ppf(gate, 4)
    np.testing.assert_allclose(cost[0, passed], 0.5 * (squared[passed] + np.log(np.linalg.det(S))))


def test_a_wrong_class_costs_its_odds_and_little_overlap_is_no_match() -> None:
    corners = np.array([200.0, 150.0, 330.0, 260.0])
    prediction = Prediction(corners, np.eye(4) * 1e4, "cup")
    settings = AssociationSettings(wrong_class=0.05, min_overlap=0.3)
    boxes = [box(corners), box(corners), box(corners + np.array([80.0, 0, 80, 0]))]  # overlap 50 / 210
    cost = distances([prediction], boxes, ["cup", "book", "cup"], settings)[0]
    assert cost[1] - cost[0] == pytest.approx(-np.log(0.05))
    assert np.isinf(cost[2])
    assert distances([], boxes, ["cup"] * 3, settings).shape == (0, 3)
    assert np.isinf(distances([None], boxes, ["cup"] * 3, settings)).all()


def test_cost_of_a_class_by_hand() -> None:
    """Of 10 boxes 8 are cups and 2 are bottles: -2 log(0.95 share + 0.05)."""
    quadrics = [Counter(cup=8, bottle=2), Counter(), Counter(cup=3, book=0)]
    costs = {name: class_costs(quadrics, name, 0.05) for name in ("cup", "bottle", "book")}
    shares = {"cup": [0.81, 0.05, 1.0], "bottle": [0.24, 0.05, 0.05], "book": [0.05, 0.05, 0.05]}
    # Of nothing known, every class is as likely; boxes that were taken away again count as none.
    for name, expected in shares.items():
        np.testing.assert_allclose(costs[name], -2.0 * np.log(expected))
    assert class_costs([], "cup", 0.05).shape == (0,)


def test_the_surer_landmark_is_not_always_the_nearer_one() -> None:
    """A vague prediction pays for its vagueness: log det."""
    corners = np.array([200.0, 150.0, 330.0, 260.0])
    sure = Prediction(corners + 1.0, np.eye(4), "cup")
    vague = Prediction(corners, np.eye(4) * 400.0, "cup")
    cost = distances([sure, vague], [box(corners)], ["cup"], AssociationSettings())
    assert cost[0, 0] < cost[1, 0]


def test_what_is_too_vague_may_as_well_be_new() -> None:
    """Boxes of a 640 x 480 image: 640^2 / 2 pairs of left and right edges, 480^2 / 2 of upper and lower ones."""
    new = np.log(204_800.0 * 115_200.0) - 2.0 * np.log(2.0 * np.pi) - np.log(0.05)
    assert new_object_cost(BOUNDS, 0.05) == pytest.approx(new)
    corners, settings = np.array([200.0, 150.0, 330.0, 260.0]), AssociationSettings(wrong_class=0.05)
    for factor, expected in ((0.99, True), (1.01, False)):
        variance = np.exp(factor * new / 2.0)  # the cost of a box right there is log(variance^4) / 2
        prediction = Prediction(corners, np.eye(4) * variance - COVARIANCE, "cup")
        assert np.isfinite(distances([prediction], [box(corners)], ["cup"], settings)[0, 0]) == expected


def test_the_cheapest_assignment_of_all() -> None:
    """Against every one-to-one assignment, on random costs with forbidden pairs."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        rows, columns = rng.integers(1, 5, size=2)
        cost = rng.normal(0.0, 10.0, size=(rows, columns))
        cost[rng.random(cost.shape) < 0.4] = np.inf
        pairs = assign(cost)
        assert all(np.isfinite(cost[p]) for p in pairs)
        assert len({r for r, _ in pairs}) == len({c for _, c in pairs}) == len(pairs)
        best = (0, 0.0)
        options = [[c for c in range(columns) if np.isfinite(cost[r, c])] + [None] for r in range(rows)]
        for choice in itertools.product(*options):
            taken = [c for c in choice if c is not None]
            if len(set(taken)) == len(taken):
                total = sum(cost[r, c] for r, c in enumerate(choice) if c is not None)
                best = min(best, (-len(taken), total))  # as many pairs as possible, then the cheapest
        assert len(pairs) == -best[0]
        assert sum(cost[p] for p in pairs) == pytest.approx(best[1], abs=1e-6)


def test_nothing_can_be_assigned() -> None:
    assert assign(np.full((2, 3), np.inf)) == []
    assert assign(np.empty((0, 3))) == []


def test_votes_by_hand() -> None:
    """Three are needed, and twice those of all others."""
    votes = Votes(3)
    assert [votes.add(1, 5), votes.add(1, 5), votes.add(1, 5)] == [None, None, 5]
    # One stray vote needs nothing more than the three.
    assert [votes.add(2, 8)] + [votes.add(2, 5) for _ in range(3)] == [None, None, None, 5]
    # Two stray votes ask for four.
    assert [votes.add(3, n) for n in (8, 9, 5, 5, 5, 5)] == [None] * 5 + [5]
    assert votes.add(4, 5) is None  # tracks do not share votes
    votes.forget(1)
    assert votes.add(1, 5) is None


def at(x: float, radius: float) -> Array:
    T = np.eye(4)
    T[0, 3] = x
    return Ellipsoid(T, np.full(3, radius)).vector()


def test_same_objects_are_near_and_alike() -> None:
    # The centres may be 0.7 of the two radii apart: 0.14 m.
    others = [at(0.13, 0.1), at(0.15, 0.1), at(0.0, 0.1 * SIZE_RATIO * 0.99), at(0.0, 0.1 * SIZE_RATIO * 1.01)]
    assert same_object(at(0.0, 0.1), np.stack(others), 0.7).tolist() == [True, False, True, False]


def test_what_another_would_suit_nearly_as_well_is_not_decided() -> None:
    cost = np.array([[1.0, 9.0, np.inf], [3.0, 2.0, 4.0]])
    pairs = [(0, 0), (1, 1), (1, 2)]
    assert unambiguous(cost, pairs, 2.5) == [(1, 1), (1, 2)]
    assert unambiguous(cost, pairs, 2.0) == pairs
    assert unambiguous(cost[:1], [(0, 0)], 9.0) == [(0, 0)]


def test_two_objects_of_a_class_need_two_places() -> None:
    """Centres nearer than half the mean radius of the smaller; all pairs at once."""
    vectors = np.stack([at(0.0, 0.1), at(0.03, 0.08), at(0.045, 0.08), at(0.0, 0.5)])
    assert at_one_place(vectors[0], vectors).tolist() == [True, True, False, True]
    assert at_one_place(vectors[:, None], vectors[None]).tolist() == [
        [True, True, False, True], [True, True, True, True], [False, True, True, False], [True, True, False, True],
    ]  # fmt: skip
