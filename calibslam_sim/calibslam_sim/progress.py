"""How far a long job is, and how long it takes: a line that is rewritten on a terminal, a few lines elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TextIO

SECONDS_BETWEEN_UPDATES = 0.5
SHARE_BETWEEN_LINES = 0.25  # where the output is no terminal
SECONDS_BETWEEN_LINES = 60.0  # there, at most
SECONDS_TO_JUDGE = 10.0  # before what is left is told from what has been done


class Progress:
    """Shows the share done of `total` steps; a context manager.

    A job shorter than half a second shows nothing.
    """

    def __init__(self, total: float, what: str, stream: TextIO | None = None) -> None:
        self._total = total
        self._what = what
        self._stream = sys.stderr if stream is None else stream
        self._terminal = self._stream.isatty()
        self._done = 0.0
        self._began = self._shown_at = time.monotonic()
        self._shown = 0.0
        self._line_open = False

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._line_open:
            self._stream.write("\n")
            self._stream.flush()

    def step(self, by: float = 1.0) -> None:
        """Some more is done."""
        self.at(self._done + by)

    def at(self, done: float) -> None:
        """So much is done."""
        self._done = done
        now = time.monotonic()
        waited = now - self._shown_at
        if waited < SECONDS_BETWEEN_UPDATES:
            return
        share = min(done / self._total, 1.0) if self._total > 0.0 else 1.0
        line = f"{self._what}: {share:4.0%}{_left(now - self._began, share)}"
        if self._terminal:
            self._stream.write(f"\r{line}\x1b[K")  # and nothing after it of a line that was longer
            self._line_open = True
        elif share - self._shown >= SHARE_BETWEEN_LINES or waited >= SECONDS_BETWEEN_LINES:
            self._stream.write(f"{line}\n")
        else:
            return
        self._stream.flush()
        self._shown_at, self._shown = now, share


def _left(seconds: float, share: float) -> str:
    """What is left if it goes on as it did: nothing to say at the beginning and at the end."""
    if seconds < SECONDS_TO_JUDGE or not 0.0 < share < 1.0:
        return ""
    left = seconds * (1.0 - share) / share
    return f", {left:.0f} s left" if left < 100.0 else f", {left / 60.0:.0f} min left"
