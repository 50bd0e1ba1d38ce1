"""What a network does not know: the spread of several networks, or of one with dropout (the document, 2.1.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

# Input -> mean (N, d) and covariance, variances (N, d) or matrices (N, d, d).
Regressor = Callable[[Tensor], tuple[Tensor, Tensor]]


def combined(means: Tensor, covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and covariance of an equal mixture: mean covariance (aleatoric) + covariance of means (epistemic).

    Args:
        means: (M, N, d), of M members.
        covariances: (M, N, d) or (M, N, d, d).

    Returns:
        (N, d), and a covariance of the kind that was given.
    """
    mean = means.mean(dim=0)
    spread = means - mean
    squares = spread.square() if covariances.dim() == 3 else spread[..., :, None] * spread[..., None, :]
    return mean, covariances.mean(dim=0) + squares.mean(dim=0)


def ensemble(members: Sequence[Regressor], x: Tensor) -> tuple[Tensor, Tensor]:
    """Prediction of networks that were trained from different seeds (Lakshminarayanan et al., 2017)."""
    means, covariances = zip(*(member(x) for member in members), strict=True)
    return combined(torch.stack(means), torch.stack(covariances))


def monte_carlo_dropout(network: nn.Module, x: Tensor, samples: int, seed: int) -> tuple[Tensor, Tensor]:
    """Prediction of one network whose dropout stays on (Gal and Ghahramani, 2016).

    Args:
        network: input -> mean and covariance, with dropout layers; left as it was.
        x: its input.
        samples: how often it is asked.
        seed: of the dropout.

    Raises:
        ValueError: the network has no dropout.
    """
    dropouts = [module for module in network.modules() if isinstance(module, nn.modules.dropout._DropoutNd)]
    if not dropouts:
        raise ValueError("Monte Carlo dropout needs a network with dropout layers")
    were_training = [module.training for module in dropouts]
    try:
        for module in dropouts:
            module.train()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return ensemble([network] * samples, x)
    finally:
        for module, training in zip(dropouts, were_training, strict=True):
            module.train(training)
