"""What a long job shows, by a clock that the test turns."""

from __future__ import annotations

import io

import pytest

from calibslam_sim import progress
from calibslam_sim.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def work(stream: io.StringIO, clock: Clock, steps: int, seconds: float) -> str:
    with Progress(steps, "work", stream) as shown:
        for _ in range(steps):
            clock.now += seconds
            shown.step()
    return stream.getvalue()


def test_a_short_job_shows_nothing(clock: Clock) -> None:
    assert work(Terminal(), clock, 4, 0.1) == work(io.StringIO(), clock, 4, 0.1) == ""


def test_on_a_terminal_one_line_is_rewritten(clock: Clock) -> None:
    rest = "\x1b[K"
    assert work(Terminal(), clock, 4, 8.0) == (
        f"\rwork:  25%{rest}\rwork:  50%, 16 s left{rest}\rwork:  75%, 8 s left{rest}\rwork: 100%{rest}\n"
    )


def test_elsewhere_a_line_tells_each_quarter(clock: Clock) -> None:
    assert work(io.StringIO(), clock, 8, 1.0) == "work:  25%\nwork:  50%\nwork:  75%\nwork: 100%\n"


def test_elsewhere_a_long_job_tells_each_minute(clock: Clock) -> None:
    shown = work(io.StringIO(), clock, 100, 30.0).splitlines()
    assert shown[:2] == ["work:   2%, 49 min left", "work:   4%, 48 min left"]
    assert shown[-2:] == ["work:  98%, 60 s left", "work: 100%"] and len(shown) == 50
