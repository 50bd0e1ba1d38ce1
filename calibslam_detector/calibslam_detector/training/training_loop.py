"""Optimisation that can be interrupted: the same steps whether in one go or in several.

A run folder holds `log.csv` (losses by step), `curves.png`, `checkpoint.pt` and, in the end, `weights.pt`.
"""

from __future__ import annotations

import csv
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from calibslam_detector.model import weights_file
from calibslam_detector.training.curves import plot_curves
from calibslam_msgs_py.settings import Settings, setting

MAX_GRADIENT = 10.0  # norm to which a gradient is cut
MAX_SKIPPED = 20  # steps without a finite loss in a row
SECONDS_BETWEEN_LINES = 30.0  # where there is no terminal to show a bar on


class TrainingError(RuntimeError):
    """Training that cannot go on; the text says why and what to do."""


class Interrupted(Exception):
    """The user stopped it; everything is saved."""


@dataclass(frozen=True)
class LoopSettings(Settings):
    """How is optimised."""

    steps: int = setting(4000, "number of steps", low=1)
    learning_rate: float = setting(5e-4, "largest learning rate of AdamW", low=0.0)
    weight_decay: float = setting(1e-4, "decay of the weights", low=0.0)
    warm_up: int = setting(100, "steps over which the learning rate rises", low=0)
    checkpoint_every: int = setting(200, "steps between two checkpoints", low=1)
    log_every: int = setting(10, "steps between two lines of the log", low=1)
    evaluate_every: int = setting(
        20, "steps between two evaluations on held-out samples, which decide the weights that are kept", low=1
    )
    seed: int = setting(0, "the same seed gives the same training on the same machine", low=0)
    amp: bool = setting(True, "mixed precision, where there is CUDA")

    def rate(self, step: int) -> float:
        """Learning rate: linear warm-up, then half a cosine."""
        rise = min((step + 1) / (self.warm_up + 1), 1.0)
        return self.learning_rate * rise * 0.5 * (1.0 + math.cos(math.pi * step / self.steps))


@dataclass
class Task:
    """What is optimised.

    Attributes:
        module: whose weights and numbers a checkpoint holds.
        parameters: that are changed.
        losses: names and values at a step; their sum is made smaller. None: nothing to learn from this step.
        everywhere: whether what is so here is so in all processes, e.g. that a loss is finite.
        is_first: whether this process writes files and shows progress.
        held_out: a loss on samples that are not learnt from. It is told with each line of the log, and in the end the
            weights are those of the least one of all evaluations. None: the last weights.
    """

    module: nn.Module
    parameters: list[nn.Parameter]
    losses: Callable[[int], dict[str, Tensor] | None]
    device: torch.device
    everywhere: Callable[[bool], bool] = bool
    is_first: bool = True
    held_out: Callable[[], float] | None = None


