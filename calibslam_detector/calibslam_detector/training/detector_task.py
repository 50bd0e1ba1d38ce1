"""Training of the plain detector, on one device or, under torchrun, on several GPUs."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

from calibslam_detector.images.coco_data import CocoData, Sample, TrainingImages
from calibslam_detector.model.network import CalibratedDetector
from calibslam_detector.training.training_loop import LoopSettings, Task, batch_of


@dataclass(frozen=True)
class Processes:
    """The processes that train together: this one's number, how many there are, and its device."""

    rank: int
    count: int
    device: torch.device

    @classmethod
    def join(cls) -> Processes:
        """Those that torchrun has started, or this one alone."""
        rank, count = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        cuda = torch.cuda.is_available()
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if cuda else torch.device("cpu")
        if count > 1:
            torch.distributed.init_process_group("nccl" if cuda else "gloo")
        return cls(rank, count, device)

    def leave(self) -> None:
        """End the group."""
        if self.count > 1:
            torch.distributed.destroy_process_group()

    def everywhere(self, here: bool) -> bool:
        """Whether something is so in all processes."""
        if self.count == 1:
            return here
        flag = torch.tensor(float(here), device=self.device)
        torch.distributed.all_reduce(flag, torch.distributed.ReduceOp.MIN)
        return bool(flag > 0.0)


def detector_task(
    model: CalibratedDetector,
    data: CocoData,
    batch: int,
    workers: int,
    settings: LoopSettings,
    processes: Processes,
    skipped: Counter[str],
) -> Task:
    """The plain detector's losses on batches of `batch` images per process; the covariance head stays as it is.

    Images that cannot be read are counted in `skipped`.
    """
    model.to(processes.device).train()
    parameters = [p for p in model.detector.parameters() if p.requires_grad]
    learner: nn.Module = model.detector
    if processes.count > 1:
        devices = [processes.device.index] if processes.device.type == "cuda" else None
        learner = DistributedDataParallel(model.detector, device_ids=devices)
    batches: Iterator[list[Sample | None]] | None = None

    def losses(step: int) -> dict[str, Tensor] | None:
        nonlocal batches
        if batches is None:
            batches = _batches(data, batch, workers, settings, processes, step)
        samples = [sample for sample in next(batches) if sample is not None]
        if missing := batch - len(samples):
            skipped["image that cannot be read"] += missing
        # All processes must take part in a step, or none.
        if not processes.everywhere(bool(samples)):
            return None
        images = [image.to(processes.device) for image, _ in samples]
        targets = [{name: value.to(processes.device) for name, value in target.items()} for _, target in samples]
        found: dict[str, Tensor] = learner(images, targets)
        return found

    return Task(
        module=model,
        parameters=parameters,
        losses=losses,
        device=processes.device,
        way_out="begin in another folder with images that can be read",
        everywhere=processes.everywhere,
        is_first=processes.rank == 0,
    )


def _batches(
    data: CocoData, batch: int, workers: int, settings: LoopSettings, processes: Processes, first: int
) -> Iterator[list[Sample | None]]:
    """Batches of this process from a step on."""
    together = batch * processes.count
    order = []
    for step in range(first, settings.steps):
        chosen = batch_of(step, together, len(data.images), settings.seed)
        epoch = step * together // len(data.images)
        mine = chosen[processes.rank :: processes.count]
        order.append([(int(k), settings.seed + 1_000_003 * epoch) for k in mine])
    loader: DataLoader[Sample | None] = DataLoader(
        TrainingImages(data),
        batch_sampler=order,
        num_workers=workers,
        collate_fn=list,
        generator=torch.Generator(),  # the loader must not draw from the generator that a checkpoint restores
    )
    return iter(loader)
