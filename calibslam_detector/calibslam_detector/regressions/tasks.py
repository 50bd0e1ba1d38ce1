"""What is to be learned: data whose noise differs from sample to sample, in a way that the input shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# Of the image regression.
SIDE = 16  # [px] of an image
DISTRACTORS = 3
MARGIN = 2.0  # [px] between a disc's centre and the border
RADII = (1.5, 2.5)  # [px] of discs in focus
BLURS = (0.4, 3.0)  # [px] radius of the circle of confusion
PIXEL_SIGMA = 0.05  # of the contrast of a disc
LABEL_SIGMA_PER_BLUR = 0.25  # [px] of the label, per px of blur
UNIT = SIDE / 4.0  # [px] of the label's unit, so that labels are about -2 ... 2


@dataclass(frozen=True)
class Samples:
    """Inputs x (N, ...), labels y (N, d) and the true standard deviation of the labels' noise (N, d)."""

    x: Tensor
    y: Tensor
    sigma: Tensor

    def __len__(self) -> int:
        return len(self.x)

    def split(self, n: int) -> tuple[Samples, Samples]:
        """The first n, and the others."""
        first = Samples(self.x[:n], self.y[:n], self.sigma[:n])
        return first, Samples(self.x[n:], self.y[n:], self.sigma[n:])

    def __add__(self, other: Samples) -> Samples:
        """These, then the others."""
        return Samples(torch.cat([self.x, other.x]), torch.cat([self.y, other.y]), torch.cat([self.sigma, other.sigma]))


def curve(n: int, generator: torch.Generator) -> Samples:
    """1-D: three waves on [-1, 1], with noise between 0.05 and 0.5 that depends on where."""
    x = 2.0 * torch.rand(n, 1, generator=generator) - 1.0
    mean = torch.sin(torch.pi * x) + 0.5 * torch.sin(7.0 * torch.pi * x) + 0.3 * torch.cos(12.0 * torch.pi * x)
    sigma = 0.05 + 0.45 * torch.sin(1.25 * torch.pi * x) ** 2
    return Samples(x, mean + sigma * torch.randn(n, 1, generator=generator), sigma)


def bokeh(n: int, generator: torch.Generator) -> Samples:
    """Images (N, 1, SIDE, SIDE) out of focus: where is the bright disc among dark ones (2-D)?

    Somebody who marks the centre of a blurred disc errs in proportion to the blur, and the blur is seen. A disc
    out of focus is an edge as soft as the circle of confusion is wide, of the same total brightness.
    """
    centres = MARGIN + (SIDE - 2.0 * MARGIN) * torch.rand(n, 1 + DISTRACTORS, 2, generator=generator)
    radii = _uniform(RADII, (n, 1 + DISTRACTORS, 1, 1), generator)
    blur = _uniform(BLURS, (n, 1, 1, 1), generator)
    rows, columns = torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij")
    distance = torch.hypot(columns - centres[..., 0, None, None], rows - centres[..., 1, None, None])
    discs = torch.sigmoid(2.0 * (radii - distance) / blur) * radii**2 / (radii**2 + blur**2)
    contrast = torch.tensor([1.0] + [-0.5] * DISTRACTORS)[:, None, None]
    images = (contrast * discs).sum(dim=1, keepdim=True)
    images = images + PIXEL_SIGMA * torch.randn(images.shape, generator=generator)
    sigma = (LABEL_SIGMA_PER_BLUR * blur[:, 0, 0] / UNIT).expand(n, 2)
    label = (centres[:, 0] - SIDE / 2.0) / UNIT
    return Samples(images, label + sigma * torch.randn(n, 2, generator=generator), sigma)


def _uniform(bounds: tuple[float, float], shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    low, high = bounds
    return low + (high - low) * torch.rand(shape, generator=generator)


@dataclass(frozen=True)
class Task:
    """How a regression is drawn and learned; the numbers of epochs and steps are those at which the likelihood of
    held-out data has long been at its best.

    Attributes:
        draw: (n, generator) -> samples.
        components: d of a label.
        training, held_out, test: numbers of samples.
        epochs, batch: of the training.
    """

    draw: Callable[[int, torch.Generator], Samples]
    components: int
    training: int
    held_out: int
    test: int
    epochs: int
    batch: int


TASKS = {
    "curve": Task(curve, components=1, training=1000, held_out=2000, test=40000, epochs=40, batch=100),
    "bokeh": Task(bokeh, components=2, training=1500, held_out=1000, test=10000, epochs=30, batch=100),
}
