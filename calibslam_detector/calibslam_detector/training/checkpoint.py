"""What a training is gone on with, and the best that it has come upon."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from calibslam_detector.model import weights_file


class TrainingError(RuntimeError):
    """Training that cannot go on; the text says why and what to do."""


class Best:
    """The weights with the least loss on held-out samples."""

    def __init__(self) -> None:
        self._loss, self._weights = math.inf, dict[str, Tensor]()

    def offer(self, loss: float, module: nn.Module) -> None:
        """Keep a module's weights if they are the best so far."""
        if loss < self._loss:
            self._loss = loss
            self._weights = {name: value.detach().clone() for name, value in module.state_dict().items()}

    def restore(self, module: nn.Module) -> None:
        """Give a module the best weights; as it is where none were offered."""
        if self._weights:
            module.load_state_dict(self._weights)

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"loss": self._loss, "weights": self._weights}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self._loss, self._weights = state["loss"], state["weights"]


class Checkpoint:
    """All that decides what the next steps do: the parts, each with state_dict and load_state_dict."""

    def __init__(self, path: Path, identity: dict[str, Any], parts: dict[str, Any]) -> None:
        self.path = path
        self._identity = identity
        self._parts = parts

    def save(self, step: int) -> None:
        """Write the state after so many steps."""
        content = {
            "step": step,
            "identity": self._identity,
            **{name: part.state_dict() for name, part in self._parts.items()},
            "torch_random": torch.get_rng_state(),
            "cuda_random": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        }
        weights_file.write_content(content, self.path)

    def load(self) -> int:
        """Take the state of the file up; returns the number of steps done.

        Raises:
            TrainingError: there is none, or it is of another training.
        """
        try:
            content = weights_file.read(self.path, "checkpoint")
            identity = content["identity"]
            for name, value in self._identity.items():
                if identity.get(name) != value:
                    raise TrainingError(
                        f"{self.path} is of a training with {name} = {identity.get(name)!r}, not {value!r}; "
                        "go on with the same options, or begin in another folder"
                    )
            for name, part in self._parts.items():
                part.load_state_dict(content[name])
            torch.set_rng_state(content["torch_random"])
            if torch.cuda.is_available() and len(content["cuda_random"]) == torch.cuda.device_count():
                torch.cuda.set_rng_state_all(content["cuda_random"])
            return int(content["step"])
        except (weights_file.WeightsError, KeyError, RuntimeError) as error:
            if isinstance(error, TrainingError):
                raise
            raise TrainingError(f"cannot resume: {error}") from None
