"""What foretells a box's error: each cue by hand."""

from __future__ import annotations

import math

import pytest
import torch

from calibslam_detector.model.region_cues import (
    AGREEMENT,
    GEOMETRY,
    HIDING,
    SECOND_LOOK,
    Chosen,
    agreement,
    geometry,
    hiding,
    second_look,
)


def chosen(boxes: list[list[float]], scores: list[float], labels: list[int], regions: list[int]) -> Chosen:
    return Chosen(torch.tensor(boxes), torch.tensor(scores), torch.tensor(labels), torch.tensor(regions))


def test_geometry_tells_size_borders_and_scores() -> None:
    one = chosen([[0.0, 30.0, 40.0, 60.0]], [0.5], [2], [1])
    class_scores = torch.tensor([[1.0, 0.0, 0.0], [0.1, 0.4, 0.5]])
    numbers = geometry(one, class_scores, (100, 100))[0].tolist()
    expected = [
        math.log(0.4), math.log(0.3), 1.0, math.exp(-30 / 1.5), math.exp(-60 / 2.0), math.exp(-40 / 1.5),
        0.0, math.log(0.1 / 0.9) / 4.0, math.log(0.4 / 0.6) / 4.0,
    ]  # fmt: skip
    assert numbers == pytest.approx(expected, abs=1e-6) and len(numbers) == GEOMETRY


def test_agreement_is_weighted_by_scores() -> None:
    """Box 0 to 10; of its class one region says 1 to 10 (score 0.2), one 0 to 10 (0.6); others are elsewhere or of
    another class."""
    one = chosen([[0.0, 0.0, 10.0, 10.0]], [0.9], [1], [0])
    far, same, moved = [50.0, 50.0, 60.0, 60.0], [0.0, 0.0, 10.0, 10.0], [1.0, 0.0, 10.0, 10.0]
    of_class = torch.tensor([same, moved, same, far])
    boxes = torch.stack([torch.zeros(4, 4), of_class, torch.tensor([far, same, far, same])], dim=1)
    scores = torch.tensor([[0.0, 0.9, 0.1], [0.7, 0.2, 0.1], [0.3, 0.6, 0.1], [0.1, 0.9, 0.0]])
    proposals = torch.tensor([[0.0, 2.0, 10.0, 10.0], far, far, far])
    numbers = agreement(one, boxes, scores, proposals)[0].tolist()
    assert len(numbers) == AGREEMENT
    # xmin: offsets 0.1 (weight 0.2) and 0 (0.6): mean 0.025, variance 0.1^2 * 0.25 * 0.75.
    assert numbers[0] == pytest.approx(math.tanh(4.0 * 0.025), rel=1e-5)
    assert numbers[1:4] == pytest.approx([0.0] * 3)
    assert numbers[4] == pytest.approx(math.log(0.001875 + 1e-6) / 6.0, rel=1e-5)
    assert numbers[5] == pytest.approx(math.log(1e-6) / 6.0, rel=1e-4)
    assert numbers[8:10] == pytest.approx([math.log(1.8), math.log(3) / 3.0], rel=1e-5)
    assert numbers[10:] == pytest.approx([0.0, math.tanh(-0.4), 0.0, 0.0], rel=1e-5)


def test_a_box_alone_agrees_with_nothing() -> None:
    one = chosen([[0.0, 0.0, 10.0, 10.0]], [0.9], [1], [0])
    boxes = one.boxes[:, None].repeat(1, 2, 1)
    numbers = agreement(one, boxes, torch.tensor([[0.1, 0.9]]), one.boxes)
    assert bool(torch.isfinite(numbers).all()) and float(numbers[0, 8]) == 0.0


def test_hiding_tells_which_edge_and_who_is_in_front() -> None:
    """A box of 10 x 10; another of another class covers the lower half of its right edge and stands lower."""
    two = chosen([[0.0, 0.0, 10.0, 10.0], [8.0, 5.0, 18.0, 15.0]], [0.9, 0.8], [1, 2], [0, 1])
    behind, before = hiding(two, two).tolist()
    assert len(behind) == HIDING
    front = 1.0 / (1.0 + math.exp(-5.0))  # lower by half a height, in units of a tenth
    xmin, ymin, xmax, ymax = behind[0:2], behind[2:4], behind[4:6], behind[6:8]
    assert xmin == [0.0, 0.0] and ymin == [0.0, 0.0]
    assert xmax == pytest.approx([0.5 * 0.8, 0.5 * 0.8 * front], rel=1e-5)
    assert ymax == pytest.approx([0.2 * 0.8, 0.2 * 0.8 * front], rel=1e-5)
    area, union = 0.2 * 0.5 * 0.8, 190.0
    assert behind[8:] == pytest.approx([area, area * front, area * (1.0 - front), 10.0 / union * 0.8, 0.0], rel=1e-3)
    # The other way round the first is behind: its share of the front is small.
    assert before[0] == pytest.approx(0.5 * 0.9) and before[1] < 0.01


def test_nobody_unsure_hides() -> None:
    two = chosen([[0.0, 0.0, 10.0, 10.0], [8.0, 5.0, 18.0, 15.0]], [0.9, 0.2], [1, 1], [0, 1])
    assert hiding(two, two)[0].tolist() == [0.0] * HIDING
    nobody = two[torch.zeros(2, dtype=torch.bool)]
    assert hiding(nobody, two).shape == (0, HIDING) and hiding(nobody, nobody).shape == (0, HIDING)


def test_second_look() -> None:
    numbers = second_look(torch.tensor([[0.5, 0.0, -1.0, 0.0]]), torch.tensor([0.5]), torch.tensor([0.0]))[0].tolist()
    expected = [math.tanh(0.5), 0.0, math.tanh(-1.0), 0.0]
    expected += [math.log(0.53) / 2, math.log(0.03) / 2, math.log(1.03) / 2, math.log(0.03) / 2]
    expected += [0.0, math.log(0.001 / 0.999) / 4]
    assert numbers == pytest.approx(expected, abs=1e-5) and len(numbers) == SECOND_LOOK
