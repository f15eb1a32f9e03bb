"""A simulated person through running nodes: steps against the truth, bad input told once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TwistWithCovarianceStamped
from graph import Graph, wait_until
from netpos.bags import BagReader, BagWriter, codec
from netpos.messages.fields import stamp_ns
from netpos.messages.values import ImuSample
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos_msgs.msg import Step
from runs import (
    PATIENT,
    TRACK_STATUS,
    changed_scenario,
    finish,
    graphs,
    is_of_measurements,
    messages,
    netpos,
    script,
)

RATE = 4


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> str:
    """One lap of ``pedestrian_walk``."""
    route = {
        "kind": "rectangle",
        "width_m": 5.7,
        "height_m": 4.5,
        "pauses_s": [2.0, 0.7, 0.7, 0.7, 1.5],
    }
    path = tmp_path_factory.mktemp("walk") / "lap.yaml"
    return str(
        changed_scenario(
            path, "pedestrian_walk", {"route": route}, tracker=PATIENT | {"history_s": 10.0}
        )
    )


@pytest.fixture(scope="module")
def walked(scenario: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Messages of vue_sim and pdr_node alone."""
    with graphs(tmp_path_factory.mktemp("walk_live")) as (graph,):
        steps = graph.collect("/vue_1/step", Step)
        velocities = graph.collect("/vue_1/step_velocity", TwistWithCovarianceStamped)
        node = graph.run("pdr_node", "pdr_node", parameters={"scenario": scenario})
        for topic in ("/vue_1/step", "/vue_1/step_velocity"):
            graph.wait_for_publishers(topic)
        device = graph.run(
            "vue_sim",
            "vue_sim",
            parameters={
                "scenario": scenario,
                "rate": float(RATE),
                "subscribers": 1,
                "wait_for_subscribers_s": 5.0,  # nobody takes the beacons here
            },
        )
        assert device.wait(120.0) == 0, device.describe()
        end_ns = round((load_scenario(scenario).duration_s + 0.85) * 1e9)
        wait_until(
            lambda: (
                velocities.messages and stamp_ns(velocities.messages[-1].header.stamp) >= end_ns
            ),
            "the last step velocity",
        )
        yield {"steps": steps.messages, "velocities": velocities.messages, "log": node.output}


def test_every_true_contact_has_its_step_and_nothing_else_is_one(
    walked: dict[str, Any], scenario: str
) -> None:
    loaded = load_scenario(scenario)
    gait = loaded.devices[0].motion(loaded.seed, "vue_1")
    ends = np.array([stamp_ns(s.end) for s in walked["steps"]]) * 1e-9 - loaded.start_s
    assert len(ends) == gait.contact_s.size == 32  # type: ignore[attr-defined]
    np.testing.assert_allclose(ends, gait.contact_s, atol=0.1)  # type: ignore[attr-defined]
    assert [s.count for s in walked["steps"]] == list(range(1, 33))
    starts = np.array([stamp_ns(s.start) for s in walked["steps"]]) * 1e-9 - loaded.start_s
    assert (starts < ends).all()
    assert {s.header.frame_id for s in walked["steps"]} == {"map"}


def test_live_and_offline_dead_reckoning_are_the_same_to_the_last_bit(
    walked: dict[str, Any], scenario: str, tmp_path: Path
) -> None:
    simulate_to_bag(load_scenario(scenario), tmp_path / "bag")
    with BagReader(tmp_path / "bag") as bag:
        steps = [e.message for e in bag.messages(["/vue_1/step"])]
        velocities = [e.message for e in bag.messages(["/vue_1/step_velocity"])]
    for live, offline in (
        (walked["steps"], steps),
        (walked["velocities"], velocities),
    ):
        assert len(live) == len(offline)
    for a, b in zip(walked["steps"], steps, strict=True):
        assert (a.length, a.heading, a.heading_var) == (b.length, b.heading, b.heading_var)
    for a, b in zip(walked["velocities"], velocities, strict=True):
        assert stamp_ns(a.header.stamp) == stamp_ns(b.header.stamp)
        assert (a.twist.twist.linear.x, a.twist.twist.linear.y) == (
            b.twist.twist.linear.x,
            b.twist.twist.linear.y,
        )
        np.testing.assert_array_equal(a.twist.covariance, b.twist.covariance)


