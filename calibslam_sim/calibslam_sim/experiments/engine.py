"""Repetitions on all cores of this machine, or on a cluster that joblib reaches."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from itertools import groupby

from joblib import Parallel, delayed, parallel_config
from joblib.parallel import get_active_backend
from threadpoolctl import threadpool_limits

from calibslam_sim.experiments.design import ExperimentError, ExperimentSettings, repetition_seed
from calibslam_sim.experiments.registry import load
from calibslam_sim.experiments.run_store import Repetition

# Repetitions sent at once to a back end that returns nothing before all are done (Ray's).
BATCH_PER_JOB = 8
INSTALLATION = {"dask": "dask distributed", "ray": "ray"}


def run(
    name: str, settings: ExperimentSettings, wanted: Sequence[tuple[str, int]], jobs: int, backend: str
) -> Iterator[Repetition]:
    """Compute these conditions and repetitions of an experiment; each comes as it is done, in any order.

    Args:
        name: of the experiment.
        settings: of the experiment.
        wanted: conditions with numbers of repetitions.
        jobs: processes; -1: one for each core.
        backend: of joblib, by name. "dask" connects to DASK_SCHEDULER_ADDRESS, "ray" to RAY_ADDRESS; both start
            on this machine where that is not set.

    Raises:
        ExperimentError: the back end is not there.
    """
    with _engine(backend, jobs):
        calls = [delayed(several)(name, settings, group) for group in groups(wanted, load(name).is_shared)]
        active, n_jobs = get_active_backend()
        if active.supports_return_generator:
            for done in Parallel(return_as="generator_unordered")(calls):
                yield from done
            return
        batch = BATCH_PER_JOB * active.effective_n_jobs(n_jobs)
        for start in range(0, len(calls), batch):
            for done in Parallel()(calls[start : start + batch]):
                yield from done


def groups(wanted: Sequence[tuple[str, int]], is_shared: bool) -> list[list[tuple[str, int]]]:
    """What one process does in one go: the conditions of a repetition if they share much, otherwise each alone."""
    if not is_shared:
        return [[each] for each in wanted]
    return [list(group) for _, group in groupby(wanted, key=lambda each: each[1])]


def several(name: str, settings: ExperimentSettings, wanted: Sequence[tuple[str, int]]) -> list[Repetition]:
    """Some conditions on some seeds."""
    return [one(name, settings, condition, number) for condition, number in wanted]


def one(name: str, settings: ExperimentSettings, condition: str, number: int) -> Repetition:
    """One condition on one seed."""
    began = time.perf_counter()
    experiment = load(name)
    try:
        # One thread: the rounding of a product depends on how many threads share it.
        with threadpool_limits(limits=1):
            metrics = experiment.run(settings, condition, repetition_seed(settings.seed, number))
    except Exception as error:
        error.add_note(f"in condition {condition}, repetition {number} of the experiment {name}")
        raise
    return Repetition(condition, number, metrics, time.perf_counter() - began)


@contextmanager
def _engine(backend: str, jobs: int) -> Iterator[None]:
    with ExitStack() as stack:
        try:
            if backend == "dask":
                stack.enter_context(import_module("dask.distributed").Client())
            elif backend == "ray":
                import_module("ray.util.joblib").register_ray()
            stack.enter_context(parallel_config(backend=backend, n_jobs=jobs))
        except ImportError as error:
            package = INSTALLATION.get(backend, backend)
            raise ExperimentError(f"--backend {backend} needs '{package}' in this environment: {error}") from error
        except ValueError as error:
            raise ExperimentError(f"--backend {backend}: {error}") from error
        yield
