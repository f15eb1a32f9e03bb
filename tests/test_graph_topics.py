"""What a running graph offers: topics, types, QoS, frames, rates, services, diagnostics, TF."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from graph import LATCHED, Collector, Graph, Process, wait_until
from nav_msgs.msg import Odometry
from netpos.messages.fields import stamp_ns
from netpos.messages.policy import ENCLAVES, allows
from netpos_msgs.msg import Beacon, ClockState, RsuInfo, RsuMeasurement, TrackStatus
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from runs import changed_scenario, graphs, stamps
from sensor_msgs.msg import Imu, MagneticField
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

NS = 1_000_000_000
RATE = 3.0
DURATION_S = 15.0
BEACON_INTERVAL_NS = 83_650_000
TOPICS: dict[str, tuple[type[Any], str]] = {
    "/clock": (Clock, "vue_sim"),
    "/rsu/info": (RsuInfo, "rsu_sensor"),
    "/rsu/measurements": (RsuMeasurement, "rsu_sensor"),
    "/vue_1/beacon": (Beacon, "vue_sim"),
    "/vue_1/ground_truth": (Odometry, "vue_sim"),
    "/vue_1/ground_truth_clock": (ClockState, "vue_sim"),
    "/vue_1/imu": (Imu, "vue_sim"),
    "/vue_1/mag": (MagneticField, "vue_sim"),
    "/vue_1/initialpose": (PoseWithCovarianceStamped, "vue_sim"),
    "/vue_1/odometry": (Odometry, "ekf_tracker"),
    "/vue_1/clock_state": (ClockState, "ekf_tracker"),
    "/vue_1/track_status": (TrackStatus, "ekf_tracker"),
    "/diagnostics": (DiagnosticArray, "ekf_tracker"),
    "/tf": (TFMessage, "ekf_tracker"),
}

NODES = ("vue_sim", "rsu_sensor", "ekf_tracker")


@dataclass
class Run:
    """A finished run of a short METIS with IMU and magnetometer; the tracker still runs."""

    graph: Graph
    tracker: Process
    heard: dict[str, Collector]
    offered: dict[str, list[Any]] = field(default_factory=dict)
    clock: list[tuple[float, int]] = field(default_factory=list)  # (wall s, stamp ns)
    used: dict[str, tuple[set[str], set[str], set[str]]] = field(default_factory=dict)
    """By node: topics published, topics heard, services."""

    def messages(self, topic: str) -> list[Any]:
        return list(self.heard[topic].messages)


def _used(graph: Graph, node: str) -> tuple[set[str], set[str], set[str]]:
    asked = (
        graph.node.get_publisher_names_and_types_by_node,
        graph.node.get_subscriber_names_and_types_by_node,
        graph.node.get_service_names_and_types_by_node,
    )
    published, heard, served = ({name for name, _ in ask(node, "/")} for ask in asked)
    return published, heard, served


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("topics")
    device: dict[str, Any] = {"imu": {"rate_hz": 100.0}, "magnetometer": {"rate_hz": 50.0}}
    device["route"] = {"kind": "metis_random", "corner_radius_m": 3.0}
    path = folder / "metis_short.yaml"
    changed_scenario(path, "metis_madrid", device, max_duration_s=DURATION_S)
    scenario = {"scenario": str(path)}
    with graphs(folder) as (graph,):
        heard = {
            topic: graph.collect(topic, kind, *([LATCHED] if topic == "/rsu/info" else []))
            for topic, (kind, _) in TOPICS.items()
        }
        tracker = graph.run("ekf_tracker", "ekf_tracker", parameters=scenario | {"subscribers": 1})
        graph.run("rsu_sensor", "rsu_sensor", parameters=scenario | {"subscribers": 2})
        graph.wait_for_nodes("ekf_tracker", "rsu_sensor")
        made = Run(graph, tracker, heard)
        graph.node.create_subscription(
            Clock,
            "/clock",
            lambda m: made.clock.append((time.monotonic(), stamp_ns(m.clock))),
            1000,
        )
        simulator = graph.run(
            "vue_sim", "vue_sim", parameters=scenario | {"rate": RATE, "subscribers": 2}
        )
        heard["/vue_1/odometry"].wait_for(1, 90.0)
        made.used = {node: _used(graph, node) for node in NODES}
        made.offered = {t: graph.node.get_publishers_info_by_topic(t) for t in TOPICS}
        assert simulator.wait() == 0, simulator.describe()
        last = len(made.messages("/vue_1/beacon"))
        heard["/vue_1/odometry"].wait_for(last)
        heard["/tf"].wait_for(last)
        yield made


@pytest.mark.parametrize("topic", TOPICS)
def test_topic_type_and_publisher(run: Run, topic: str) -> None:
    kind, node = TOPICS[topic]
    (offer,) = run.offered[topic]
    assert offer.node_name == node
    assert offer.topic_type == f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
    assert offer.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    latched = offer.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert latched is (topic in ("/rsu/info", "/vue_1/initialpose"))
    assert run.heard[topic].messages


@pytest.mark.parametrize("node", NODES)
def test_the_security_policy_permits_what_a_node_does(run: Run, node: str) -> None:
    (rights,) = [r for r in ENCLAVES.values() if fnmatchcase(node, r.node)]
    published, heard, served = run.used[node]
    assert len(published) > 2
    assert served
    assert [name for name in published if not allows(rights.published, name)] == []
    assert [name for name in heard if not allows(rights.subscribed, name)] == []
    assert [name for name in served if not allows(rights.replied, name)] == []


def test_a_late_listener_learns_every_rsu(run: Run) -> None:
    late = run.graph.collect("/rsu/info", RsuInfo, LATCHED)
    names = {info.rsu_id for info in late.wait_for(100)}
    assert names == {info.rsu_id for info in run.messages("/rsu/info")}
    assert len(names) == 100
    assert {info.header.frame_id for info in late.messages} == {"map"}


def test_frames(run: Run) -> None:
    wanted = {
        "/rsu/measurements": "map",
        "/vue_1/beacon": "map",
        "/vue_1/ground_truth": "map",
        "/vue_1/odometry": "map",
        "/vue_1/initialpose": "map",
        "/vue_1/imu": "vue_1/base_link",
        "/vue_1/mag": "vue_1/base_link",
        "/vue_1/clock_state": "vue_1/base_link",
        "/vue_1/ground_truth_clock": "vue_1/base_link",
        "/vue_1/track_status": "vue_1/base_link",
    }
    for topic, frame in wanted.items():
        assert {m.header.frame_id for m in run.messages(topic)} == {frame}, topic
    for topic in ("/vue_1/odometry", "/vue_1/ground_truth"):
        assert {m.child_frame_id for m in run.messages(topic)} == {"vue_1/base_link"}


@pytest.mark.parametrize(
    ("topic", "interval_ns"),
    [
        ("/vue_1/beacon", BEACON_INTERVAL_NS),
        ("/vue_1/ground_truth", BEACON_INTERVAL_NS),
        ("/vue_1/odometry", BEACON_INTERVAL_NS),
        ("/vue_1/imu", NS // 100),
        ("/vue_1/mag", NS // 50),
    ],
)
def test_stamps_are_evenly_spaced_and_complete(run: Run, topic: str, interval_ns: int) -> None:
    times = stamps(run.messages(topic))
    assert set(np.diff(times)) == {interval_ns}
    count = DURATION_S * NS / interval_ns
    assert abs(len(times) - count) <= 1
    assert min(times) >= NS  # scenario time starts at 1 s, so that no stamp is 0


def test_two_measurements_of_each_beacon(run: Run) -> None:
    beacons = {b.sequence: stamp_ns(b.header.stamp) for b in run.messages("/vue_1/beacon")}
    per_beacon: dict[int, list[Any]] = {sequence: [] for sequence in beacons}
    for measured in run.messages("/rsu/measurements"):
        assert stamp_ns(measured.header.stamp) == beacons[measured.sequence]
        assert measured.fields == RsuMeasurement.AZIMUTH | RsuMeasurement.TOA
        per_beacon[measured.sequence].append(measured)
    for group in per_beacon.values():
        assert len({m.rsu_id for m in group}) == len(group) == 2
        assert {m.expected for m in group} == {2}


def test_clock_is_monotone_at_the_chosen_rate(run: Run) -> None:
    walls, times = np.array(run.clock).T
    assert (np.diff(times) > 0).all()
    assert np.diff(times).max() <= NS / 100 + 1
    simulated_s = (times[-1] - times[0]) / NS
    assert simulated_s == pytest.approx(DURATION_S, abs=0.2)
    # a stall is not made up for, so a machine may only be too slow
    factor = simulated_s / (walls[-1] - walls[0])
    assert 0.5 * RATE < factor < 1.15 * RATE


def test_twist_is_in_the_body_frame(run: Run) -> None:
    """The vehicle drives forward at 15 km/h whatever its heading: x is the speed, y is 0."""
    for truth in run.messages("/vue_1/ground_truth"):
        assert truth.twist.twist.linear.x == pytest.approx(15 / 3.6, rel=1e-6)
        assert truth.twist.twist.linear.y == pytest.approx(0.0, abs=1e-6)
    for odometry in run.messages("/vue_1/odometry")[40:]:
        assert odometry.twist.twist.linear.x > 2.0
        assert abs(odometry.twist.twist.linear.y) < 1.5


def test_transforms_are_the_odometry(run: Run) -> None:
    transforms = [t for message in run.messages("/tf") for t in message.transforms]
    odometries = run.messages("/vue_1/odometry")
    assert len(transforms) == len(odometries)
    for moved, odometry in zip(transforms, odometries, strict=True):
        assert moved.header == odometry.header
        assert moved.child_frame_id == "vue_1/base_link"
        position, rotation = odometry.pose.pose.position, odometry.pose.pose.orientation
        offset = moved.transform.translation
        assert (offset.x, offset.y, offset.z) == (position.x, position.y, position.z)
        assert moved.transform.rotation == rotation


def test_diagnostics_say_how_the_track_is(run: Run) -> None:
    def current() -> Any:
        latest = run.messages("/diagnostics")[-1]
        last = run.messages("/vue_1/track_status")[-1]
        return latest if latest.header.stamp == last.header.stamp else None

    by_name = {s.name: s for s in wait_until(current, "diagnostics of the last epoch").status}
    device = by_name["ekf_tracker: vue_1"]
    assert device.level == DiagnosticStatus.OK
    assert device.message == "tracking"
    assert device.hardware_id == "vue_1"
    values = {pair.key: pair.value for pair in device.values}
    last = run.messages("/vue_1/track_status")[-1]
    assert values["accepted"] == str(last.accepted)
    assert float(values["position_sd_m"]) == pytest.approx(last.position_sd, abs=1e-3)
    assert math.isfinite(float(values["nis"]))
    assert by_name["ekf_tracker: rsus"].message == "100 RSUs known"


def test_services_reset_and_enable(run: Run) -> None:
    """Last of all: it changes the tracker. Reset forgets the track; disabled refuses."""
    measurements = run.graph.publisher("/rsu/measurements", RsuMeasurement)
    status = run.heard["/vue_1/track_status"]
    wait_until(lambda: measurements.get_subscription_count() >= 2, "the tracker to listen")
    first, second = [m for m in run.messages("/rsu/measurements") if m.sequence == 0]

    def send_again() -> Any:
        seen = len(status.messages)
        measurements.publish(first)
        measurements.publish(second)
        return status.wait_for(seen + 1)[-1]

    def refused(last: Any) -> dict[str, int]:
        return dict(zip(last.rejection_reasons, last.rejection_counts, strict=True))

    before = status.messages[-1]
    assert run.graph.call(Trigger, "/ekf_tracker/reset", Trigger.Request()).success
    last = send_again()  # of the start of the run: late, had the reset not happened
    assert "late" not in refused(last)
    assert last.header.stamp == first.header.stamp != before.header.stamp
    assert last.accepted >= before.accepted > 0  # counts go on

    answer = run.graph.call(SetBool, "/ekf_tracker/enable", SetBool.Request(data=False))
    assert answer.success
    assert "refused" in answer.message
    measurements.publish(first)
    run.tracker.wait_for_output("refused a RsuMeasurement: disabled")
    assert run.graph.call(SetBool, "/ekf_tracker/enable", SetBool.Request(data=True)).success
    assert run.graph.call(Trigger, "/ekf_tracker/reset", Trigger.Request()).success
    assert refused(send_again())["disabled"] == 1
