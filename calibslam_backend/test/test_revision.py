"""Whose a box of an earlier keyframe is: frames made by hand."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibslam_backend.association.matching import AssociationSettings, class_costs
from calibslam_backend.association.revision import COHERENCE, REACH, SPAN, Evidence, Revision, squared_distances
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.shape import shapes
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part, image_bounds
from calibslam_msgs_py.measurements import Array

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
BOUNDS = image_bounds(640, 480)
SIGMA = 3.0  # [px] of an edge
LEFT, RIGHT = 4, 9  # ids
SETTINGS = AssociationSettings(gate=0.99, model_error=0.0, wrong_class=0.05)
GATE = 13.2767  # chi-squared, 4 degrees of freedom, 0.99
CUPS = Counter(cup=20)


def at(x: float, radius: float = 0.1) -> Array:
    """(9,) a ball at 2 m, x metres to the right of the optical axis."""
    T = np.eye(4)
    T[:3, 3] = [x, 0.0, 2.0]
    return Ellipsoid(T, np.full(3, radius)).vector()


def seen(quadric: Array) -> Array:
    return np.asarray(box_of_visible_part(np.eye(4), quadric, K, BOUNDS, ~ALL_EDGES)[1])


# Two neighbours whose boxes, 50 px wide, overlap: 25 px apart.
QUADRICS = np.stack([at(-0.05), at(0.05)])


def arrays(boxes: Sequence[Array]) -> list[Array]:
    """Corners, covariances, bounds and clip of boxes, as `Revision.judge` takes them."""
    n = len(boxes)
    covariances, clip = np.tile(np.eye(4) * SIGMA**2, (n, 1, 1)), np.zeros((n, 4), bool)
    return [np.reshape(boxes, (n, 4)), covariances, np.tile(BOUNDS, (n, 1)), clip]


def track(fits: dict[int, dict[int, float]]) -> Evidence:
    """A track whose boxes fit so, by keyframe and quadric."""
    evidence = Evidence()
    for k, fit in fits.items():
        evidence.learn(k, fit)
    return evidence


def whose(
    boxes: Sequence[Array],
    classes: Sequence[str] | None = None,
    tracks: Sequence[Evidence] | None = None,
    classes_of: Sequence[Counter[str]] = (CUPS, CUPS),
    settings: AssociationSettings = SETTINGS,
) -> list[int | None]:
    """The quadric of each box of keyframe 50, the camera being at the origin."""
    revision = Revision(QUADRICS, [LEFT, RIGHT], classes_of, K, (640, 480), settings)
    n = len(boxes)
    return revision.judge(np.eye(4), arrays(boxes), classes or ["cup"] * n, tracks or [Evidence() for _ in boxes], 50)


def test_boxes_go_to_the_quadrics_they_fit() -> None:
    boxes = [seen(quadric) for quadric in QUADRICS]
    assert whose(boxes) == [LEFT, RIGHT]
    assert whose(boxes[::-1]) == [RIGHT, LEFT]


def test_a_box_whose_track_fits_the_neighbour_is_moved() -> None:
    """Also where all of its track fits there, as long as it fits clearly: 25 px off are more than the bonus."""
    wrong = track({49: {LEFT: -100.0}})
    assert whose([seen(QUADRICS[1])], tracks=[wrong]) == [RIGHT]


def test_boxes_are_assigned_together() -> None:
    """Two boxes that both fit the left one best: one has to be the right one's, the one for which it is cheaper."""
    nearer, farther = seen(QUADRICS[0]) + 8.0 * np.array([1, 0, 1, 0]), seen(QUADRICS[0]) + 9.0 * np.array([1, 0, 1, 0])
    loose = replace(SETTINGS, gate=0.9999, model_error=0.2)
    assert whose([nearer], settings=loose) == whose([farther], settings=loose) == [LEFT]
    assert whose([nearer, farther], settings=loose) == [LEFT, RIGHT]


def test_a_box_of_nothing_stays_open() -> None:
    """Beyond the gate of every quadric: without overlap, or too far for its covariance."""
    boxes = [seen(at(0.6)), seen(QUADRICS[1]) + 12.0 * np.array([1, 0, 1, 0])]  # q = 2 (12 / 3)^2 = 32
    assert whose(boxes) == [None, None]
    assert whose([]) == []