def optimise(task: Task, settings: LoopSettings, folder: Path, identity: dict[str, Any], resume: bool) -> None:
    """Run all steps, or those that are left.

    Args:
        task: what is optimised.
        settings: how.
        folder: the run folder.
        identity: what a checkpoint must agree in to be gone on with.
        resume: go on with the folder's checkpoint.

    Raises:
        Interrupted: SIGINT or SIGTERM came; a checkpoint is written.
        TrainingError: losses are not finite any more, or the checkpoint is of another training.
    """
    optimiser = torch.optim.AdamW(task.parameters, settings.learning_rate, weight_decay=settings.weight_decay)
    amp = settings.amp and task.device.type == "cuda"
    scaler = torch.amp.GradScaler(task.device.type, enabled=amp)
    best = Best()
    parts = {"module": task.module, "optimiser": optimiser, "scaler": scaler, "best": best}
    checkpoint = Checkpoint(folder / "checkpoint.pt", identity, parts)
    first = checkpoint.load() if resume else 0
    log = Log(folder / "log.csv", first) if task.is_first else None
    started, skipped = time.monotonic(), 0
    told = started
    with (
        stop_flag() as stop,
        tqdm(total=settings.steps, initial=first, unit="step", disable=None if task.is_first else True) as progress,
    ):
        for step in range(first, settings.steps):
            for group in optimiser.param_groups:
                group["lr"] = settings.rate(step)
            optimiser.zero_grad()
            with torch.autocast(task.device.type, enabled=amp):
                losses = task.losses(step)
                total = sum(losses.values(), torch.zeros((), device=task.device)) if losses is not None else None
            if total is None or not task.everywhere(bool(torch.isfinite(total))):
                skipped += 1
                progress.set_postfix_str(f"{skipped} steps without a finite loss")
                if skipped >= MAX_SKIPPED:
                    way_out = f"go on from {checkpoint.path} (--resume)" if checkpoint.path.exists() else "begin again"
                    raise TrainingError(
                        f"no finite loss in {MAX_SKIPPED} steps up to step {step}; {way_out} with a smaller "
                        "--learning-rate"
                    )
            else:
                skipped = 0
                scaler.scale(total).backward()
                scaler.unscale_(optimiser)
                nn.utils.clip_grad_norm_(task.parameters, MAX_GRADIENT)
                scaler.step(optimiser)
                scaler.update()
                is_logged = log is not None and step % settings.log_every == 0
                is_evaluated = step % settings.evaluate_every == 0
                held_out = task.held_out() if task.held_out is not None and (is_logged or is_evaluated) else None
                # What is logged must not decide which weights are kept.
                if held_out is not None and is_evaluated:
                    best.offer(held_out, task.module)
                if is_logged and log is not None and losses is not None:
                    values = {name: float(value.detach()) for name, value in losses.items()}
                    if held_out is not None:
                        values["held_out"] = held_out
                    log.add(step, time.monotonic() - started, settings.rate(step), values)
                    progress.set_postfix(loss=f"{float(total.detach()):.4g}")
                    now = time.monotonic()
                    if progress.disable and now - told >= SECONDS_BETWEEN_LINES:
                        told = now
                        left = (now - started) / (step + 1 - first) * (settings.steps - step - 1)
                        line = f"step {step + 1} of {settings.steps}: loss {float(total.detach()):.4g}"
                        print(f"{line}, {left / 60.0:.1f} min left", file=sys.stderr, flush=True)
            progress.update()
            done = step + 1
            stopped = not task.everywhere(not stop())
            if task.is_first and (stopped or done % settings.checkpoint_every == 0 or done == settings.steps):
                checkpoint.save(done)
                if log is not None:
                    plot_curves(log.path, folder / "curves.png")
            if stopped and done < settings.steps:
                raise Interrupted(f"stopped after step {done} of {settings.steps}; go on with --resume")
    if task.held_out is not None:
        best.offer(task.held_out(), task.module)
    best.restore(task.module)


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
        weights_file.write_safely(content, self.path)

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


class Log:
    """Losses by step in a CSV file; what comes after the step of a resumed checkpoint is dropped."""

    def __init__(self, path: Path, first: int) -> None:
        self.path = path
        self._names: list[str] = []
        self._rows: list[dict[str, str]] = []
        if first and path.exists():
            with path.open(newline="") as file:
                self._rows = [row for row in csv.DictReader(file) if int(row["step"]) < first]
        self._names = list(self._rows[0]) if self._rows else []
        self._begun_at = float(self._rows[-1]["seconds"]) if self._rows else 0.0
        if self._names:
            self._write("w", self._rows)
        else:
            path.unlink(missing_ok=True)

    def add(self, step: int, seconds: float, rate: float, losses: dict[str, float]) -> None:
        """A line; `seconds` since this process began."""
        row = {"step": str(step), "seconds": f"{self._begun_at + seconds:.1f}", "learning_rate": f"{rate:.6g}"}
        row.update({name: f"{value:.6g}" for name, value in losses.items()})
        if not self._names:
            self._names = list(row)
            self._write("w", [row])
        else:
            self._write("a", [row])

    def _write(self, mode: str, rows: list[dict[str, str]]) -> None:
        with self.path.open(mode, newline="") as file:
            writer = csv.DictWriter(file, self._names)
            if mode == "w":
                writer.writeheader()
            writer.writerows(rows)


@contextmanager
def stop_flag() -> Iterator[Callable[[], bool]]:
    """Whether SIGINT or SIGTERM came; a step is always finished. A second signal ends at once."""
    stopped = False

    def on_signal(number: int, frame: object) -> None:
        nonlocal stopped
        stopped = True
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, signal.SIG_DFL)

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def batch_of(step: int, size: int, count: int, seed: int) -> np.ndarray:
    """Indices (size,) of a step: every sample once per epoch, in an order that the seed and the epoch decide."""
    positions = step * size + np.arange(size)
    orders: dict[int, np.ndarray] = {}
    for epoch in np.unique(positions // count):
        orders[int(epoch)] = np.random.default_rng((seed, int(epoch))).permutation(count)
    return np.array([orders[int(p // count)][p % count] for p in positions])
