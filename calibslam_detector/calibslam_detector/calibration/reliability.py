"""Reliability diagrams: how often what was predicted with probability p came true, with the band of chance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

from calibslam_detector.calibration.metrics import LEVELS, coverage, coverage_of_sums
from calibslam_msgs_py.measurements import Array

matplotlib.use("Agg")
from matplotlib import pyplot as plt

STYLES = ("o-", "s--", "^:", "D-.", "v-", "P--", "X:")


@dataclass(frozen=True)
class Reliability:
    """A curve with its band.

    Attributes:
        expected: probabilities (L,).
        observed: shares that were seen (L,).
        half_width: of the band around `observed`.
    """

    expected: Array
    observed: Array
    half_width: float

    @property
    def is_calibrated(self) -> bool:
        """Whether the band holds the diagonal at every level."""
        return bool(np.abs(self.observed - self.expected).max() <= self.half_width)


def reliability(z: Array, K: int | None = None, confidence: float = 0.95, levels: Array = LEVELS) -> Reliability:
    """The curve of rows (N, d), or with K that of sums of K squares.

    The band is that of Dvoretzky, Kiefer and Wolfowitz with Massart's constant, sqrt(log(2 / (1 - confidence)) / 2n):
    it holds the true curve at all levels at once, for any distribution, if the n rows (or sums) are independent.
    Boxes of one object in consecutive images are not; its band is too narrow.
    """
    observed = coverage(z, levels) if K is None else coverage_of_sums(z, K, levels)
    n = len(z) if K is None else z.size // K
    return Reliability(levels, observed, float(np.sqrt(np.log(2.0 / (1.0 - confidence)) / (2.0 * n))))


@matplotlib.rc_context({"text.parse_math": False})  # names are texts, whatever signs they hold
def plot(curves: Mapping[str, Reliability], path: Path, title: str) -> None:
    """Draw curves into a PNG; they differ in markers and line styles, so it can be read without colour."""
    figure, axes = plt.subplots(figsize=(5.2, 5.0), dpi=110)
    axes.plot([0, 1], [0, 1], color="0.3", linewidth=1.0, label="calibrated")
    for (name, curve), style in zip(curves.items(), STYLES * len(curves), strict=False):
        (line,) = axes.plot(curve.expected, curve.observed, style, markersize=4.0, linewidth=1.2, label=name)
        low, high = curve.observed - curve.half_width, curve.observed + curve.half_width
        axes.fill_between(curve.expected, low, high, color=line.get_color(), alpha=0.15, linewidth=0.0)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", title=title)
    axes.set(xlabel="predicted probability", ylabel="share observed")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
