"""How much is fuzzed: a seeded share in every run of the suite, all of it with CALIBSLAM_FUZZ=full."""

from __future__ import annotations

import faulthandler
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

HANGS = Path(tempfile.gettempdir()) / "calibslam_fuzzing_hangs.txt"
FULL = os.environ.get("CALIBSLAM_FUZZ") == "full"


def fuzz(body: Callable[[Random], None], few: int, many: int, seconds: float = 300.0) -> None:
    """Call `body` `few` times, always with the same random numbers, or `many` times, with new ones in every run.

    Args:
        seconds: after which a call counts as hanging.
    """

    @settings(
        max_examples=many if FULL else few,
        derandomize=not FULL,
        database=None,
        deadline=None,
        phases=(Phase.generate,),  # shrinking a failed run of the estimator takes minutes
        suppress_health_check=list(HealthCheck),
    )
    @given(st.randoms(use_true_random=False))
    def call(random: Random) -> None:
        with ends_within(seconds):
            body(random)

    call()


@contextmanager
def ends_within(seconds: float) -> Iterator[None]:
    """Where what is inside hangs, the process ends, and `HANGS` says where: no test runner waits for ever."""
    with HANGS.open("w") as file:
        faulthandler.dump_traceback_later(seconds, exit=True, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
