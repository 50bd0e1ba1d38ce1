"""What the nodes share: quality-of-service profiles, start and end of a process, diagnostics."""

from __future__ import annotations

import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Sequence

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions

from calibslam_msgs_py.settings import SettingsError

# Raw sensor input: best effort, so that it connects to every publisher.
SENSOR: QoSProfile = qos_profile_sensor_data
# Boxes and motions: none may get lost.
MEASUREMENT = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE)
# Who takes them in has room for several seconds of them, for a moment when it is busy.
MEASUREMENT_INPUT = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=5000, reliability=ReliabilityPolicy.RELIABLE)
# Maps: the last one also for who joins late.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

BAD_SETTINGS = 2  # exit code
SIGNAL_LATENCY = 0.1  # how long a waiting executor may not see a signal [s]


def run(node_factory: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Run one node in one thread until SIGINT or SIGTERM; returns the exit code.

    Both signals end it with 0, after the callback that runs; a second one ends it at once. A bad or unknown
    parameter ends it with 2 and a line that says why. `node.close()`, where there is one, is called at the
    end and may still publish.

    Args:
        node_factory: makes the node; called after rclpy is initialised.
        args: as on the command line; None: those of this process.
    """
    stop = threading.Event()

    def on_signal(number: int, frame: object) -> None:
        stop.set()
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, signal.SIG_DFL)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    node: Node | None = None
    try:
        # rclpy's own handlers shut the context down under the running executor, which then fails at times.
        rclpy.init(args=list(args) if args is not None else None, signal_handler_options=SignalHandlerOptions.NO)
        node = node_factory()
        refuse_unknown_parameters(node)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok() and not stop.is_set():
            executor.spin_once(timeout_sec=SIGNAL_LATENCY)
    except ExternalShutdownException:
        pass  # the node shut the context down itself: it is done
    except SettingsError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_SETTINGS
    finally:
        if node is not None:
            close = getattr(node, "close", None)
            if close is not None:
                close()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def refuse_unknown_parameters(node: Node) -> None:
    """ROS ignores parameters that a node does not know, and so does every typing error.

    Raises:
        SettingsError: naming the unknown and the valid ones.
    """
    unknown = sorted(name for name in node._parameter_overrides if not node.has_parameter(name))
    if unknown:
        valid = sorted(name for name in node._parameters if not name.startswith("start_type_description"))
        raise SettingsError(f"{node.get_name()}: unknown parameter {', '.join(unknown)}; valid are: {', '.join(valid)}")


class Counters:
    """What happened in a node, by name, published on /diagnostics once per second of wall time.

    The level is WARN while counters named `rejected...` grow, and OK otherwise.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._counts: Counter[str] = Counter()
        self._values: dict[str, str] = {}
        self._published: Counter[str] = Counter()
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Wall time: with use_sim_time and no /clock yet, a timer of the node's clock would never fire.
        self._timer = node.create_timer(1.0, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def count(self, name: str, by: int = 1) -> None:
        """Add to a counter."""
        self._counts[name] += by

    def set(self, name: str, value: object) -> None:
        """State a value, such as a duration with its unit."""
        self._values[name] = str(value)

    def __getitem__(self, name: str) -> int:
        return self._counts[name]

    def _publish(self) -> None:
        growing = [
            name
            for name, count in sorted(self._counts.items())
            if name.startswith("rejected") and count > self._published[name]
        ]
        self._published = self._counts.copy()
        values = {name: str(count) for name, count in sorted(self._counts.items())} | self._values
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if growing else DiagnosticStatus.OK,
            name=self._node.get_fully_qualified_name(),
            message=", ".join(growing) or "running",
            hardware_id="calibslam",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
