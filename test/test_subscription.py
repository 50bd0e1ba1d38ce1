"""Subscriptions connect to publishers of either kind, and large images of reliable ones all arrive."""

from __future__ import annotations

import time

import pytest
from live import Watcher, random_domain, wait_until
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from calibslam_msgs_py.message_types import RosTypes
from calibslam_msgs_py.node import IMAGES, MEASUREMENT_INPUT, Counters
from calibslam_msgs_py.node_subscription import Subscription

COUNT = 10  # as many as there is room for


@pytest.mark.parametrize("reliability", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
@pytest.mark.parametrize("profile", [IMAGES, MEASUREMENT_INPUT], ids=["images", "measurements"])
def test_as_reliable_as_the_publisher(profile: QoSProfile, reliability: ReliabilityPolicy) -> None:
    domain = random_domain()
    received: list[int] = []
    with Watcher(domain) as subscriber, Watcher(domain) as publishing:
        counters = Counters(subscriber.node)
        Subscription(subscriber.node, counters, Image, "images", lambda m: received.append(m.header.stamp.sec), profile)
        offered = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100, reliability=reliability)
        publisher = publishing.node.create_publisher(Image, "images", offered)

        def matched() -> bool:
            found = subscriber.node.get_subscriptions_info_by_topic("/images")
            return [info.qos_profile.reliability for info in found] == [reliability]

        wait_until(lambda: matched() and publisher.get_subscription_count() == 1, "they do not connect")
        time.sleep(1.0)  # that one side has found the other does not tell that the other has
        reliable = reliability == ReliabilityPolicy.RELIABLE
        # Best effort loses most of what is larger than a transport's buffers.
        height, width = (480, 640) if reliable else (4, 4)
        data = RosTypes().octets(bytes(3 * height * width))
        message = Image(height=height, width=width, encoding="rgb8", step=3 * width, data=data)
        for k in range(COUNT):
            message.header.stamp.sec = k
            publisher.publish(message)
            time.sleep(0.05)
        wait_until(lambda: len(received) == COUNT if reliable else received, lambda: f"{received}")
        assert received == sorted(set(received)) and matched()
