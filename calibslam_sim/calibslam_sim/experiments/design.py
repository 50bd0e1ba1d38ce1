"""What an experiment is: conditions that are compared on the same repetitions.

A repetition is a seed: its world and its unit noise are the same in every condition, so conditions are compared in
pairs. The same seed gives the same numbers wherever and in whatever order it is computed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibslam_msgs_py.settings import Settings, setting

# Names that all experiments share (the document's, section 5.1.4).
CALIBRATED, UNDERCONFIDENT, OVERCONFIDENT = "calibrated", "underconfident", "overconfident"
# Factors on a standard deviation that the experiments compare; 1 is calibrated.
SCALES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


class ExperimentError(RuntimeError):
    """An experiment that cannot be run; the text says why and what to do."""


@dataclass(frozen=True)
class ExperimentSettings(Settings):
    """What every experiment can be told; each adds its own."""

    seed: int = setting(0, "where all random numbers come from", low=0)


@dataclass(frozen=True)
class Metric:
    """How a metric is called in tables and figures, and whether less of it is better, so that tables compare it."""

    title: str
    unit: str = ""
    is_error: bool = True

    @property
    def label(self) -> str:
        """E.g. "ATE [m]"."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


Metrics = dict[str, float]
DocumentNumbers = Mapping[str, Mapping[str, tuple[float, float | None]]]
Seed = np.random.SeedSequence


@dataclass(frozen=True)
class Experiment:
    """An experiment.

    Attributes:
        title: in a few words, what it shows.
        settings: its settings.
        quick: settings that differ with --quick.
        seeds, quick_seeds: how many repetitions unless told otherwise.
        metrics: what `run` returns, in the order of the tables. NaN: not defined in this repetition.
        conditions: their names under given settings.
        run: settings, condition, seed -> metrics.
        comparisons: pairs (A, B) of conditions to be tested against each other.
        figure: draws a result (the content of result.json) into a PNG.
        degrees_of_freedom: of each metric that is a normalised squared error of independent repetitions.
        inputs: settings -> name and path of each file that repetitions are computed from.
        document: settings -> mean and deviation in the document, of condition and metric; a deviation of None: it
            states none.
        left_out: settings, condition -> share of one recording that each of its repetitions leaves out; 0: they are
            independent.
        further: more entries of result.json, from the values of each metric in each condition.
        is_shared: whether what the conditions of a repetition share takes longest, so that one process does them all.
    """

    title: str
    settings: type[ExperimentSettings]
    quick: Mapping[str, Any]
    seeds: int
    quick_seeds: int
    metrics: Mapping[str, Metric]
    conditions: Callable[[Any], Sequence[str]]
    run: Callable[[Any, str, Seed], Metrics]
    comparisons: Callable[[Any], Sequence[tuple[str, str]]]
    figure: Callable[[dict[str, Any], Path], None]
    degrees_of_freedom: Mapping[str, int] = field(default_factory=dict)
    inputs: Callable[[Any], Mapping[str, Path]] = lambda settings: {}
    document: Callable[[Any], DocumentNumbers] = lambda settings: {}
    left_out: Callable[[Any, str], float] = lambda settings, condition: 0.0
    further: Callable[[Mapping[str, Mapping[str, Sequence[float]]]], dict[str, Any]] = lambda values: {}
    is_shared: bool = False


def repetition_seed(seed: int, repetition: int) -> Seed:
    """The random numbers of one repetition: what `SeedSequence(seed).spawn(n)[repetition]` is, for any n."""
    return Seed(entropy=seed, spawn_key=(repetition,))


def scale_name(scale: float, prefix: str = "") -> str:
    """The condition in which every standard deviation is believed to be `scale` times what it is."""
    if not prefix:
        named = {1.0: CALIBRATED, 2.0: UNDERCONFIDENT, 0.5: OVERCONFIDENT}
        if scale in named:
            return named[scale]
    return f"{prefix}scale_{scale:g}"
