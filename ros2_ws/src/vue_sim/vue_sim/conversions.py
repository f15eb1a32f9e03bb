"""Simulated values to messages."""

from __future__ import annotations

from typing import Any

from netpos.messages.topics import CLOCK
from netpos.scenario import Scenario
from netpos.scenario.topics import Value, device_topics, to_message, topic_of
from netpos_node import CODEC, message_class


def publications(scenario: Scenario) -> dict[str, Any]:
    """Message class by topic of everything the node publishes."""
    types = {CLOCK: "rosgraph_msgs/msg/Clock", **device_topics(scenario)}
    return {topic: message_class(type_name) for topic, type_name in types.items()}


def publication(item: Value | int) -> tuple[str, int, Any]:
    """Topic, stamp [ns] and message of a simulated value or of a clock tick [ns]."""
    if isinstance(item, int):
        return CLOCK, item, CODEC.clock_to_msg(item)
    return topic_of(item), item.stamp_ns, to_message(CODEC, item)
