"""Real waist and phone recordings, imported, played and stepped by the running pdr_node."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from geometry_msgs.msg import TwistWithCovarianceStamped
from graph import Graph
from netpos.bags.importers.imu import import_imu
from netpos.inertial.loaders import load_steps_phone, load_waist_imu
from netpos_msgs.msg import Step


def play(
    graph: Graph, bag: Path, rate: int, placement: str
) -> tuple[list[Step], list[TwistWithCovarianceStamped]]:
    """Steps and step velocities of a bag played into a running pdr_node."""
    steps = graph.collect("/vue_1/step", Step)
    velocities = graph.collect("/vue_1/step_velocity", TwistWithCovarianceStamped)
    node = graph.run("pdr_node", "pdr_node", parameters={"placement": placement})
    graph.wait_for_nodes("pdr_node")
    graph.wait_for_publishers("/vue_1/step_velocity")
    wanted = ("--wait-for-subscribers", "/vue_1/imu", "--wait-timeout", "30")
    player = graph.run("netpos_bag", "play", str(bag), "--rate", str(rate), *wanted)
    assert player.wait(120.0) == 0, player.describe()
    assert node.interrupt(60.0) == 0, node.describe()  # having taken all that was waiting
    return steps.messages, velocities.messages


@pytest.mark.parametrize(("name", "total"), [("user2_hand", 340)])
def test_steps_of_a_phone(
    graph: Graph, data_folder: Path, tmp_path: Path, name: str, total: int
) -> None:
    """The true count within 1 %; without a magnetometer nothing claims to be in the map."""
    recording = data_folder / "steps_phone" / f"{name}.csv"
    assert load_steps_phone(recording).true_step_ns.size == total
    import_imu(recording, tmp_path / "bag", recording_format="steps-phone")
    steps, velocities = play(graph, tmp_path / "bag", 25, "carried")
    assert abs(steps[-1].count - total) <= 0.01 * total
    assert [s.count for s in steps] == list(range(1, len(steps) + 1))
    assert {v.header.frame_id for v in velocities} == {"vue_1/pdr_start"}


def test_waist_recording(graph: Graph, data_folder: Path, tmp_path: Path) -> None:
    """Slow, hard gait: reference contacts are found, velocities have a covariance and a frame."""
    recording = data_folder / "waist_imu" / "HA_001" / "data.mat"
    import_imu(recording, tmp_path / "bag", recording_format="waist-imu")
    steps, velocities = play(graph, tmp_path / "bag", 20, "waist")
    ends = [s.end.sec + s.end.nanosec * 1e-9 - 1.0 for s in steps]  # the bag starts at 1 s
    contacts = [
        c * 1e-9 for bout in load_waist_imu(recording).bouts for c in bout.initial_contact_ns
    ]
    found = sum(any(abs(e - c) <= 0.15 for e in ends) for c in contacts)
    assert found >= 0.95 * len(contacts)
    assert {v.header.frame_id for v in velocities} <= {"map", "vue_1/pdr_start"}
    for v in velocities:
        assert math.isfinite(v.twist.twist.linear.x)
        assert v.twist.covariance[0] > 0.0
        assert v.twist.covariance[7] > 0.0
