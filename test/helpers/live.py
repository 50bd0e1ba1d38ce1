"""Real processes, and a node in the test's own process that watches them. Nothing here waits for a fixed time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from dds_domain import random_domain as random_domain
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node

from calibslam_backend.output.metrics import Trajectory
from calibslam_msgs_py.conversions import pose_from_msg, stamp_from_msg
from calibslam_msgs_py.node import LATCHED, make_executor

PATIENCE = 120.0  # [s] for what takes a second on an idle machine


class TimedOut(AssertionError):
    """What was waited for did not happen."""


def wait_until(condition: Callable[[], Any], what: str | Callable[[], str], timeout: float = PATIENCE) -> Any:
    """The first true value of a condition; `what` says what is wrong if it does not come."""
    end = time.monotonic() + timeout
    while not (value := condition()):
        if time.monotonic() > end:
            raise TimedOut(f"after {timeout:.0f} s: {what if isinstance(what, str) else what()}")
        time.sleep(0.02)
    return value


def executable(package: str, name: str) -> Path:
    """As `ros2 run` finds it."""
    for prefix in os.environ["AMENT_PREFIX_PATH"].split(os.pathsep):
        file = Path(prefix) / "lib" / package / name
        if file.is_file():
            return file
    raise FileNotFoundError(f"{package} {name} is not installed")


def keeping_all(topic: str) -> list[str]:
    """Arguments for a node that publishes this: nothing gets lost where a subscriber is busy for some seconds."""
    return ["--ros-args", "-p", f"qos_overrides.{topic}.publisher.depth:=5000"]


def kept(*topics: str) -> list[str]:
    """Parameters, `name:=value`, of a node that subscribes to these: it also gets what was published before it was
    connected.

    A publisher of another process may find a new subscriber only seconds after everybody sees it in the graph, and
    what it publishes until then would be lost.
    """
    return [f"qos_overrides.{topic}.subscription.durability:=transient_local" for topic in topics]


def asking_for_kept(*topics: str) -> list[str]:
    """The same as arguments."""
    return ["--ros-args", *(part for parameter in kept(*topics) for part in ("-p", parameter))]


class Process:
    """An installed executable in a DDS domain; a context manager that does not let it outlive the test."""

    def __init__(self, domain: int, package: str, name: str, *arguments: str) -> None:
        self.name = name
        self._output = tempfile.TemporaryFile("w+")  # noqa: SIM115 - a pipe that nobody reads would block
        self._process = subprocess.Popen(
            [sys.executable, str(executable(package, name)), *arguments],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
        )

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def output(self) -> str:
        """What it has said so far."""
        self._output.seek(0)
        return self._output.read()

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def wait(self, timeout: float = PATIENCE) -> int:
        """Its exit code."""
        return self._process.wait(timeout)

    def end(self, number: signal.Signals = signal.SIGINT) -> int:
        """Its exit code after a signal."""
        self._process.send_signal(number)
        return self.wait()

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.running:
            self._process.kill()
        self._process.wait()
        self._output.close()


class Watcher:
    """A node that collects what is published; a context manager."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node("watcher", context=self._context)
        self._executor = make_executor(self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._stop = threading.Event()
        self.last: dict[str, Any] = {}
        self.received: dict[str, int] = {}
        self._diagnostics: dict[str, dict[str, str]] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._receive_diagnostics, 100)
        self._thread.start()

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def _receive_diagnostics(self, message: Any) -> None:
        for status in message.status:
            self._diagnostics[status.name] = {value.key: value.value for value in status.values}

    def listen(self, kind: Any, topic: str, profile: Any = LATCHED) -> None:
        """Keep the last message of a topic in `last`, and how many came in `received`."""
        self.received[topic] = 0

        def receive(message: Any) -> None:
            self.last[topic] = message
            self.received[topic] += 1

        self.node.create_subscription(kind, topic, receive, profile)

    def counts(self, node: str) -> dict[str, str]:
        """The last values of a node's diagnostics."""
        return self._diagnostics.get(node, {})

    def call(self, kind: Any, name: str, timeout: float = PATIENCE, **request: Any) -> Any:
        """The response of a service."""
        client = self.node.create_client(kind, name)
        try:
            wait_until(client.service_is_ready, f"there is no service {name}", timeout)
            future = client.call_async(kind.Request(**request))
            wait_until(future.done, f"{name} does not answer", timeout)
            return future.result()
        finally:
            self.node.destroy_client(client)

    def sees(self, name: str) -> bool:
        """Whether a node of this full name is there."""
        return any(
            f"{namespace.rstrip('/')}/{node}" == name for node, namespace in self.node.get_node_names_and_namespaces()
        )

    def __enter__(self) -> Watcher:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._executor.shutdown()
        self._context.try_shutdown()


def trajectory_of(message: PathMessage) -> Trajectory:
    """The poses of a nav_msgs/Path."""
    stamps = [stamp_from_msg(pose.header.stamp) for pose in message.poses]
    return Trajectory(np.array(stamps), np.reshape([pose_from_msg(pose.pose) for pose in message.poses], (-1, 4, 4)))
