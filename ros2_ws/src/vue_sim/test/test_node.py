"""The device node in one process with listeners: what it publishes, and what it refuses."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Thread
from typing import Any

import numpy as np
import pytest
import rclpy
from netpos.messages.values import Beacon, ImuSample
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.offline import timeline
from netpos.scenario.topics import device_topics
from netpos_node import CODEC, STREAM
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from vue_sim.conversions import publication, publications
from vue_sim.node import Pace, VueSimNode

RATE = 50.0


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    yield
    rclpy.try_shutdown()


def _node(**parameters: Any) -> VueSimNode:
    values = {"wait_for_subscribers_s": 0.0, **parameters}
    return VueSimNode(parameter_overrides=[Parameter(n, value=v) for n, v in values.items()])


def test_every_value_is_published_once_on_its_topic() -> None:
    scenario = load_scenario("intersection_turn", changes={"max_duration_s": 2.0})
    types = publications(scenario)
    counts = dict.fromkeys(types, 0)
    for item in timeline(Simulation(scenario)):
        topic, stamp_ns, message = publication(item)
        assert isinstance(message, types[topic])
        stamp = message.clock if topic == "/clock" else message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns
        counts[topic] += 1
    assert counts["/vue_1/imu"] == 200
    assert counts["/vue_1/beacon"] == counts["/vue_1/ground_truth"] == 21
    assert counts["/clock"] == 201


def test_beacon_survives_the_message_exactly() -> None:
    scenario = load_scenario("metis_madrid", changes={"max_duration_s": 1.0})
    for event in Simulation(scenario).events():
        if isinstance(event, Beacon):
            back = CODEC.beacon_from_msg(publication(event)[2])
            assert (back.position == event.position).all()
            assert back.clock_offset_s == event.clock_offset_s
            assert (back.stamp_ns, back.sequence) == (event.stamp_ns, event.sequence)


def test_only_what_the_scenario_has_gets_a_topic() -> None:
    names = {"devices.0.initial_pose_sd_m": "/vue_1/initialpose", "devices.0.imu": "/vue_1/imu"}
    for key, topic in names.items():
        assert topic not in device_topics(load_scenario("fast_pass", changes={key: None}))
    both = {"devices.0.initial_pose_sd_m": 1.0, "devices.0.imu": {}}
    assert set(names.values()) < set(device_topics(load_scenario("fast_pass", changes=both)))


def test_a_listener_hears_the_whole_scenario(ros: None) -> None:
    """All beacons arrive, in order and once."""
    node = _node(scenario="fast_pass_100hz", rate=RATE, wait_for_subscribers_s=20.0)
    listener = Node("listener")
    heard: list[int] = []
    listener.create_subscription(
        node._pubs["/vue_1/beacon"].msg_type,
        "/vue_1/beacon",
        lambda msg: heard.append(msg.sequence),
        STREAM,
    )
    executor = SingleThreadedExecutor()
    executor.add_node(listener)
    player = Thread(target=node.play)
    player.start()
    for _ in range(600):
        executor.spin_once(timeout_sec=0.2)
        if len(heard) == 501:
            break
    player.join()
    assert heard == list(range(501))


class Wall:
    """A wall clock that a test moves."""

    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        assert seconds > 0.0
        self.now_s += seconds


def test_simulated_time_stands_still_while_the_machine_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first value waits for nothing, and what a stall took is not caught up with."""
    wall, pace = Wall(), Pace(rate=2.0)
    monkeypatch.setattr("vue_sim.node.time", wall)
    due_s = []
    for simulated_s, busy_s in ((1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (4.0, 0.0), (5.0, 3.0)):
        wall.now_s += busy_s
        pace.wait(simulated_s)
        due_s.append(wall.now_s)
    pace.wait(6.0)
    np.testing.assert_allclose(due_s, [100.0, 100.5, 101.0, 101.5, 104.5])
    assert wall.now_s == pytest.approx(105.0)
    assert pace.lost_s == pytest.approx(2.5)
    for simulated_s in (6.0, 6.0):  # all of an instant at once
        pace.wait(simulated_s)
    assert wall.now_s == pytest.approx(105.0)


def test_a_short_delay_is_made_up_for(monkeypatch: pytest.MonkeyPatch) -> None:
    wall, pace = Wall(), Pace(rate=1.0)
    monkeypatch.setattr("vue_sim.node.time", wall)
    pace.wait(0.0)
    wall.now_s += 1.04
    pace.wait(1.0)
    pace.wait(2.0)
    assert wall.now_s == pytest.approx(102.0)
    assert pace.lost_s == 0.0


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"rate": 0.0}, "rate must be above 0"),
        ({"rate": float("nan")}, "rate must be above 0"),
        ({"clock_hz": -1.0}, "clock_hz must be above 0"),
        ({"wait_for_subscribers_s": -1.0}, "wait_for_subscribers_s"),
        ({"scenario": "absent"}, "no scenario 'absent'"),
        ({"seed": -2}, "seed: .*got -2"),
    ],
)
def test_bad_parameters(ros: None, parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _node(**parameters)


def test_imu_messages_carry_no_orientation() -> None:
    scenario = load_scenario("intersection_turn", changes={"max_duration_s": 0.1})
    sample = next(e for e in Simulation(scenario).events() if isinstance(e, ImuSample))
    message = publication(sample)[2]
    assert message.orientation_covariance[0] == -1.0
    assert message.linear_acceleration_covariance[0] > 0
