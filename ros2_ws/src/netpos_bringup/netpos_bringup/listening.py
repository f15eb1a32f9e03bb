"""A node that listens to the topics of a graph as they come and go, and takes what has arrived
when it asks: messages stay bytes, and no executor looks at every topic for each of them."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

from netpos.bags.qos import is_latched
from netpos_bag.conversions import profile_to_bag, profile_to_record, unique
from netpos_node import message_class, waiting
from rclpy.node import Node
from rclpy.signals import uninstall_signal_handlers
from rclpy.subscription import Subscription

LOOK_S = 0.25


@dataclass(frozen=True, slots=True)
class Arrived:
    """A message as it is on the wire."""

    topic: str
    type_name: str
    cdr: bytes


class ListeningNode(Node):
    """Subscribes to the topics that ``listen`` names."""

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        self._subscriptions_of: dict[str, Subscription] = {}
        self._latched: set[str] = set()
        self._types: dict[str, str] = {}

    def published(self) -> dict[str, str]:
        """Type names of the topics that somebody publishes, by topic; one of several types is left
        out."""
        return {
            topic: types[0]
            for topic, types in self.get_topic_names_and_types()
            if len(types) == 1 and self.count_publishers(topic)
        }

    def listen(self, topic: str, type_name: str) -> bool:
        """Subscribe, if not done yet; False where the message's Python class is not installed.
        What is latched then comes, again for a topic that is forgotten and listened to anew."""
        if topic in self._subscriptions_of:
            return True
        try:
            kind = message_class(type_name)
        except (ImportError, AttributeError):
            return False
        offered = unique(
            profile_to_bag(info.qos_profile) for info in self.get_publishers_info_by_topic(topic)
        )
        self._subscriptions_of[topic] = self.create_subscription(
            kind, topic, lambda _: None, profile_to_record(offered), raw=True
        )
        self._types[topic] = type_name
        if is_latched(offered):
            self._latched.add(topic)
        return True

    def forget(self, topic: str) -> None:
        """Listen to it no longer."""
        self._latched.discard(topic)
        subscription = self._subscriptions_of.pop(topic, None)
        if subscription is not None:
            self.destroy_subscription(subscription)

    @property
    def heard(self) -> list[str]:
        """Topics listened to."""
        return list(self._subscriptions_of)

    def is_latched(self, topic: str) -> bool:
        """Whether what was published before is given to those who come later."""
        return topic in self._latched

    def take(self) -> list[Arrived]:
        """What has arrived, in the order of arrival."""
        found = [
            (said["received_timestamp"], Arrived(topic, self._types[topic], cdr))
            for topic, subscription in self._subscriptions_of.items()
            for cdr, said in waiting(subscription)
        ]
        return [arrived for _, arrived in sorted(found, key=itemgetter(0))]


def call_until_stopped(tasks: dict[Callable[[], None], float], pause_s: float) -> None:
    """Call each task every so many seconds, until SIGINT or SIGTERM."""
    stopping: list[int] = []
    uninstall_signal_handlers()  # those of rclpy shut the node down at once
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stopping.append(number))
    due_s = dict.fromkeys(tasks, 0.0)
    while not stopping:
        now_s = time.monotonic()
        for task, period_s in tasks.items():
            if now_s >= due_s[task]:
                due_s[task] = now_s + period_s
                task()
        time.sleep(pause_s)
