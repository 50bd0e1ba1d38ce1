"""Small networks that predict a mean and its variances, and how they are trained."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import torch
from torch import Tensor, nn

from calibslam_detector.calibration.residuals import bounded_variance
from calibslam_detector.regressions.tasks import SIDE, Samples, Task

VARIANCE_BOUNDS = (1e-4, 1e2)  # in squared units of the label
FREQUENCIES = 24  # of the sines that a coordinate is turned into; the curve has waves of half that
HIDDEN = 128
CHANNELS = 16
FEATURES = 64  # of an image
DROPOUT = 0.1  # only where asked for
LEARNING_RATE = 2e-3
FINE_TUNING_RATE = 3e-3


class Waves(nn.Module):
    """A coordinate (N, 1) in [-1, 1] -> itself, sines and cosines (N, 2 FREQUENCIES + 1)."""

    def forward(self, x: Tensor) -> Tensor:
        angles = torch.pi * x * torch.arange(1, FREQUENCIES + 1)
        return torch.cat([x, angles.sin(), angles.cos()], dim=1)


def features_of_curve(dropout: float) -> tuple[nn.Module, int]:
    """Network of a coordinate, and the length of its features."""
    layers = [
        Waves(),
        nn.Linear(2 * FREQUENCIES + 1, HIDDEN),
        nn.ReLU(),
        nn.Linear(HIDDEN, HIDDEN),
        nn.ReLU(),
        nn.Dropout(dropout),
    ]
    return nn.Sequential(*layers), HIDDEN


def features_of_image(dropout: float) -> tuple[nn.Module, int]:
    """Network of an image (N, 1, SIDE, SIDE), and the length of its features."""
    layers = [
        nn.Conv2d(1, CHANNELS, 3, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(CHANNELS, 2 * CHANNELS, 3, stride=2, padding=1),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(2 * CHANNELS * (SIDE // 4) ** 2, FEATURES),
        nn.ReLU(),
        nn.Dropout(dropout),
    ]
    return nn.Sequential(*layers), FEATURES


class Regressor(nn.Module):
    """Inputs -> means (N, d) and variances (N, d) of the labels."""

    def __init__(self, samples: Samples, dropout: float = 0.0) -> None:
        super().__init__()
        build = features_of_image if samples.x.dim() == 4 else features_of_curve
        self.features, length = build(dropout)
        self.mean = nn.Linear(length, samples.y.shape[1])
        self.raw_variance = nn.Linear(length, samples.y.shape[1])

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        features = self.features(x)
        return self.mean(features), bounded_variance(self.raw_variance(features), *VARIANCE_BOUNDS)


def train(
    task: Task, training: Samples, held_out: Samples, loss: nn.Module, seed: int, dropout: float = 0.0
) -> Regressor:
    """A network trained with a loss of (mean, covariance, target); of all epochs the one with the least loss on the
    held-out samples.
    """
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = Regressor(training, dropout)
        optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, task.epochs)
        best, best_loss = network.state_dict(), float("inf")
        for _ in range(task.epochs):
            network.train()
            for batch in _batches(len(training), min(task.batch, len(training))):
                _step(optimiser, loss(*network(training.x[batch]), training.y[batch]))
            schedule.step()
            network.eval()
            with torch.no_grad():
                held_out_loss = float(loss(*network(held_out.x), held_out.y))
            if held_out_loss < best_loss:
                best, best_loss = copy.deepcopy(network.state_dict()), held_out_loss
        network.load_state_dict(best)
    return network


def fine_tune(network: Regressor, samples: Samples, loss: nn.Module, seed: int, steps: int, batch: int) -> Regressor:
    """A copy whose variance head alone is trained further, on samples that its mean has never seen."""
    network = copy.deepcopy(network)
    with torch.no_grad():
        features = network.features(samples.x)
        mean = network.mean(features)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        optimiser = torch.optim.Adam(network.raw_variance.parameters(), FINE_TUNING_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        for _ in range(steps):
            chosen = torch.randperm(len(samples))[:batch]
            variance = bounded_variance(network.raw_variance(features[chosen]), *VARIANCE_BOUNDS)
            _step(optimiser, loss(mean[chosen], variance, samples.y[chosen]))
            schedule.step()
    return network


def _step(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()


def _batches(n: int, size: int) -> Iterator[Tensor]:
    """Shuffled indices; a last batch that would be smaller is left out."""
    order = torch.randperm(n)
    for start in range(0, n - size + 1, size):
        yield order[start : start + size]
