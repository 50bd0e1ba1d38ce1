"""Every node that subscribes, in this process, among messages spoilt at random: its callbacks raise nothing, and
afterwards it still takes what is valid. Size as in test_fuzz_messages."""

from __future__ import annotations

import importlib
import inspect
import os
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from random import Random
from typing import Any

import pytest
import rclpy
import torch
from fuzzing import fuzz
from live import random_domain
from mutations import spoilt_bytes, spoilt_message
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from valid_messages import VALID

from calibslam_detector.model import weights_file
from calibslam_detector.model.network import CalibratedDetector
from calibslam_msgs_py.conversions import RosTypes
from calibslam_msgs_py.settings import SettingsError

TYPES = RosTypes()
NEED_A_FILE = {"weights": "weights.pt", "out": "recorded.mcap"}  # parameter -> file in the test's folder


def node_classes() -> dict[str, type[Node]]:
    """Executable -> class, of all nodes that are made without arguments."""
    found: dict[str, type[Node]] = {}
    for point in entry_points(group="console_scripts"):
        module, _, _ = point.value.partition(":")
        if not (module.startswith("calibslam_") and module.endswith("_node")):
            continue
        for _, kind in inspect.getmembers(importlib.import_module(module), inspect.isclass):
            if issubclass(kind, Node) and kind.__module__ == module and len(inspect.signature(kind).parameters) == 0:
                found[point.name] = kind
    return found


NODES = node_classes()


def message_name(kind: Any) -> str:
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


@pytest.fixture(params=sorted(NODES))
def node(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    """In a DDS domain of its own."""
    monkeypatch.setitem(os.environ, "ROS_DOMAIN_ID", str(random_domain()))
    torch.manual_seed(4)
    weights_file.save(CalibratedDetector("compact", ("cup", "book")), tmp_path / "weights.pt")
    source = inspect.getsource(importlib.import_module(NODES[request.param].__module__))
    given_files = [f"{name}:={tmp_path / file}" for name, file in NEED_A_FILE.items() if f"    {name}: str" in source]
    rclpy.init(args=["--ros-args", *(part for text in given_files for part in ("-p", text))])
    made: Node | None = None
    try:
        try:
            made = NODES[request.param]()
        except SettingsError as error:
            pytest.skip(str(error))  # it takes messages of a package that is not there
        yield made
    finally:
        if made is not None and hasattr(made, "close"):
            made.close()
        if made is not None:
            made.destroy_node()
        rclpy.try_shutdown()


def test_nodes_are_found() -> None:
    assert {"backend", "calibrator", "detector", "odometry", "record"} <= NODES.keys()


def deliver(receive: Callable[[Any], None], encode: Callable[[Any], Any], valid: Any, random: Random) -> None:
    receive(encode(spoilt_message(valid, random, lengths_too=False)))
    if encode is serialize_message:
        receive(spoilt_bytes(serialize_message(valid), random))


def test_every_input_among_spoilt_messages(node: Node) -> None:
    subscriptions = [s for s in node.subscriptions if message_name(s.msg_type) in VALID]
    assert subscriptions, "no input of this node is known to `valid_messages`"
    for subscription in subscriptions:
        valid = VALID[message_name(subscription.msg_type)](TYPES)
        # Some decode messages themselves, to count what cannot be decoded.
        encode = serialize_message if subscription.raw else lambda message: message
        receive: Callable[[Any], None] = subscription.callback
        receive(encode(valid))
        fuzz(partial(deliver, receive, encode, valid), few=15, many=400)
        receive(encode(valid))
    assert not getattr(node, "_counters", {"errors": 0})["errors"]


def send(publisher: Any, executor: SingleThreadedExecutor, data: bytes, random: Random) -> None:
    publisher.publish(spoilt_bytes(data, random))
    executor.spin_once(timeout_sec=0.01)


def test_garbage_from_the_network(node: Node) -> None:
    """Bytes that are no message, from another participant."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
    peer, executor = Node("peer", context=context), SingleThreadedExecutor()
    executor.add_node(node)
    try:
        for subscription in [s for s in node.subscriptions if message_name(s.msg_type) in VALID]:
            publisher = peer.create_publisher(subscription.msg_type, subscription.topic_name, 10)
            data = serialize_message(VALID[message_name(subscription.msg_type)](TYPES))
            fuzz(partial(send, publisher, executor, data), few=15, many=200)
    finally:
        executor.shutdown()
        peer.destroy_node()
        context.try_shutdown()
