"""A thread that works on the newest of what comes to a node."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from rclpy.node import Node

from calibslam_msgs_py.measurements import InvalidMeasurement
from calibslam_msgs_py.node import Counters

Item = TypeVar("Item")


class NewestWorker(Generic[Item]):
    """Of what waits only the newest stays; what it replaces is counted as `dropped`.

    What cannot be used (`InvalidMeasurement`) and errors are counted and told, and the work goes on with the next.

    Args:
        node: that it belongs to.
        counters: of the node.
        work: what is done with an item.
    """

    def __init__(self, node: Node, counters: Counters, work: Callable[[Item], None]) -> None:
        self._node, self._counters, self._work = node, counters, work
        self._newest: Item | None = None
        self._arrived = threading.Condition()
        self._stop = False
        self._thread = threading.Thread(target=self._run, name=node.get_name(), daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Something new, from any thread."""
        with self._arrived:
            if self._newest is not None:
                self._counters.count("dropped")
            self._newest = item
            self._arrived.notify()

    def close(self) -> None:
        """Let the thread end what it has begun."""
        with self._arrived:
            self._stop = True
            self._arrived.notify()
        self._thread.join(timeout=10.0)

    def _run(self) -> None:
        while True:
            with self._arrived:
                self._arrived.wait_for(lambda: self._newest is not None or self._stop)
                item, self._newest = self._newest, None
            if self._stop or item is None:
                return
            try:
                self._work(item)
            except InvalidMeasurement as error:
                self._counters.reject(error)
            except Exception as error:  # the node goes on with the next
                self._counters.count("errors")
                self._node.get_logger().error(f"{type(error).__name__}: {error}")
