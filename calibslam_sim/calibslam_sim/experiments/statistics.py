"""Means, deviations and paired tests over repetitions.

Two conditions see the same worlds and the same unit noise, so the test is on their differences: Student's paired t,
and beside it Wilcoxon's signed ranks, which a few large differences cannot decide. Both two-sided.

Repetitions that each leave out another share f of one recording have the rest in common: their differences scatter far
less than those of separate recordings, and a test that took them for independent would find everything significant. Of
the whole recording's value, the variance is (1 - f) / f times theirs (delete-d jackknife; Shao and Wu 1989), and the
mean of n of them misses that value by a further n-th part.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from calibslam_msgs_py.measurements import Array

CONFIDENCE = 0.95


def summary(values: Sequence[float]) -> dict[str, Any]:
    """Mean, sample deviation (n - 1) and the values of one metric in one condition.

    Repetitions in which the metric is not defined (NaN) are None and do not count.
    """
    numbers = defined(values)
    return {
        "mean": float(numbers.mean()) if len(numbers) else None,
        "std": float(numbers.std(ddof=1)) if len(numbers) > 1 else None,
        "values": [None if np.isnan(value) else float(value) for value in values],
    }


def paired(a: Sequence[float], b: Sequence[float], left_out: float = 0.0) -> dict[str, float | None]:
    """Mean of a - b (negative: a has less error) and the p-values of "no difference".

    Repetitions in which one of the two is not defined do not count. None where fewer than two are left; no
    difference anywhere has p = 1, the same one everywhere p = 0.

    Args:
        a, b: a metric in each repetition.
        left_out: share of one recording that each leaves out; 0: they are independent. Ranks have no such test.
    """
    differences = defined(np.asarray(a, float) - np.asarray(b, float))
    if len(differences) < 2:
        return {"mean_difference": None, "p_value": None, "wilcoxon_p_value": None}
    if not differences.any():
        return {"mean_difference": 0.0, "p_value": 1.0, "wilcoxon_p_value": 1.0}
    mean, error = float(differences.mean()), standard_error(differences, left_out)
    return {
        "mean_difference": mean,
        "p_value": float(2.0 * stats.t.sf(abs(mean) / error, len(differences) - 1)) if np.ptp(differences) else 0.0,
        "wilcoxon_p_value": None if left_out else float(stats.wilcoxon(differences).pvalue),
    }


def standard_error(values: Array, left_out: float = 0.0) -> float:
    """Of the mean of at least two values; `left_out` as in `paired`."""
    share = 1.0 / len(values) + ((1.0 - left_out) / left_out if left_out else 0.0)
    return float(values.std(ddof=1) * np.sqrt(share))


def nees_interval(degrees_of_freedom: int, repetitions: int) -> tuple[float, float]:
    """Where the mean of independent normalised squared errors lies with 95 % if the covariances are right.

    The sum over N repetitions is chi-squared with N times the degrees of freedom of one.
    """
    total = degrees_of_freedom * repetitions
    low, high = stats.chi2.interval(CONFIDENCE, total)
    return float(low / repetitions), float(high / repetitions)


def half_interval(values: Sequence[float] | Array, left_out: float = 0.0) -> float:
    """Half the width of the 95 % interval (Student's t) of a mean, 0 for a single value; `left_out` as in `paired`."""
    numbers = defined(values)
    if len(numbers) < 2:
        return 0.0
    return float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, len(numbers) - 1) * standard_error(numbers, left_out))


def defined(values: Sequence[float] | Array) -> Array:
    """The values that are not NaN (or None)."""
    numbers = np.asarray(values, float)
    return numbers[~np.isnan(numbers)]
