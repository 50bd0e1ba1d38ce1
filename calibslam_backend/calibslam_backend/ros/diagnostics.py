"""What a session says about itself, by name, for /diagnostics."""

from __future__ import annotations

import resource
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from calibslam_backend.session.session import Session

MIB = 1 << 20


def of_session(session: Session) -> Mapping[str, str]:
    """State, what waits, times of updates, honesty of covariances, and memory; reads, and waits for nothing."""
    values = {"state": state(session), "queue": str(len(session.intake))}
    estimator = session.estimator
    if estimator is not None:
        values["objects"] = str(estimator.objects)
        values["images_waiting_for_odometry"] = str(estimator.waiting)
        values["box_correlation"] = f"{estimator.box_correlation:.2f}"
    if session.intake.journal_problem:
        values["journal"] = session.intake.journal_problem
    for name in ("update_ms", "between_ms", "delay_ms"):
        values |= _quantiles(name, getattr(session.tally, name))
    if nis := list(session.tally.nis):
        # Half of the boxes lie below chi-squared's median of 0.839 where covariances are right.
        values |= {"nis_mean": f"{np.mean(nis):.2f}", "nis_median": f"{np.median(nis):.2f}"}
    return values | _memory()


def state(session: Session) -> str:
    """What it does, in words."""
    estimator = session.estimator
    if session.resumed < 1.0:
        return f"reading the journal: {session.resumed:.0%}"
    if estimator is None:
        return "waiting for camera_info"
    if session.intake.paused:
        return "paused"
    if not estimator.stamps:
        return "looking for the camera in the map" if estimator.objects else "waiting for measurements"
    return "refined" if session.refined else "mapping"


def _quantiles(name: str, numbers: Collection[float]) -> dict[str, str]:
    if not numbers:
        return {}
    p50, p99 = np.percentile(list(numbers), [50, 99])
    return {f"{name}_p50": f"{p50:.1f}", f"{name}_p99": f"{p99:.1f}", f"{name}_max": f"{max(numbers):.1f}"}


def _memory() -> dict[str, str]:
    """Resident now and at most [MiB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return {"memory_mb": f"{pages * resource.getpagesize() / MIB:.0f}", "memory_peak_mb": f"{peak:.0f}"}