def test_a_good_walk_has_nothing_to_tell(walked: dict[str, Any]) -> None:
    assert "WARN" not in walked["log"]


def swapped_bag(path: Path, scenario: str) -> None:
    """The walk with the IMU's axes rolled by one and no magnetometer."""
    make = codec()
    with BagWriter(path) as bag:
        for sample in Simulation(load_scenario(scenario)).imu("vue_1"):
            swapped = ImuSample(
                stamp_ns=sample.stamp_ns,
                vue_id="vue_1",
                angular_velocity=np.roll(sample.angular_velocity, 1),
                specific_force=np.roll(sample.specific_force, 1),
            )
            bag.write("/vue_1/imu", make.imu_to_msg(swapped), sample.stamp_ns)


def test_swapped_axes_and_no_magnetometer_are_told_once_by_the_running_node(
    scenario: str, graph: Graph, tmp_path: Path
) -> None:
    """Steps are still counted; no velocity claims a direction."""
    swapped_bag(tmp_path / "swapped", scenario)
    steps = graph.collect("/vue_1/step", Step)
    velocities = graph.collect("/vue_1/step_velocity", TwistWithCovarianceStamped)
    node = graph.run("pdr_node", "pdr_node", parameters={"placement": "waist"})
    graph.wait_for_publishers("/vue_1/step")
    player = graph.run(
        *("netpos_bag", "play", str(tmp_path / "swapped"), "--rate", "10"),
        *("--wait-timeout", "60", "--wait-for-subscribers", "/vue_1/imu"),
    )
    assert player.wait(120.0) == 0, player.describe()
    wait_until(lambda: len(steps.messages) >= 32, "the last step")
    assert node.interrupt() == 0, node.describe()
    assert len(steps.messages) == 32
    assert node.output.count("gravity points along +x of the device") == 1
    assert node.output.count("no magnetic field is heard") == 1
    assert node.output.count("WARN") == 2
    assert all(v.twist.twist.linear.x == 0.0 for v in velocities.messages[15:])


def test_the_run_script_dead_reckons_who_walks(
    scenario: str, graph: Graph, tmp_path: Path
) -> None:
    """run_graph.sh starts a pdr_node; the tracker fuses its velocities and says what it learned of
    the person: the same to the last bit as offline, and in a replay of that. A velocity heard
    before the tracker waits for velocities is late at most, and goes through the history."""
    bag_path = tmp_path / "run"
    started = script(graph, "run_graph", scenario, bag_path, str(RATE))
    finish(started)
    netpos("run", scenario, "--offline", "--bag", tmp_path / "offline")
    with BagReader(bag_path) as bag:
        steps = [e.message for e in bag.messages(["/vue_1/step"])]
    assert len(steps) == 32
    fused = [s for s in messages(bag_path, TRACK_STATUS) if "step_velocity" in s.sources]
    assert len(fused) > 200
    learned = steps_learned(bag_path)
    assert 0.8 < learned[0] < 1.2
    assert 0.0 < learned[1] < 0.09  # 0.1 at the start
    assert 0.0 < learned[3] < 0.05
    offline = steps_learned(tmp_path / "offline")
    assert learned == offline
    netpos("replay", tmp_path / "offline", "--out", tmp_path / "again")
    assert steps_learned(tmp_path / "again") == offline


def steps_learned(bag: Path) -> tuple[float, ...]:
    """Length factor, heading offset and their sds as last said of measurements."""
    statuses = filter(is_of_measurements, messages(bag, TRACK_STATUS))
    said = {stamp_ns(s.header.stamp): s for s in statuses}
    last = said[max(said)]
    return (
        *(last.step_length_factor, last.step_length_factor_sd),
        *(last.step_heading_offset, last.step_heading_offset_sd),
    )
