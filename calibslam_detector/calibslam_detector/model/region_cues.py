"""What foretells how wrong a box is, beside the features of its region: numbers (N, CUES) of N chosen boxes.

Size, place and scores; whether the other regions' boxes of the object agree (as BayesOD: Harakeh et al., ICRA 2020,
infers covariances from such clusters); which edges another object hides; and what the box head says when it looks once
more, at the box instead of the proposal (the second stage of Cascade R-CNN: Cai and Vasconcelos, CVPR 2018, with the
first one's weights).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

GEOMETRY, AGREEMENT, HIDING, SECOND_LOOK = 9, 14, 13, 10
CUES = GEOMETRY + AGREEMENT + HIDING + SECOND_LOOK
SAME_OBJECT = 0.5  # intersection over union from which boxes of a class are taken as of one object
LEAST_NEIGHBOUR = 0.3  # score from which another box may hide this one's edges
TINY = 1e-3


@dataclass(frozen=True)
class Chosen:
    """Chosen boxes, N of an image, and where they come from.

    Attributes:
        boxes: (N, 4) [px].
        scores, labels: (N,).
        regions: (N,) index of the region each comes from.
    """

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    regions: Tensor

    def __getitem__(self, which: Tensor) -> Chosen:
        return Chosen(self.boxes[which], self.scores[which], self.labels[which], self.regions[which])


def geometry(chosen: Chosen, class_scores: Tensor, size: tuple[int, int]) -> Tensor:
    """(N, GEOMETRY): how large a box is, how near each border, how sure of its class.

    Args:
        chosen: the boxes.
        class_scores: (P, C) of all regions, background first.
        size: height and width of the image [px].
    """
    height, width = size
    boxes, extents = chosen.boxes, _extents(chosen.boxes)
    borders = torch.stack([boxes[:, 0], boxes[:, 1], width - boxes[:, 2], height - boxes[:, 3]], dim=1)
    of_box = class_scores[chosen.regions]
    background = of_box[:, 0]
    runner_up = of_box[:, 1:].scatter(1, chosen.labels[:, None] - 1, 0.0).amax(dim=1)
    return torch.cat(
        [
            torch.log(extents / math.sqrt(height * width)),
            torch.exp(-borders.clamp(min=0.0) / (0.05 * extents.repeat(1, 2))),
            _logits(torch.stack([chosen.scores, background, runner_up], dim=1)),
        ],
        dim=1,
    )


def agreement(chosen: Chosen, boxes: Tensor, class_scores: Tensor, proposals: Tensor) -> Tensor:
    """(N, AGREEMENT): how far the other regions' boxes of the same object are from the chosen one, in its extents.

    Mean and spread (4 + 4) of the edges, weighted with their scores; how many they are; and how far the box is from
    its own proposal (4).

    Args:
        chosen: the boxes.
        boxes: (P, C, 4) of all regions and classes, background first [px].
        class_scores: (P, C).
        proposals: (P, 4) [px].
    """
    extents = _extents(chosen.boxes).repeat(1, 2)
    others = boxes[:, chosen.labels].transpose(0, 1)
    near = _overlaps(others, chosen.boxes[:, None]) > SAME_OBJECT
    weights = class_scores[:, chosen.labels].T * near
    weights = weights.scatter(1, chosen.regions[:, None], 0.0)
    total = weights.sum(dim=1, keepdim=True)
    offsets = (others - chosen.boxes[:, None]) / extents[:, None]
    mean = (weights[..., None] * offsets).sum(dim=1) / total.clamp(min=TINY)
    variance = (weights[..., None] * (offsets - mean[:, None]).square()).sum(dim=1) / total.clamp(min=TINY)
    from_proposal = (chosen.boxes - proposals[chosen.regions]) / extents
    return torch.cat(
        [
            torch.tanh(4.0 * mean),
            torch.log(variance + TINY**2) / 6.0,
            torch.log1p(total),
            torch.log(near.sum(dim=1, keepdim=True).clamp(min=1)) / 3.0,
            torch.tanh(2.0 * from_proposal),
        ],
        dim=1,
    )


def hiding(chosen: Chosen, found: Chosen) -> Tensor:
    """(N, HIDING): how much of each edge another box covers, and one that is in front of it; how much of the box.

    What stands further down in the image is nearer, on a floor or a table.

    Args:
        chosen: the boxes.
        found: all boxes of the image that are sure enough, the chosen ones among them.
    """
    result = chosen.boxes.new_zeros((len(chosen.boxes), HIDING))
    if not len(found.boxes):
        return result
    boxes, others = chosen.boxes[:, None], found.boxes[None]
    extents = _extents(chosen.boxes)[:, None]
    sure = found.scores * (found.scores > LEAST_NEIGHBOUR)
    weights = sure[None] * (boxes != others).any(dim=2)
    covered = _intersections(boxes, others) / extents
    in_front = torch.sigmoid((others[..., 3] - boxes[..., 3]) / (0.1 * extents[..., 1]))
    same_class = chosen.labels[:, None] == found.labels[None]
    columns = []
    for edge in range(4):
        axis = edge % 2
        crosses = (others[..., axis] < boxes[..., edge]) & (others[..., 2 + axis] > boxes[..., edge])
        hidden = crosses * covered[..., 1 - axis] * weights
        columns += [hidden, hidden * in_front]
    area = covered.prod(dim=2) * weights
    overlap = _overlaps(boxes, others) * weights
    columns += [area, area * in_front, area * (1.0 - in_front), overlap, overlap * same_class]
    return torch.stack(columns, dim=2).amax(dim=1)


def second_look(deltas: Tensor, scores: Tensor, background: Tensor) -> Tensor:
    """(N, SECOND_LOOK): where the box head would move the box if it were the proposal, and how sure it is then.

    Args:
        deltas: (N, 4) in the box coder's units.
        scores: (N,) of the box's class.
        background: (N,).
    """
    return torch.cat(
        [
            torch.tanh(deltas),
            torch.log(deltas.abs() + 0.03) / 2.0,
            _logits(torch.stack([scores, background], dim=1)),
        ],
        dim=1,
    )


def _extents(boxes: Tensor) -> Tensor:
    """Width and height (..., 2) [px], at least 1."""
    return (boxes[..., 2:] - boxes[..., :2]).clamp(min=1.0)


def _intersections(a: Tensor, b: Tensor) -> Tensor:
    """Width and height (..., 2) [px] of what boxes share."""
    return (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(min=0.0)


def _overlaps(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union (...) of boxes (..., 4)."""
    shared = _intersections(a, b).prod(dim=-1)
    union = sum(((box[..., 2:] - box[..., :2]).prod(dim=-1) for box in (a, b)), -shared)
    return shared / union.clamp(min=TINY**2)


def _logits(probabilities: Tensor) -> Tensor:
    return torch.logit(probabilities.clamp(TINY, 1.0 - TINY)) / 4.0
