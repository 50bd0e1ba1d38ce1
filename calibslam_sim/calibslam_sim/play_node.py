"""`play`: publishes a bag with /clock, as `ros2 bag play --clock` does, and loses nothing.

Every topic is published reliably (which serves best-effort subscribers too); measurements, camera information, maps and
static transforms also for who asks for what was before. ROS options (remapping, namespace) follow --ros-args.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from calibslam_msgs_py.bags import BagError, BagReader
from calibslam_msgs_py.command import ArgumentParser
from calibslam_msgs_py.conversions import RosTypes, stamp_to_msg
from calibslam_msgs_py.node import LATCHED
from calibslam_msgs_py.progress import Progress

CLOCK_PERIOD = 0.005  # [s] of wall time
SUBSCRIBER_POLL = 0.02  # [s]
SECONDS_TO_CONNECT = 1.0
ACKNOWLEDGE_TIMEOUT = 10.0  # [s]
LATCHED_TYPES = ("sensor_msgs/msg/CameraInfo", "calibslam_msgs/msg/QuadricArray", "tf2_msgs/msg/TFMessage")
# Measurements are kept for who asks for them, as the nodes that make them do.
KEPT_TYPES = (
    "calibslam_msgs/msg/BoundingBoxArray",
    "calibslam_msgs/msg/RelativePose",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "vision_msgs/msg/Detection2DArray",
)
# Deep: at high rates a subscriber may be busy for a while.
PLAYED = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.RELIABLE)
KEPT = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=PLAYED.depth,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class PlayError(Exception):
    """Playing is not possible; the text says why."""


class Player(Node):
    """Publishes the topics of one bag."""

    def __init__(self, bag: BagReader) -> None:
        super().__init__("play", start_parameter_services=False)
        self._bag = bag
        self._types = RosTypes()
        self._clock_message = Clock()
        self._clock_publisher = self.create_publisher(Clock, "/clock", 10)
        self._publishers_by_topic: dict[str, Any] = {}
        for topic, kind in bag.topics.items():
            self._advertise(topic, kind)
        if not self._publishers_by_topic:
            raise PlayError(f"{bag.path} holds no topic that can be published")

    def _advertise(self, topic: str, kind: str) -> None:
        if topic == "/clock":
            return  # ours
        try:
            message_class = self._types(kind)
        except (ImportError, AttributeError):
            self.get_logger().warning(f"{topic} is not played: there is no Python package for {kind} here")
            return
        latched = kind in LATCHED_TYPES and topic != "/tf"
        profile = LATCHED if latched else KEPT if kind in KEPT_TYPES else PLAYED
        self._publishers_by_topic[topic] = self.create_publisher(message_class, topic, profile)

    def wait_for_subscribers(self, expected: dict[str, int], timeout: float) -> None:
        """Until each topic, played here or by other nodes, has at least so many subscribers.

        Raises:
            PlayError: the time [s] is over.
        """
        end = time.monotonic() + timeout
        while missing := {t: n for t, n in expected.items() if self._subscribers(t) < n}:
            if time.monotonic() > end:
                texts = [f"{t} has {self._subscribers(t)} subscribers, not {n}" for t, n in missing.items()]
                raise PlayError(f"after {timeout:g} s: {', '.join(texts)}")
            time.sleep(SUBSCRIBER_POLL)
        if not expected.keys() <= self._publishers_by_topic.keys():
            # That a subscriber exists does not tell whether another node's publisher has found it yet, which took up to
            # 2 s on a busy machine. A subscriber that asks for kept messages (transient local) loses nothing even then.
            time.sleep(SECONDS_TO_CONNECT)

    def _subscribers(self, topic: str) -> int:
        publisher = self._publishers_by_topic.get(topic)
        return self.count_subscribers(topic) if publisher is None else publisher.get_subscription_count()

    def play(self, rate: float, progress: Progress) -> int:
        """Publish the whole bag at `rate` times its speed; returns the number of messages."""
        begin, count, last_clock = time.monotonic(), 0, 0.0
        for topic, stamp, data in self._bag.raw_messages(list(self._publishers_by_topic)):
            due = begin + (stamp - self._bag.start) * 1e-9 / rate
            while True:
                now = time.monotonic()
                if now - last_clock >= CLOCK_PERIOD:
                    # Never ahead of the messages, also where publishing is slower than asked for.
                    played = self._bag.start + int((now - begin) * rate * 1e9)
                    self._publish_clock(min(played, stamp))
                    last_clock = now
                    progress.at((stamp - self._bag.start) * 1e-9)
                if now >= due:
                    break
                time.sleep(min(due - now, CLOCK_PERIOD))
            self._publishers_by_topic[topic].publish(data)
            count += 1
        self._publish_clock(self._bag.end)
        return count

    def wait_until_received(self) -> None:
        """Until every reliable subscriber has received everything.

        Raises:
            PlayError: one has not within `ACKNOWLEDGE_TIMEOUT`.
        """
        for topic, publisher in self._publishers_by_topic.items():
            if not publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_TIMEOUT)):
                raise PlayError(f"a subscriber of {topic} has not received everything")

    def _publish_clock(self, stamp: int) -> None:
        self._clock_message.clock = stamp_to_msg(stamp, self._types)
        self._clock_publisher.publish(self._clock_message)


def play(bag: BagReader, arguments: argparse.Namespace) -> None:
    """Make the node and play as the command line says."""
    player = Player(bag)
    try:
        player.wait_for_subscribers(dict(arguments.wait_for), arguments.wait_timeout)
        seconds = (bag.end - bag.start) * 1e-9
        while True:
            begin = time.monotonic()
            with Progress(seconds, f"playing {bag.path.name}") as progress:
                count = player.play(arguments.rate, progress)
            player.wait_until_received()
            wall = time.monotonic() - begin
            print(f"played {count} messages, {seconds:.1f} s of recording in {wall:.1f} s", flush=True)
            if not arguments.loop:
                return
    finally:
        player.destroy_node()


def main(args: Sequence[str] | None = None) -> int:
    """Command line of `play`; returns the exit code, 0 also after SIGINT and SIGTERM."""
    argv = list(sys.argv if args is None else ["play", *args])
    arguments = _parser().parse_args(remove_ros_args(argv)[1:])
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, signal.default_int_handler)
    try:
        with BagReader(arguments.bag) as bag:
            rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
            play(bag, arguments)
    except KeyboardInterrupt:
        return 0
    except (BagError, PlayError) as error:
        print(f"play: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(prog="play", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 folder or .mcap file")
    parser.add_argument("--rate", type=_positive, default=1.0, help="times real time (default: 1)")
    parser.add_argument(
        "--loop", action="store_true", help="again and again; stamps then jump back, as in every looped bag"
    )
    parser.add_argument(
        "--wait-for",
        type=_subscribers,
        action="append",
        default=[],
        metavar="TOPIC:N",
        help="start only when TOPIC, of the bag or of another node, has N subscribers; may be repeated",
    )
    parser.add_argument(
        "--wait-timeout", type=_positive, default=30.0, metavar="S", help="and fail after S (default: 30)"
    )
    return parser


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def _subscribers(text: str) -> tuple[str, int]:
    topic, _, count = text.rpartition(":")
    if not topic.startswith("/") or not count.isdigit():
        raise argparse.ArgumentTypeError(f"{text} is not of the form /topic:2")
    return topic, int(count)


if __name__ == "__main__":
    sys.exit(main())
