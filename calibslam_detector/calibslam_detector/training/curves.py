"""Plots of a training's log."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

NO_LOSS = ("step", "seconds", "learning_rate")
WINDOW = 15  # logged steps over which a curve is smoothed


def plot_curves(log: Path, out: Path) -> None:
    """Draw every loss of a log over the steps, as logged and smoothed; nothing for a log without lines."""
    if not log.exists():
        return
    with log.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [name for name in rows[0] if name not in NO_LOSS] if rows else []
    if not names:
        return
    steps = np.array([int(row["step"]) for row in rows])
    figure, axes = plt.subplots(len(names), 1, figsize=(7.0, 1.8 * len(names) + 0.6), sharex=True, squeeze=False)
    for axis, name in zip(axes[:, 0], names, strict=True):
        values = np.array([float(row[name]) for row in rows])
        axis.plot(steps, values, color="0.75", linewidth=0.8)
        if len(values) >= WINDOW:
            smooth = np.convolve(values, np.full(WINDOW, 1.0 / WINDOW), mode="valid")
            axis.plot(steps[WINDOW // 2 :][: len(smooth)], smooth, color="tab:blue")
        axis.set_ylabel(name)
        axis.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("step")
    figure.tight_layout()
    figure.savefig(out, dpi=110)
    plt.close(figure)
