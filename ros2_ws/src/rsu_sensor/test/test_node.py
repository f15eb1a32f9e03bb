"""The RSU node: describes its RSUs, measures what it hears, refuses what is not a beacon."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from netpos.messages.values import Beacon
from netpos.scenario import Simulation, load_scenario
from netpos_node import CODEC, STREAM, wait_until_heard
from nodes import Kept
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rsu_sensor.node import RsuSensorNode
from rsu_sensor.parameters import hosted


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    yield
    rclpy.try_shutdown()


def _node(**parameters: Any) -> tuple[RsuSensorNode, Kept]:
    node = RsuSensorNode(
        parameter_overrides=[Parameter(n, value=v) for n, v in parameters.items()]
    )
    sink = Kept()
    node._measurement_pub = sink  # type: ignore[assignment]
    return node, sink


def _beacon_messages(name: str, seed: int | None = None) -> list[Any]:
    events = Simulation(load_scenario(name, seed=seed)).events()
    return [CODEC.beacon_to_msg(e) for e in events if isinstance(e, Beacon)]


def test_measurements_are_the_simulations_own_value_by_value(ros: None) -> None:
    node, sink = _node(scenario="intersection_turn", seed=5)
    simulation = Simulation(load_scenario("intersection_turn", seed=5))
    beacons = _beacon_messages("intersection_turn", 5)
    for message in beacons:
        node._on_beacon(message)
    expected = [m for b in beacons for m in simulation.measure(CODEC.beacon_from_msg(b))]
    assert len(expected) > len(beacons)
    assert [str(m) for m in sink.messages] == [str(CODEC.measurement_to_msg(m)) for m in expected]


def test_a_process_with_some_rsus_reports_those_only(ros: None) -> None:
    node, sink = _node(scenario="fast_pass", rsus=["rsu_2"])
    for message in _beacon_messages("fast_pass")[:5]:
        node._on_beacon(message)
    assert {m.rsu_id for m in sink.messages} == {"rsu_2"}
    assert {m.expected for m in sink.messages} == {2}  # of all processes together


def test_bad_beacons_are_counted_and_the_next_good_one_is_measured(ros: None) -> None:
    node, sink = _node(scenario="fast_pass")
    good, nan, stranger = _beacon_messages("fast_pass")[:3]
    nan.position.x = math.nan
    stranger.vue_id = "vue_7"
    node._on_beacon(nan)
    node._on_beacon(stranger)
    assert (node.refused, sink.messages) == (2, [])
    node._on_beacon(good)
    assert (node.refused, len(sink.messages)) == (2, 2)


def test_beacons_that_wait_when_the_node_is_stopped_are_measured(ros: None) -> None:
    node, sink = _node(scenario="fast_pass")
    beacons = _beacon_messages("fast_pass")[:5]
    publisher = node.create_publisher(type(beacons[0]), "/vue_1/beacon", STREAM)
    heard = {"beacon": publisher}
    assert not wait_until_heard(heard, {"beacon": 1}, 20.0, settle_s=0.0)
    for message in beacons:
        publisher.publish(message)
    assert publisher.wait_for_all_acked(Duration(seconds=20))
    node.finish()
    assert [m.sequence for m in sink.messages[::2]] == [b.sequence for b in beacons]


def test_unknown_rsus_are_refused_by_name(ros: None) -> None:
    with pytest.raises(
        ValueError, match="rsus names rsu_9, but scenario fast_pass has rsu_1, rsu_2"
    ):
        _node(scenario="fast_pass", rsus=["rsu_1", "rsu_9"])


def test_no_name_means_all() -> None:
    simulation = Simulation(load_scenario("fast_pass"))
    assert hosted(simulation, [""]) == {"rsu_1", "rsu_2"}
    assert hosted(simulation, ["rsu_1"]) == {"rsu_1"}
