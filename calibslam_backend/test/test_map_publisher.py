"""The map is published in pieces, when nothing else waits, and never one that was forgotten."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from calibslam_backend.ros import map_publisher_node
from calibslam_backend.ros.map_publisher_node import MapPublisher


class Queue:
    """An intake with so many measurements."""

    def __init__(self) -> None:
        self.waiting = 0

    def wait(self, timeout: float) -> None:
        assert 0.0 < timeout < 0.05

    def __len__(self) -> int:
        return self.waiting


class Published:
    def __init__(self, log: list[str]) -> None:
        self._log = log

    def publish(self, message: str) -> None:
        self._log.append(message)


@pytest.fixture
def log() -> list[str]:
    return []


@pytest.fixture
def session() -> Any:
    return SimpleNamespace(
        estimator=SimpleNamespace(stamps=[1]),
        intake=Queue(),
        lock=threading.RLock(),
        map_is_new=True,
        refined=False,
    )


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Its only number is the time."""
    now = [100.0]
    monkeypatch.setattr(map_publisher_node, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


@pytest.fixture
def publisher(log: list[str], clock: list[float], monkeypatch: pytest.MonkeyPatch) -> MapPublisher:
    def messages(estimator: Any, types: Any, frame: str) -> Any:
        for topic in "ab":
            yield topic, f"{topic}{estimator.stamps[-1]}"

    monkeypatch.setattr(map_publisher_node, "map_messages", messages)
    return MapPublisher(dict.fromkeys("ab", Published(log)), lambda name: None, "map", period=1.0)


def turns(publisher: MapPublisher, session: Any, number: int = 10) -> list[bool]:
    return [publisher.publish_some(session) for _ in range(number)]


def test_one_message_a_turn(publisher: MapPublisher, session: Any, log: list[str]) -> None:
    assert turns(publisher, session) == [True, True] + 8 * [False]
    assert log == ["a1", "b1"]


def test_measurements_go_first(publisher: MapPublisher, session: Any, log: list[str], clock: list[float]) -> None:
    assert publisher.publish_some(session)
    session.intake.waiting = 3
    assert not any(turns(publisher, session))
    clock[0] += 2.0
    assert publisher.publish_some(session), "after twice the period it is published all the same"
    assert log == ["a1", "b1"]


def test_period(publisher: MapPublisher, session: Any, log: list[str], clock: list[float]) -> None:
    turns(publisher, session)
    session.map_is_new = True
    session.estimator.stamps.append(2)
    clock[0] += 0.9
    assert not any(turns(publisher, session))
    clock[0] += 0.2
    turns(publisher, session)
    assert log == ["a1", "b1", "a2", "b2"]


def test_a_refined_map_is_published_at_once(publisher: MapPublisher, session: Any, log: list[str]) -> None:
    turns(publisher, session)
    session.map_is_new = session.refined = True
    turns(publisher, session)
    assert log == ["a1", "b1", "a1", "b1"]


def test_nothing_of_a_map_that_was_forgotten(
    publisher: MapPublisher, session: Any, log: list[str], clock: list[float]
) -> None:
    assert publisher.publish_some(session)
    session.estimator = SimpleNamespace(stamps=[])
    assert not any(turns(publisher, session))
    session.estimator.stamps.append(7)
    session.map_is_new = True
    clock[0] += 1.0
    turns(publisher, session)
    assert log == ["a1", "a7", "b7"]


def test_it_goes_on_after_an_error(
    publisher: MapPublisher, session: Any, log: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> Any:
        yield "a", "a"
        raise RuntimeError("indeterminate")

    monkeypatch.setattr(map_publisher_node, "map_messages", broken)
    assert publisher.publish_some(session)
    with pytest.raises(RuntimeError):
        publisher.publish_some(session)
    assert not any(turns(publisher, session))
