"""Publishes the map while nothing else is to be done."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

from calibslam_backend.output.published import map_messages
from calibslam_backend.session.session import Session
from calibslam_msgs_py.conversions import MessageTypes

REST = 0.004  # [s] without a measurement, after which a message of the map may hold up the next one


class MapPublisher:
    """Not more often than wanted, and one message at a time: all of them take longer than a pose may (50 ms for 250
    keyframes and 40 quadrics).

    Args:
        publishers: by topic.
        types: of messages.
        frame: name of the map's frame.
        period: least time [s] between two maps. Where measurements wait all the time, there is one in twice that.
    """

    def __init__(self, publishers: Mapping[str, Any], types: MessageTypes, frame: str, period: float) -> None:
        self._publishers, self._types, self._frame, self._period = publishers, types, frame, period
        self._messages: Iterator[tuple[str, Any]] | None = None  # what is left of a map
        self._begun = -2.0 * period
        self._stamps: list[int] = []  # of the trajectory that they are of

    def publish_some(self, session: Session) -> bool:
        """The next message, if there is one and no measurement comes meanwhile; whether there was.

        Raises:
            RuntimeError: GTSAM's, for an estimate that cannot be used for now.
        """
        if not self._pending(session):
            return False
        session.intake.wait(REST)
        with session.lock:
            overdue = time.monotonic() - self._begun >= 2.0 * self._period
            if not self._pending(session) or (len(session.intake) and not overdue):
                return False
            messages, self._messages = self._messages, None  # gone, if it fails
            assert messages is not None
            if (following := next(messages, None)) is None:
                return False
            topic, message = following
            self._publishers[topic].publish(message)
            self._messages = messages
            return True

    def _pending(self, session: Session) -> bool:
        """Whether a map is to be published, or the rest of one."""
        estimator = session.estimator
        if estimator is None or not estimator.stamps:
            self._messages = None
            return False
        if estimator.stamps is not self._stamps:  # another trajectory: nothing of the one before comes after it
            self._messages, self._stamps = None, estimator.stamps
        now = time.monotonic()
        if self._messages is None and session.map_is_new and (session.refined or now - self._begun >= self._period):
            session.map_is_new, self._begun = False, now
            self._messages = map_messages(estimator, self._types, self._frame)
        return self._messages is not None
