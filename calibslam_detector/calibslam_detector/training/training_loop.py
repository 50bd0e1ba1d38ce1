"""Optimisation that can be interrupted: the same steps whether in one go or in several.

A run folder holds `log.csv` (losses by step), `curves.png`, `checkpoint.pt` and, in the end, `weights.pt`.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from calibslam_detector.training.checkpoint import Best, Checkpoint, TrainingError
from calibslam_detector.training.curves import plot_curves
from calibslam_detector.training.run_log import Log
from calibslam_msgs_py.progress import Progress
from calibslam_msgs_py.settings import Settings, setting

MAX_GRADIENT = 10.0  # norm to which a gradient is cut
MAX_SKIPPED = 20  # steps in a row that have taught nothing


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
        way_out: what to do where steps have nothing to learn from, as an imperative.
        everywhere: whether what is so here is so in all processes, e.g. that a loss is finite.
        is_first: whether this process writes files and shows progress.
        held_out: a loss on samples that are not learnt from. It is told with each line of the log, and in the end the
            weights are those of the least one of all evaluations. None: the last weights.
    """

    module: nn.Module
    parameters: list[nn.Parameter]
    losses: Callable[[int], dict[str, Tensor] | None]
    device: torch.device
    way_out: str = "give more to learn from"
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
        TrainingError: nothing is learnt any more, or the checkpoint is of another training.
    """
    descent, best = Descent(task, settings), Best()
    parts = {"module": task.module, "optimiser": descent.optimiser, "scaler": descent.scaler, "best": best}
    checkpoint = Checkpoint(folder / "checkpoint.pt", identity, parts)
    first = checkpoint.load() if resume else 0
    log = Log(folder / "log.csv", first) if task.is_first else None
    began = time.monotonic()
    with stop_flag() as stop, Progress(settings.steps, "training", first, task.is_first) as progress:
        for step in range(first, settings.steps):
            try:
                losses = descent.step(step)
            except StepsInVain as error:
                begin = f"go on from {checkpoint.path} (--resume)" if checkpoint.path.exists() else "begin again"
                way_out = error.way_out or f"{begin} with a smaller --learning-rate"
                raise TrainingError(f"{error.what} up to step {step}; {way_out}") from None
            is_logged = log is not None and step % settings.log_every == 0
            is_evaluated = step % settings.evaluate_every == 0
            held_out = task.held_out() if task.held_out is not None and (is_logged or is_evaluated) else None
            # What is logged must not decide which weights are kept.
            if held_out is not None and is_evaluated:
                best.offer(held_out, task.module)
            if is_logged and log is not None and losses:
                values = losses if held_out is None else {**losses, "held_out": held_out}
                log.add(step, time.monotonic() - began, settings.rate(step), values)
                progress.note = f"loss {sum(losses.values()):.4g}"
            if descent.in_vain:
                progress.note = f"{descent.in_vain} steps that taught nothing"
            done = step + 1
            progress.at(done)
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


class StepsInVain(Exception):
    """So many steps in a row have taught nothing that it makes no sense to go on."""

    def __init__(self, what: str, way_out: str) -> None:
        super().__init__(what)
        self.what, self.way_out = what, way_out


class Descent:
    """Steps of AdamW down a task's losses, with gradients of bounded size.

    Attributes:
        in_vain: how many steps in a row have taught nothing.
    """

    def __init__(self, task: Task, settings: LoopSettings) -> None:
        self._task, self._settings = task, settings
        self._amp = settings.amp and task.device.type == "cuda"
        self.optimiser = torch.optim.AdamW(task.parameters, settings.learning_rate, weight_decay=settings.weight_decay)
        self.scaler = torch.amp.GradScaler(task.device.type, enabled=self._amp)
        self.in_vain = 0

    def step(self, number: int) -> dict[str, float]:
        """Losses by name; none if the step has taught nothing.

        Raises:
            StepsInVain: `MAX_SKIPPED` of them in a row.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self._settings.rate(number)
        self.optimiser.zero_grad()
        with torch.autocast(self._task.device.type, enabled=self._amp):
            losses = self._task.losses(number)
            total = sum((losses or {}).values(), torch.zeros((), device=self._task.device))
        if losses is None:
            return self._skip("nothing to learn from", self._task.way_out)
        if not self._task.everywhere(bool(torch.isfinite(total))):
            return self._skip("no finite loss")
        self.in_vain = 0
        self.scaler.scale(total).backward()
        self.scaler.unscale_(self.optimiser)
        nn.utils.clip_grad_norm_(self._task.parameters, MAX_GRADIENT)
        self.scaler.step(self.optimiser)
        self.scaler.update()
        return {name: float(value.detach()) for name, value in losses.items()}

    def _skip(self, what: str, way_out: str = "") -> dict[str, float]:
        self.in_vain += 1
        if self.in_vain >= MAX_SKIPPED:
            raise StepsInVain(f"{what} in {self.in_vain} steps", way_out)
        return {}


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
