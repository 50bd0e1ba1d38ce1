"""How far a long job is: a line that is rewritten on a terminal, a few lines elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TextIO

SECONDS_BETWEEN_UPDATES = 0.5
SHARE_BETWEEN_LINES = 0.25  # where the output is no terminal


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
        self._shown_at = time.monotonic()
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
        if now - self._shown_at < SECONDS_BETWEEN_UPDATES:
            return
        share = min(done / self._total, 1.0) if self._total > 0.0 else 1.0
        if self._terminal:
            self._stream.write(f"\r{self._what}: {share:4.0%}")
            self._line_open = True
        elif share - self._shown >= SHARE_BETWEEN_LINES:
            self._stream.write(f"{self._what}: {share:4.0%}\n")
            self._shown = share
        else:
            return
        self._stream.flush()
        self._shown_at = now
