"""The node that puts faults between sensors and tracker."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from netpos.messages import topics
from netpos.messages.values import Field, Odometry, RsuInfo, RsuMeasurement
from netpos_bringup.faults import FaultNode
from netpos_msgs.msg import RsuInfo as RsuInfoMsg
from netpos_msgs.msg import RsuMeasurement as RsuMeasurementMsg
from netpos_node import CODEC
from nodes import Kept, nodes_of
from rclpy.serialization import deserialize_message, serialize_message

NS = 1_000_000_000


@pytest.fixture
def make() -> Iterator[Any]:
    with nodes_of(FaultNode, 63) as node:
        yield node


class Relay:
    """A node whose clock the test sets, and what it publishes."""

    def __init__(self, node: FaultNode) -> None:
        self.node, self.at_ns = node, 10 * NS
        node.now_ns = lambda: self.at_ns  # type: ignore[method-assign]
        self.kept = {topic: Kept() for topic in node._pubs}
        node._pubs = dict(self.kept)

    def info(self, name: str) -> None:
        value = RsuInfo(rsu_id=name, position=np.array([1.0, 2.0, 3.0]))
        cdr = serialize_message(CODEC.rsu_info_to_msg(value))
        back = CODEC.rsu_info_from_msg(deserialize_message(cdr, RsuInfoMsg))
        self.node.take(topics.RSU_INFO, cdr, back)

    def measured(self, name: str, range_m: float) -> bytes:
        value = RsuMeasurement(
            stamp_ns=self.at_ns,
            rsu_id=name,
            vue_id="vue_1",
            fields=Field.RANGE,
            range_m=range_m,
            range_var=0.25,
        )
        cdr = bytes(serialize_message(CODEC.measurement_to_msg(value)))
        self.node.take(topics.RSU_MEASUREMENTS, cdr, value)
        return cdr

    @property
    def measurements(self) -> list[Any]:
        return self.kept[topics.RSU_MEASUREMENTS].messages


def ranges(messages: list[Any]) -> list[float]:
    read = [
        deserialize_message(m, RsuMeasurementMsg) if isinstance(m, bytes) else m for m in messages
    ]
    return [m.range for m in read]


def test_what_the_fault_does_not_touch_passes_byte_for_byte(make: Any) -> None:
    relay = Relay(make(fault="bias", size=4.0, rsus="a", start_s=1.0, lasts_s=2.0))
    relay.info("a")
    relay.info("b")
    sent = [relay.measured("a", 10.0)]
    relay.at_ns += NS
    spoilt = relay.measured("a", 20.0)
    sent.append(relay.measured("b", 30.0))
    relay.at_ns += 2 * NS
    sent.append(relay.measured("a", 40.0))
    assert ranges(relay.measurements) == [10.0, 22.0, 30.0, 40.0]
    assert [m for m in relay.measurements if isinstance(m, bytes)] == sent
    assert spoilt not in relay.measurements
    assert len(relay.kept[topics.RSU_INFO].messages) == 2


def test_what_is_delayed_comes_when_it_is_due_and_nothing_is_lost_at_the_end(make: Any) -> None:
    node = make(fault="delay", size=0.5, start_s=0.0, lasts_s=60.0)
    relay = Relay(node)
    relay.info("a")
    relay.measured("a", 10.0)
    relay.at_ns += NS // 2 - 1
    node.publish_due()
    assert relay.measurements == []
    relay.at_ns += 1
    node.publish_due()
    assert ranges(relay.measurements) == [10.0]
    relay.measured("a", 20.0)
    node.finish()
    assert ranges(relay.measurements) == [10.0, 20.0]


def test_false_descriptions_come_by_themselves(make: Any) -> None:
    node = make(fault="spoofed_info", size=30.0, rsus="a", start_s=1.0, lasts_s=2.0)
    relay = Relay(node)
    relay.info("a")
    relay.measured("a", 10.0)
    places = []
    for _ in range(3):
        node.publish_due()
        told = relay.kept[topics.RSU_INFO].messages
        last = deserialize_message(told[-1], RsuInfoMsg) if len(told) == 1 else told[-1]
        places.append(last.pose.position.x)
        relay.at_ns += 3 * NS // 2
    assert places == [1.0, 31.0, 1.0]


def test_a_lie_about_the_device_follows_the_truth_that_is_heard(make: Any) -> None:
    relay = Relay(make(fault="colluding", size=10.0, rsus="a", start_s=0.0))
    relay.info("a")
    pose = Odometry(
        stamp_ns=relay.at_ns,
        vue_id="vue_1",
        position=np.array([1.0, 8.0, 3.0]),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.zeros(3),
    )
    relay.node._truth.add(pose)
    relay.measured("a", 6.0)
    moved = np.array([0.0, 6.0]) + 10.0 / np.sqrt(2.0)  # from the RSU
    assert ranges(relay.measurements) == pytest.approx([float(np.hypot(*moved))])


@pytest.mark.parametrize("name", ["tracker_crash", "bais"])
def test_what_cannot_be_done_live_is_refused(make: Any, name: str) -> None:
    with pytest.raises(ValueError, match=r"of a running graph.*known: drop"):
        make(fault=name)
