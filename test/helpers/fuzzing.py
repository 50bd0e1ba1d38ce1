"""How much is fuzzed: a seeded share in every run of the suite, all of it with CALIBSLAM_FUZZ=full."""

from __future__ import annotations

import faulthandler
import os
from collections.abc import Iterator
from contextlib import contextmanager

from hypothesis import HealthCheck, Phase, settings

FULL = os.environ.get("CALIBSLAM_FUZZ") == "full"


def examples(few: int, many: int) -> settings:
    """Settings of a test: `few` examples, always the same, or `many`, new ones in every run."""
    return settings(
        max_examples=many if FULL else few,
        derandomize=not FULL,
        database=None,
        deadline=None,
        phases=(Phase.generate,),  # shrinking a failed run of the estimator takes minutes
        suppress_health_check=list(HealthCheck),
    )


@contextmanager
def ends_within(seconds: float) -> Iterator[None]:
    """Where what is inside hangs, the process says where and ends: no test runner waits for ever."""
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
