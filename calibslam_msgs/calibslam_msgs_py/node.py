"""What the nodes share: quality-of-service profiles, start and end of a process, diagnostics."""

from __future__ import annotations

import re
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions

from calibslam_msgs_py.measurements import SECOND, InvalidMeasurement
from calibslam_msgs_py.parameter_files import NodeParameters
from calibslam_msgs_py.settings import SettingsError

SENSOR: QoSProfile = qos_profile_sensor_data
# Of images a subscription has room for a few: the newest ones are wanted.
IMAGES = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
# Boxes and motions: none may get lost. Kept for who asks for the last ones (transient local), as after a restart.
MEASUREMENT = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
# Who takes them in has room for several seconds of them, for a moment when it is busy.
MEASUREMENT_INPUT = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=5000, reliability=ReliabilityPolicy.RELIABLE)
# Maps: the last one also for who joins late.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# Parameters `qos_overrides.TOPIC.publisher.depth` and so on.
QOS_OVERRIDES = QoSOverridingOptions(
    [QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY]
)

BAD_SETTINGS = 2  # exit code
SECONDS_BETWEEN_WARNINGS = 5.0  # of one kind
LONGEST_DELAY = 86_400 * SECOND  # [ns]; more is no delay, but the time of a recording against that of the clock
SIGNAL_LATENCY = 0.1  # how long a waiting executor may not see a signal [s]


