"""How far a long job is, and how long it takes: a line that is rewritten on a terminal, a few lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import TextIO, TypeVar

SECONDS_BETWEEN_UPDATES = 0.5
SHARE_BETWEEN_LINES = 0.25  # where the output is no terminal
SECONDS_BETWEEN_LINES = 60.0  # there, at most
SECONDS_TO_JUDGE = 10.0  # before what is left is told from what has been done


Item = TypeVar("Item")


class Progress:
    """Shows the share done of `total` steps; a context manager.

    A job shorter than half a second shows nothing, and where there is no terminal one shorter than ten.

    Args:
        total: steps in all.
        what: is done.
        done: steps that were done before.
        is_shown: or nothing is.
        stream: to write to; None: stderr.

    Attributes:
        note: what else is shown.
    """

    def __init__(
        self, total: float, what: str, done: float = 0.0, is_shown: bool = True, stream: TextIO | None = None
    ) -> None:
        self._total = total
        self._what = what
        self._stream = sys.stderr if stream is None else stream
        self._is_shown, self._terminal = is_shown, self._stream.isatty()
        self._done = done
        self._began = self._shown_at = time.monotonic()
        self._before = self._shown = self._share(done)
        self._line_open = False
        self.note = ""

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._line_open:
            self._rewrite()
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
        if waited < SECONDS_BETWEEN_UPDATES or not self._is_shown:
            return
        share = self._share(done)
        if self._terminal:
            self._rewrite()
            self._line_open = True
        elif now - self._began < SECONDS_TO_JUDGE or (
            share - self._shown < SHARE_BETWEEN_LINES and waited < SECONDS_BETWEEN_LINES
        ):
            return
        else:
            self._stream.write(f"{self._line()}\n")
        self._stream.flush()
        self._shown_at, self._shown = now, share

    def _rewrite(self) -> None:
        self._stream.write(f"\r{self._line()}\x1b[K")  # and nothing after it of a line that was longer

    def _line(self) -> str:
        share = self._share(self._done)
        parts = [f"{self._what}: {share:4.0%}", self._left(time.monotonic() - self._began, share), self.note]
        return ", ".join(part for part in parts if part)

    def _share(self, done: float) -> float:
        return min(done / self._total, 1.0) if self._total > 0.0 else 1.0

    def _left(self, seconds: float, share: float) -> str:
        """What is left if it goes on as it did: nothing to say at the beginning and at the end."""
        if seconds < SECONDS_TO_JUDGE or not self._before < share < 1.0:
            return ""
        left = seconds * (1.0 - share) / (share - self._before)
        return f"{left:.0f} s left" if left < 100.0 else f"{left / 60.0:.0f} min left"


def followed(items: Sequence[Item], what: str) -> Iterator[Item]:
    """The items, with the progress of what is done with them."""
    with Progress(len(items), what) as progress:
        for item in items:
            yield item
            progress.step()
