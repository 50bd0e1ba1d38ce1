"""From the covariance of box deltas to that of corners in pixels.

A two-stage detector describes a box by its difference from a proposal with centre c, width w and height h
(Girshick et al., 2014): x = c_x + w d_x / 10, width = w exp(d_w / 5), likewise y and height; 10 and 5 are the
weights of torchvision's box coder. Their errors are modelled as Gaussian with covariance L D L^T, D diagonal;
L couples d_x with d_w and d_y with d_h: what is known of one edge of a box says nothing of the opposite one,
and neither centre nor width can say that alone. Without coupling it is the document's model (chapter 4).
"""

from __future__ import annotations

import torch
from torch import Tensor

# Place of each kind of number in the head's output: 4 variances and the coupling of d_w to d_x and of d_h to d_y.
VARIANCES, COUPLINGS = slice(0, 4), slice(4, 6)
OUTPUTS = 6


def decoder_jacobian(proposals: Tensor, boxes: Tensor, weights: tuple[float, ...]) -> Tensor:
    """d(xmin, ymin, xmax, ymax) / d(d_x, d_y, d_w, d_h), shape (N, 4, 4) [px].

    Args:
        proposals: (N, 4) [px].
        boxes: (N, 4) that the deltas stand for [px].
        weights: of the box coder, for x, y, width and height.
    """
    jacobian = proposals.new_zeros((len(proposals), 4, 4))
    for axis in (0, 1):
        by_centre = (proposals[:, 2 + axis] - proposals[:, axis]) / weights[axis]
        by_size = 0.5 * (boxes[:, 2 + axis] - boxes[:, axis]) / weights[2 + axis]
        jacobian[:, axis, axis] = by_centre
        jacobian[:, 2 + axis, axis] = by_centre
        jacobian[:, axis, 2 + axis] = -by_size
        jacobian[:, 2 + axis, 2 + axis] = by_size
    return jacobian


def coupling_matrix(couplings: Tensor) -> Tensor:
    """L (N, 4, 4) of couplings (N, 2): d_w takes part in what d_x does, d_h in what d_y does."""
    L = torch.eye(4, dtype=couplings.dtype, device=couplings.device).repeat(len(couplings), 1, 1)
    L[:, 2, 0] = couplings[:, 0]
    L[:, 3, 1] = couplings[:, 1]
    return L


def decoupled(residuals: Tensor, couplings: Tensor) -> Tensor:
    """L^-1 r (N, 4): residuals of deltas (N, 4) whose covariance is diagonal; det L = 1, so densities stay."""
    return torch.cat([residuals[:, :2], residuals[:, 2:] - couplings * residuals[:, :2]], dim=1)


def corner_covariances(
    variances: Tensor, couplings: Tensor, proposals: Tensor, boxes: Tensor, weights: tuple[float, ...]
) -> Tensor:
    """Covariances (N, 4, 4) [px^2] of corners: J L D L^T J^T with the decoder's exact Jacobian J.

    Args:
        variances: (N, 4), D.
        couplings: (N, 2), L.
        proposals, boxes, weights: see `decoder_jacobian`.
    """
    A = decoder_jacobian(proposals, boxes, weights) @ coupling_matrix(couplings)
    return (A * variances[:, None, :]) @ A.transpose(1, 2)


def rescaled(covariances: Tensor, size: tuple[int, int], original: tuple[int, int]) -> Tensor:
    """Covariances (N, 4, 4) of boxes in an image of another size, both (height, width) [px]."""
    y, x = (old / new for new, old in zip(size, original, strict=True))
    scale = covariances.new_tensor([x, y, x, y])
    return covariances * scale[:, None] * scale