def run(node_factory: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Run one node in one thread until SIGINT or SIGTERM; returns the exit code.

    Both signals end it with 0, after the callback that runs; a second one ends it at once. A bad or unknown
    parameter ends it with 2 and a line that says why. `node.close()`, where there is one, is called at the
    end and may still publish. With -h or --help nothing is started: it is said what the node does.

    Args:
        node_factory: makes the node; called after rclpy is initialised.
        args: as on the command line; None: those of this process.
    """
    words = list(sys.argv[1:] if args is None else args)
    before_ros = words[: words.index("--ros-args")] if "--ros-args" in words else words
    if {"-h", "--help"} & set(before_ros):
        print(help_text(node_factory))
        return 0
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
        executor = make_executor()
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


def help_text(node_factory: Callable[[], Node]) -> str:
    """What a node does, its topics and its parameters: from the docstrings of its module and of its class."""
    module = sys.modules[node_factory.__module__]
    name = module.__spec__.name if module.__spec__ else module.__name__  # that of what runs is __main__
    package, _, rest = name.partition(".")
    executable = rest.removesuffix("_node")
    file = f"{package}/config/{executable}.yaml"
    start = f"./calibslam run {package} {executable}"
    lines = [
        f"usage: {start} [--ros-args -r FROM:=TO -p NAME:=VALUE --params-file FILE]",
        (module.__doc__ or "").strip(),
        f"topics: {(node_factory.__doc__ or 'see the documentation').strip().rstrip('.')}",
    ]
    has_parameters = NodeParameters.of_module(package, executable, module).settings
    lines.append(
        f"parameters: {file} has all of them, with meanings and defaults" if has_parameters else "no parameters"
    )
    return "\n\n".join(lines)


def make_executor(context: Context | None = None) -> Executor:
    """One thread for all callbacks of a context (by default: the process').

    Where rclpy has it (Jazzy since 7.1.4), the one that is told of what comes: it hands messages over 1 ms earlier, and
    takes a quarter less of a core, than the one that builds a set of everything to wait for each time anew.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def refuse_unknown_parameters(node: Node) -> None:
    """ROS ignores parameters that a node does not know, and so does every typing error.

    Raises:
        SettingsError: naming the unknown and the valid ones.
    """
    unknown = sorted(name for name in node._parameter_overrides if not node.has_parameter(name))
    if unknown:
        ours = sorted(name for name in node._parameters if not name.startswith(("start_type", "qos_overrides.")))
        raise SettingsError(
            f"{node.get_name()}: unknown parameter {', '.join(unknown)}; valid are: {', '.join(ours)}, and those that "
            "`ros2 param list` shows as qos_overrides"
        )


class Counters:
    """What happened in a node, by name, published on /diagnostics once per second of wall time.

    The level is ERROR while counters named `errors...` grow, WARN while such as `rejected...` or `lost...` do, and OK
    otherwise.

    Args:
        node: that publishes.
        describe: gives further values, by name, when they are published.
        usual: counters that grow where all is well.
    """

    WARN, ERROR = ("rejected", "lost"), ("errors",)

    def __init__(
        self,
        node: Node,
        describe: Callable[[], Mapping[str, object]] | None = None,
        usual: Collection[str] = (),
    ) -> None:
        self._node, self._describe, self._usual = node, describe, usual
        self._counting = threading.Lock()  # several threads may count
        self._throttle = _Throttle()
        self._counts: Counter[str] = Counter()
        self._values: dict[str, str] = {}
        self._published: Counter[str] = Counter()
        self._inputs: dict[str, _Input] = {}
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Wall time: with use_sim_time and no /clock yet, a timer of the node's clock would never fire.
        self._timer = node.create_timer(1.0, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def count(self, name: str, by: int = 1) -> None:
        """Add to a counter."""
        with self._counting:
            self._counts[name] += by

    def reject(self, error: InvalidMeasurement, count: int = 1) -> None:
        """Count what is left out by its reason, and say so now and then."""
        self.count(f"rejected_{error.reason}", count)
        self.warn(f"left out: {error}", error.reason)

    def warn(self, text: str, kind: str = "") -> None:
        """Say something, if nothing of its kind was said just now. By default, texts that differ in numbers are one."""
        if self._throttle.lets_through(kind or re.sub(r"\d+", "#", text)):
            self._node.get_logger().warning(text)

    def arrived(self, name: str, stamp: int) -> None:
        """A message of an input came; stamp [ns]. Its rate, age and delay are then stated."""
        now = self._node.get_clock().now().nanoseconds
        self._inputs.setdefault(name, _Input()).arrived(stamp, now)

    def set(self, name: str, value: object) -> None:
        """State a value, such as a duration with its unit."""
        self._values[name] = str(value)

    def __getitem__(self, name: str) -> int:
        return self._counts[name]

    def _publish(self) -> None:
        with self._counting:
            counts = self._counts.copy()
        growing = [name for name, count in sorted(counts.items()) if count > self._published[name]]
        errors = [name for name in growing if name.startswith(self.ERROR)]
        warnings = [name for name in growing if name.startswith(self.WARN) and name not in self._usual]
        self._published = counts
        values = {name: str(count) for name, count in sorted(counts.items())} | self._values
        for name, each in self._inputs.items():
            values |= {f"{name}_{key}": value for key, value in each.values().items()}
        if self._describe is not None:
            values |= {name: str(value) for name, value in self._describe().items()}
        level = DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if errors else level,
            name=self._node.get_fully_qualified_name(),
            message=", ".join(errors + warnings) or "running",
            hardware_id="calibslam",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


class _Throttle:
    """What kinds of warnings were said just now. rclpy's has one time for each line of code, whatever it says."""

    MOST = 100  # kinds in SECONDS_BETWEEN_WARNINGS; exceptions of others may say anything

    def __init__(self) -> None:
        self._asked = threading.Lock()
        self._said: dict[str, float] = {}

    def lets_through(self, kind: str) -> bool:
        now = time.monotonic()
        with self._asked:
            self._said = {each: at for each, at in self._said.items() if now - at < SECONDS_BETWEEN_WARNINGS}
            if kind in self._said or len(self._said) >= self.MOST:
                return False
            self._said[kind] = now
            return True


class _Input:
    """When the messages of a topic came."""

    def __init__(self) -> None:
        self._since = self._last = time.monotonic()
        self._count = self._delay = 0

    def arrived(self, stamp: int, now: int) -> None:
        self._last = time.monotonic()
        self._count += 1
        self._delay = now - stamp

    def values(self) -> dict[str, str]:
        """Rate since the last call [Hz], time since the last message [s], and how old that was when it came [s], unless
        stamp and clock are of two times.
        """
        now = time.monotonic()
        rate = self._count / max(now - self._since, 1e-3)
        self._since, self._count = now, 0
        values = {"hz": f"{rate:.1f}", "age_s": f"{now - self._last:.2f}"}
        if abs(self._delay) < LONGEST_DELAY:
            values["delay_s"] = f"{self._delay / SECOND:.3f}"
        return values


def advertise(node: Node, kind: Any, topic: str, profile: QoSProfile) -> Any:
    """A publisher whose quality of service can be overridden by parameters."""
    # A copy: rclpy writes the overrides into the profile itself.
    return node.create_publisher(kind, topic, copy(profile), qos_overriding_options=QOS_OVERRIDES)
