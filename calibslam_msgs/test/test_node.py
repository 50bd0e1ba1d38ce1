"""How a node's process starts and ends, and what it reports."""

import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from calibslam_msgs_py.node import LATCHED, MEASUREMENT, SENSOR, Counters

NODE = textwrap.dedent("""
    import sys
    from calibslam_msgs_py.node import run
    from calibslam_msgs_py.settings import Settings, declare_parameters, setting
    from dataclasses import dataclass
    from rclpy.clock import Clock, ClockType
    from rclpy.node import Node

    @dataclass(frozen=True)
    class Example(Settings):
        sigma: float = setting(5.0, "standard deviation", unit="px", low=0.1)

    class ExampleNode(Node):
        def __init__(self):
            super().__init__("example")
            declare_parameters(self, Example)
            self.create_timer(0.01, self.started, clock=Clock(clock_type=ClockType.STEADY_TIME))

        def started(self):
            print("started", flush=True)

        def close(self):
            print("closed", flush=True)

    sys.exit(run(ExampleNode))
""")


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", NODE, "--ros-args", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_node_with_0(number: signal.Signals) -> None:
    process = start()
    assert process.stdout is not None and process.stdout.readline() == "started\n"
    process.send_signal(number)
    output, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")
    assert output.endswith("closed\n")


@pytest.mark.parametrize(
    ("parameter", "text"),
    [
        ("sgima:=1.0", "error: example: unknown parameter sgima; valid are: sigma"),
        ("sigma:=0.0", "error: sigma = 0.0"),
    ],
)
def test_bad_parameters_end_a_node_with_2(parameter: str, text: str) -> None:
    process = start("-p", parameter)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 2
    assert text in errors and "Traceback" not in errors


@pytest.fixture
def nodes() -> Iterator[tuple[Node, Node, SingleThreadedExecutor]]:
    context = rclpy.Context()
    rclpy.init(context=context)
    pair = Node("one", namespace="ns", context=context), Node("other", context=context)
    executor = SingleThreadedExecutor(context=context)
    for node in pair:
        executor.add_node(node)
    yield *pair, executor
    context.try_shutdown()


def spin_until(executor: SingleThreadedExecutor, condition: object, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:  # type: ignore[operator]
        executor.spin_once(timeout_sec=0.1)


def test_counters_reach_diagnostics(nodes: tuple[Node, Node, SingleThreadedExecutor]) -> None:
    one, other, executor = nodes
    received: list[DiagnosticArray] = []
    other.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    counters = Counters(one)
    counters.count("boxes", 5)
    counters.count("rejected_nan")
    counters.set("update_ms", 1.5)
    spin_until(executor, lambda: len(received) >= 2)
    (first,), (second,) = received[0].status, received[1].status
    assert first.name == "/ns/one"
    assert {v.key: v.value for v in first.values} == {"boxes": "5", "rejected_nan": "1", "update_ms": "1.5"}
    assert (first.level, first.message) == (DiagnosticStatus.WARN, "rejected_nan")
    assert second.level == DiagnosticStatus.OK  # it no longer grows
    assert (counters["boxes"], counters["never"]) == (5, 0)


def test_latched_topics_reach_who_joins_late(nodes: tuple[Node, Node, SingleThreadedExecutor]) -> None:
    one, other, executor = nodes
    one.create_publisher(String, "map", LATCHED).publish(String(data="all of it"))
    received: list[String] = []
    other.create_subscription(String, "/ns/map", received.append, LATCHED)
    spin_until(executor, lambda: received)
    assert [msg.data for msg in received] == ["all of it"]


@pytest.mark.parametrize(("publisher", "subscriber"), [(MEASUREMENT, MEASUREMENT), (SENSOR, SENSOR), (10, SENSOR)])
def test_profiles_connect(
    nodes: tuple[Node, Node, SingleThreadedExecutor], publisher: object, subscriber: object
) -> None:
    one, other, executor = nodes
    received: list[String] = []
    other.create_subscription(String, "/ns/topic", received.append, subscriber)  # type: ignore[arg-type]
    talker = one.create_publisher(String, "topic", publisher)  # type: ignore[arg-type]
    spin_until(executor, lambda: talker.get_subscription_count() == 1)
    for i in range(5):
        talker.publish(String(data=str(i)))
    spin_until(executor, lambda: len(received) == 5)
    assert [msg.data for msg in received] == list("01234")
