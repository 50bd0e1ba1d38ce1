"""Subscriptions that are as reliable as who publishes."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from calibslam_msgs_py.node import QOS_OVERRIDES, Counters

LOOK_PERIOD = 0.5  # [s] of wall time between two looks at the publishers
# Once reliability is what the publishers offer, it is no parameter any more; and what they keep, which was delivered
# before, is not asked for a second time.
FOLLOWING = (QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)
OTHER_OVERRIDES = QoSOverridingOptions([kind for kind in QOS_OVERRIDES.policy_kinds if kind not in FOLLOWING])


class Subscription:
    """Reliable where all publishers are, best effort where one is not.

    A reliable subscription does not connect to a publisher that is best effort, as many drivers are. A best-effort one
    connects to all, but loses what comes while the process is busy, and most messages that are larger than a
    transport's buffers, as raw images are.

    Its quality of service can be overridden by parameters; who sets reliability there has what he asks for. What the
    middleware loses of a topic that is meant to be reliable is counted as `lost_TOPIC`.

    Args:
        node: that it belongs to.
        counters: of the node.
        kind: class of the messages.
        topic: relative or absolute name.
        receive: takes a message, or with `raw` its bytes.
        profile: quality of service; its reliability is that before any publisher is known.
        raw: whether messages are left as bytes.
        follows: whether its reliability is that of the publishers. What comes while it changes may be lost.
    """

    def __init__(
        self,
        node: Node,
        counters: Counters,
        kind: Any,
        topic: str,
        receive: Callable[[Any], None],
        profile: QoSProfile,
        raw: bool = False,
        follows: bool = True,
    ) -> None:
        self._node, self._counters, self._kind, self._topic = node, counters, kind, topic
        self._receive, self._raw = receive, raw
        self._meant, self._profile = profile.reliability, copy(profile)
        self._subscription = self._subscribe(QOS_OVERRIDES)
        chosen = f"qos_overrides.{self._subscription.topic_name}.subscription.reliability" in node._parameter_overrides
        self._follows = follows and not chosen
        if self._follows:
            self._timer = node.create_timer(LOOK_PERIOD, self._match, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _subscribe(self, overrides: QoSOverridingOptions) -> Any:
        return self._node.create_subscription(
            self._kind,
            self._topic,
            self._receive,
            copy(self._profile),  # rclpy writes the overrides into the profile itself
            raw=self._raw,
            qos_overriding_options=overrides,
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._lost, incompatible_qos=self._incompatible),
        )

    def _lost(self, info: Any) -> None:
        # What is best effort may lose what it likes.
        if self._meant == self._profile.reliability == ReliabilityPolicy.RELIABLE:
            self._counters.count(f"lost_{self._topic}", info.total_count_change)

    def _incompatible(self, info: Any) -> None:
        if not self._follows:  # the others will match in a moment
            policy = QoSPolicyKind(info.last_policy_kind).name.lower()
            self._counters.warn(
                f"a publisher of {self._topic} offers another {policy} and is not heard: see qos_overrides"
            )

    def _match(self) -> None:
        offered = {
            publisher.qos_profile.reliability
            for publisher in self._node.get_publishers_info_by_topic(self._subscription.topic_name)
        }
        if not offered:
            return
        best_effort = ReliabilityPolicy.BEST_EFFORT in offered
        reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        if reliability != self._profile.reliability:
            self._profile.reliability = reliability
            self._profile.durability = DurabilityPolicy.VOLATILE
            self._node.destroy_subscription(self._subscription)
            self._subscription = self._subscribe(OTHER_OVERRIDES)
