"""What a long job shows, by a clock that the test turns."""

from __future__ import annotations

import io

import pytest

from calibslam_msgs_py import progress
from calibslam_msgs_py.progress import Progress


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
    with Progress(steps, "work", stream=stream) as shown:
        for _ in range(steps):
            clock.now += seconds
            shown.step()
    return stream.getvalue()


def test_a_short_job_shows_nothing(clock: Clock) -> None:
    assert work(Terminal(), clock, 4, 0.1) == work(io.StringIO(), clock, 4, 0.1) == ""


def test_on_a_terminal_one_line_is_rewritten(clock: Clock) -> None:
    rest = "\x1b[K"
    lines = ["work:  25%", "work:  50%, 16 s left", "work:  75%, 8 s left", "work: 100%", "work: 100%"]
    assert work(Terminal(), clock, 4, 8.0) == "".join(f"\r{line}{rest}" for line in lines) + "\n"


def test_the_last_state_is_shown(clock: Clock) -> None:
    """Also of steps that follow one another too fast to be shown."""
    with Progress(10, "work", stream=(stream := Terminal())) as shown:
        clock.now += 1.0
        for _ in range(10):
            shown.step()
            clock.now += 0.01
    assert stream.getvalue() == "\rwork:  10%\x1b[K\rwork: 100%\x1b[K\n"


def test_a_job_that_is_gone_on_with_is_judged_by_what_was_done_now(clock: Clock) -> None:
    """Half of it was done before; the next tenth took 20 s, so the four that are left take 80."""
    with Progress(100, "work", done=50.0, stream=(stream := Terminal())) as shown:
        clock.now += 20.0
        shown.note = "loss 0.5"
        shown.at(60.0)
    assert stream.getvalue() == 2 * "\rwork:  60%, 80 s left, loss 0.5\x1b[K" + "\n"


def test_a_job_is_shown_only_if_it_is_to_be(clock: Clock) -> None:
    with Progress(2, "work", is_shown=False, stream=(stream := Terminal())) as shown:
        clock.now += 20.0
        shown.step()
    assert not stream.getvalue()


def test_items_are_followed(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    seen = []
    for item in progress.followed("abcd", "work"):
        clock.now += 10.0
        seen.append(item)
    assert seen == list("abcd")
    lines = ["work:  25%, 30 s left", "work:  50%, 20 s left", "work:  75%, 10 s left", "work: 100%"]
    assert capsys.readouterr().err.splitlines() == lines


def test_elsewhere_a_line_tells_each_quarter(clock: Clock) -> None:
    lines = ["work:  25%, 30 s left", "work:  50%, 20 s left", "work:  75%, 10 s left", "work: 100%"]
    assert work(io.StringIO(), clock, 8, 5.0).splitlines() == lines
    assert work(io.StringIO(), clock, 8, 1.0) == ""


def test_elsewhere_a_long_job_tells_each_minute(clock: Clock) -> None:
    shown = work(io.StringIO(), clock, 100, 30.0).splitlines()
    assert shown[:2] == ["work:   2%, 49 min left", "work:   4%, 48 min left"]
    assert shown[-2:] == ["work:  98%, 60 s left", "work: 100%"] and len(shown) == 50