@pytest.mark.parametrize(("share", "expected"), [(0.99, LEFT), (1.01, None)])
def test_the_gate_by_hand(share: float, expected: int | None) -> None:
    """Two edges moved by d: q = 2 (d / sigma)^2. Away from the neighbour."""
    d = share * SIGMA * np.sqrt(0.5 * (GATE - class_costs([CUPS], "cup", SETTINGS.wrong_class)[0]))
    assert whose([seen(QUADRICS[0]) - d * np.array([1, 0, 1, 0])]) == [expected]


def test_classes_are_evidence() -> None:
    """Half way between both, the class decides; against a clear fit it does not."""
    middle = seen(at(0.0))
    classes_of = (Counter(cup=20), Counter(bottle=20))
    loose = replace(SETTINGS, model_error=0.2)
    for class_id, expected in (("cup", LEFT), ("bottle", RIGHT)):
        assert whose([middle], [class_id], classes_of=classes_of, settings=loose) == [expected]
    assert whose([seen(QUADRICS[0])], ["bottle"], classes_of=classes_of) == [LEFT]


@pytest.mark.parametrize("expected", [LEFT, RIGHT])
def test_the_track_decides_a_tie(expected: int) -> None:
    loose = replace(SETTINGS, model_error=0.2)
    assert whose([seen(at(0.0))], tracks=[track({48: {expected: -5.0}})], settings=loose) == [expected]


@pytest.mark.parametrize(("share", "expected"), [(0.98, LEFT), (1.02, None)])
def test_the_bonus_of_coherence_by_hand(share: float, expected: int | None) -> None:
    """A box whose neighbours surely are of a quadric is taken beyond the gate, by half of the bonus."""
    q = GATE + 0.5 * COHERENCE - class_costs([CUPS], "cup", SETTINGS.wrong_class)[0]
    d = share * SIGMA * np.sqrt(0.5 * q)
    sure = track({51: {LEFT: -100.0}})
    assert whose([seen(QUADRICS[0]) - d * np.array([1, 0, 1, 0])], tracks=[sure]) == [expected]


def test_evidence_by_hand() -> None:
    """Odds exp(fit / 2), of none 1; a neighbour at a distance d counts exp(-d / SPAN)."""
    evidence = track({10: {LEFT: -4.0, RIGHT: -2.0}, 10 + SPAN: {RIGHT: -3.0}})
    odds = {LEFT: math.exp(2.0), RIGHT: math.exp(1.0 + 1.5 / math.e)}
    total = 1.0 + sum(odds.values())
    assert evidence.shares(10) == pytest.approx({j: each / total for j, each in odds.items()})
    assert evidence.fits(10 + SPAN) == {RIGHT: -3.0}
    assert evidence.fits(11) is None


def test_evidence_ends_where_a_track_may_have_slipped() -> None:
    """A track that was on one object for long and then on another: each part by itself."""
    slipped = track({**{k: {LEFT: -15.0} for k in range(30)}, **{k: {RIGHT: -15.0} for k in range(30, 40)}})
    assert slipped.shares(20)[LEFT] > 0.99
    assert slipped.shares(36)[RIGHT] > 0.99
    assert slipped.shares(40 + REACH) == {}


def test_evidence_learns_anew() -> None:
    evidence = track({10: {LEFT: -4.0}})
    evidence.learn(10, {RIGHT: -4.0})
    assert evidence.shares(10) == pytest.approx({RIGHT: 1.0 / (1.0 + math.exp(-2.0))})


def test_distances_by_hand() -> None:
    """q = sum of (edge / sigma)^2, sigma^2 = 3^2 + (0.1 * 50)^2 with a model error of a tenth of the box."""
    box = seen(QUADRICS[0]) + np.array([1.0, 2.0, -3.0, 4.0])
    stacked = arrays([box])
    image = np.array([640.0, 480.0])
    found = squared_distances(np.eye(4), QUADRICS, shapes(QUADRICS), K, image, *stacked, 0.1)
    size = seen(QUADRICS[0])[2:] - seen(QUADRICS[0])[:2]
    variance = SIGMA**2 + (0.1 * np.tile(size, 2)) ** 2
    assert found.shape == (2, 1)
    assert found[0, 0] == pytest.approx((np.array([1.0, 4.0, 9.0, 16.0]) / variance).sum(), rel=1e-9)
    behind = np.diag([1.0, -1.0, -1.0, 1.0])
    assert np.isinf(squared_distances(behind, QUADRICS, shapes(QUADRICS), K, image, *stacked, 0.1)).all()
