"""How a node's process starts and ends, and what it reports."""

import itertools
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import String

from calibslam_msgs_py.measurements import SECOND, InvalidMeasurement
from calibslam_msgs_py.node import LATCHED, MEASUREMENT, MEASUREMENT_INPUT, SENSOR, Counters
from calibslam_msgs_py.node_subscription import Subscription

PATIENCE = 120.0  # [s] for what takes a second on an idle machine
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
    output, errors = process.communicate(timeout=PATIENCE)
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
    _, errors = process.communicate(timeout=PATIENCE)
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
    executor.shutdown()
    for node in pair:
        node.destroy_node()  # or the next test meets it
    context.try_shutdown()


def spin_until(executor: SingleThreadedExecutor, condition: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "nothing comes"
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


def test_inputs_and_what_the_node_adds_reach_diagnostics(nodes: tuple[Node, Node, SingleThreadedExecutor]) -> None:
    one, other, executor = nodes
    received: list[DiagnosticArray] = []
    other.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    counters = Counters(one, lambda: {"memory_mb": 12})
    counters.reject(InvalidMeasurement("nan", "three boxes"), 3)
    counters.count("errors_journal")
    for _ in range(5):
        counters.arrived("detections", one.get_clock().now().nanoseconds - 2 * SECOND)
        counters.arrived("replayed", 10**9 * SECOND)
    spin_until(executor, lambda: received)
    (status,) = received[0].status
    values = {v.key: v.value for v in status.values}
    assert values["memory_mb"] == "12" and values["rejected_nan"] == "3"
    assert float(values["detections_hz"]) > 0.0 and float(values["detections_age_s"]) >= 0.0
    assert 2.0 <= float(values["detections_delay_s"]) < 2.0 + PATIENCE
    assert float(values["replayed_hz"]) > 0.0 and "replayed_delay_s" not in values
    assert (status.level, status.message) == (DiagnosticStatus.ERROR, "errors_journal, rejected_nan")


def test_warnings_do_not_swallow_each_other(
    nodes: tuple[Node, Node, SingleThreadedExecutor], capfd: pytest.CaptureFixture[str]
) -> None:
    """Each reason is said once in a while, and each text, whatever its numbers."""
    counters = Counters(nodes[0])
    for n in range(3):
        for reason in ("nan", "late"):
            counters.reject(InvalidMeasurement(reason, f"{reason}, image {n}"))
    for n in range(3):
        counters.warn(f"record {n} cannot be read")
        counters.warn("time has jumped back")
    said = capfd.readouterr().err.splitlines()
    assert [line.rpartition("]: ")[2] for line in said] == [
        "left out: nan, image 0", "left out: late, image 0", "record 0 cannot be read", "time has jumped back",
    ]  # fmt: skip
    assert (counters["rejected_nan"], counters["rejected_late"]) == (3, 3)
    for letters in itertools.product("abcdefgh", repeat=4):  # a peer that has a new text each time
        counters.warn("".join(letters))
    assert len(capfd.readouterr().err.splitlines()) < 100 and len(counters._throttle._said) <= 100


def test_what_is_usually_left_out_is_no_reason_to_warn(nodes: tuple[Node, Node, SingleThreadedExecutor]) -> None:
    one, other, executor = nodes
    received: list[DiagnosticArray] = []
    other.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    counters = Counters(one, usual=("rejected_double_box",))
    counters.count("rejected_double_box", 3)
    spin_until(executor, lambda: received)
    (status,) = received[0].status
    assert (status.level, status.message) == (DiagnosticStatus.OK, "running")
    assert {v.key: v.value for v in status.values}["rejected_double_box"] == "3"


def test_who_asks_for_a_reliability_has_it(
    nodes: tuple[Node, Node, SingleThreadedExecutor], capfd: pytest.CaptureFixture[str]
) -> None:
    """And is told where it connects to nobody. Otherwise it is that of the publishers."""
    _, other, executor = nodes
    name = "qos_overrides./asked.subscription.reliability"
    node = Node("overridden", context=other.context, parameter_overrides=[Parameter(name, value="reliable")])
    executor.add_node(node)
    counters = Counters(node)
    for topic in ("asked", "free"):
        Subscription(node, counters, String, topic, print, MEASUREMENT_INPUT)
        other.create_publisher(String, topic, SENSOR)

    def reliability(topic: str) -> ReliabilityPolicy:
        return node.get_subscriptions_info_by_topic(f"/{topic}")[0].qos_profile.reliability

    spin_until(executor, lambda: reliability("free") == ReliabilityPolicy.BEST_EFFORT)
    assert reliability("asked") == ReliabilityPolicy.RELIABLE
    said = ""

    def told() -> bool:
        nonlocal said
        said += capfd.readouterr().err
        return "a publisher of asked offers another reliability and is not heard" in said

    spin_until(executor, told)
    assert "a publisher of free" not in said and "New publisher discovered" not in said
    executor.remove_node(node)
    node.destroy_node()


def test_an_override_is_of_one_topic_only(nodes: tuple[Node, Node, SingleThreadedExecutor]) -> None:
    name = "qos_overrides./kept.subscription.durability"
    node = Node("overridden", context=nodes[0].context, parameter_overrides=[Parameter(name, value="transient_local")])
    counters = Counters(node)
    for topic in ("kept", "plain"):
        Subscription(node, counters, String, topic, print, MEASUREMENT_INPUT)
    found = {
        topic: node.get_subscriptions_info_by_topic(f"/{topic}")[0].qos_profile.durability
        for topic in ("kept", "plain")
    }
    assert found == {"kept": DurabilityPolicy.TRANSIENT_LOCAL, "plain": DurabilityPolicy.VOLATILE}
    assert MEASUREMENT_INPUT.durability != DurabilityPolicy.TRANSIENT_LOCAL
    node.destroy_node()
