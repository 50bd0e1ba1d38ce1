"""Where events wait until they are used, and the journal, which has them before they wait.

One thread offers, another one takes. With a journal an event is taken in once it is written there.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Protocol

from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.session.journal import Journal, Record
from calibslam_msgs_py.measurements import Boxes, Camera, InvalidMeasurement, RelativeMotion, StampedPose


class Kind(IntEnum):
    """What happened; the numbers stand in journals."""

    CAMERA = 1
    BOXES = 2
    MOTION = 3
    START = 4  # a pose is given
    MAP = 5  # a map is loaded
    REFINED = 6
    RESUMED = 7


Content = Camera | Boxes | RelativeMotion | StampedPose | ObjectMap | None


@dataclass(frozen=True)
class Event:
    """Something that happened, and how the journal has it."""

    kind: Kind
    content: Content = None
    payload: bytes = b""
    arrived: float = 0.0  # monotonic [s]; 0: in a session before

    def record(self) -> Record:
        return Record(self.kind, self.payload)


class Report(Protocol):
    """Who is told."""

    def count(self, name: str, by: int = 1) -> None:
        """Something happened."""

    def reject(self, error: InvalidMeasurement, count: int = 1) -> None:
        """A measurement was left out."""

    def say(self, text: str) -> None:
        """Something a person should see."""


class Intake:
    """A bounded queue with a journal.

    Attributes:
        paused: measurements are counted and ignored.
        journal: None: nothing is kept, or not any more.
        journal_problem: why the journal is not complete; "" if it is.
    """

    def __init__(self, queue_size: int, report: Report, journal: Journal | None) -> None:
        self._queue_size, self._report = queue_size, report
        self._changed = threading.Condition()
        self._queue: deque[Event] = deque()
        self.journal = journal
        self.journal_problem = ""
        self.paused = False

    def __len__(self) -> int:
        return len(self._queue)

    def offer(self, event: Event) -> None:
        """Take in a measurement, unless paused, or a start pose.

        Raises:
            InvalidMeasurement: "queue_full".
        """
        with self._changed:
            if self.paused and event.kind != Kind.START:
                self._report.count("ignored_while_paused")
                return
            if len(self._queue) >= self._queue_size * (1 if event.kind == Kind.BOXES else 2):
                raise InvalidMeasurement("queue_full", "measurements come faster than they can be used")
            self.write(event)
            self._queue.append(event if self.journal is not None else replace(event, payload=b""))
            self._changed.notify()

    def wait(self, timeout: float) -> None:
        """Until there is an event, at most so long [s]."""
        with self._changed:
            if not self._queue:
                self._changed.wait(timeout)

    def next(self) -> Event | None:
        """The first event."""
        with self._changed:
            return self._queue.popleft() if self._queue else None

    def write_if_empty(self, event: Event) -> bool:
        """Have the journal say that something happened after all that was taken in; False if events still wait."""
        with self._changed:
            if self._queue:
                return False
            self.write(event)
            return True

    def write(self, event: Event) -> None:
        """Have the journal say that something happened. It never fails: what goes wrong is reported."""
        with self._changed:
            if self.journal is None:
                return
            try:
                self.journal.append(event.record())
            except OSError as error:
                self._report.count("errors_journal")
                self.journal_problem = f"is not complete: {error.strerror}"
                self._report.say(f"journal {self.journal.path} {self.journal_problem}; mapping goes on")

    def begin_again(self, events: Iterable[Event], keep_queue: bool) -> None:
        """The journal holds these events, and those that wait if they are kept.

        Raises:
            OSError: the journal cannot be written; nothing is changed.
        """
        with self._changed:
            kept = list(self._queue) if keep_queue else []
            if self.journal is not None:
                self.journal.restart(event.record() for event in (*events, *kept))
                self.journal_problem = ""
            if not keep_queue:
                self._queue.clear()

    def close(self) -> None:
        """Have the journal on disk. Who still works writes nothing more: its file may be another one by then."""
        with self._changed:
            journal, self.journal = self.journal, None
        if journal is not None:
            journal.close()
