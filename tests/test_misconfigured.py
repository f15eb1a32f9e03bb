"""A network that is set up wrongly: the running graph says what is wrong, and where."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graph import LATCHED, Collector, Graph, wait_until
from nav_msgs.msg import Odometry
from netpos.messages import topics
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos_msgs.msg import RsuInfo as RsuInfoMessage
from netpos_msgs.msg import RsuMeasurement as RsuMeasurementMessage
from netpos_msgs.msg import TrackStatus
from netpos_node import CODEC
from rclpy.qos import QoSProfile, ReliabilityPolicy
from runs import INFOS, MEASUREMENTS, graphs

S = 1_000_000_000
T0 = 1_700_000_000 * S
SITES = {"a": (0.0, 0.0), "b": (40.0, 0.0), "c": (0.0, 40.0), "d": (40.0, 40.0)}
PLACE = np.array([12.0, 9.0, 0.0])
SENSOR = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
VOLATILE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "variance": ({"range_var": 0.0}, "variance: range_var is 0 m^2; send one from 1e-12"),
    "stamp": ({"stamp_ns": 0}, "zero_stamp: header.stamp is 0; set it to the time of emission"),
    "not_a_number": ({"range_m": float("nan")}, "not_finite: range_m is nan m; leave out"),
    "field": ({"fields": Field(0)}, "no_fields: fields is 0; set the bits"),
    "stranger": ({"rsu_id": "r9"}, "unknown_rsu: no RsuInfo of it is known; publish it on"),
    "refused": ({"rsu_id": "bad"}, "unknown_rsu: its RsuInfo was refused: bias sd of bad must"),
    "millimetres": ({"range_m": 2e4}, "contradict each other by"),
}


def info(name: str, **change: Any) -> RsuInfo:
    return RsuInfo(rsu_id=name, position=np.array([*SITES.get(name, (5.0, 5.0)), 0.0]), **change)


def epoch(vue_id: str, at_s: float, **change: Any) -> list[RsuMeasurement]:
    found = []
    for name in SITES:
        distance = float(np.linalg.norm(PLACE - info(name).position))
        measurement = RsuMeasurement(
            stamp_ns=T0 + round(at_s * S),
            rsu_id=name,
            vue_id=vue_id,
            fields=Field.RANGE,
            range_m=distance,
            range_var=0.01,
            expected=len(SITES),
        )
        found.append(replace(measurement, **change))
    return found


class Network:
    """Publishers of RSUs, and what a tracker says."""

    def __init__(
        self, graph: Graph, *, infos: QoSProfile = LATCHED, qos: QoSProfile = VOLATILE
    ) -> None:
        self.graph = graph
        self.diagnostics = graph.collect(topics.DIAGNOSTICS, DiagnosticArray)
        self.infos = graph.publisher(INFOS, RsuInfoMessage, infos)
        self.measurements = graph.publisher(MEASUREMENTS, RsuMeasurementMessage, qos)

    def describe(self, *names: str) -> None:
        for name in names or SITES:
            self.infos.publish(CODEC.rsu_info_to_msg(info(name)))

    def send(self, measurements: list[RsuMeasurement]) -> None:
        for measurement in measurements:
            self.measurements.publish(CODEC.measurement_to_msg(measurement))

    def said(self, subject: str) -> Any | None:
        """The newest line about a device or an RSU."""
        arrays = list(self.diagnostics.messages)
        lines = [s for array in arrays[-1:] for s in array.status]
        return next((s for s in lines if s.name == f"ekf_tracker: {subject}"), None)

    def wait_for(self, subject: str, words: str, level: bytes) -> Any:
        """A line with these words and this level."""

        def found() -> bool:
            line = self.said(subject)
            return line is not None and words in line.message and line.level == level

        wait_until(found, f"{subject}: {words}; last: {self.said(subject)}", 30.0)
        return self.said(subject)


@pytest.fixture(name="graph")
def _graph(tmp_path: Path) -> Iterator[Graph]:
    with graphs(tmp_path) as (graph,):
        yield graph


def start(graph: Graph, **parameters: Any) -> Any:
    tracker = graph.run("ekf_tracker", "ekf_tracker", parameters=parameters)
    tracker.wait_for_output("tracking ")
    return tracker


def test_everything_refused_is_an_error_with_its_remedy(graph: Graph) -> None:
    network = Network(graph)
    status = {v: graph.collect(topics.of_vue(v, "track_status"), TrackStatus) for v in FAULTS}
    tracker = start(graph, vues=list(FAULTS))
    graph.wait_for_subscribers(MEASUREMENTS)
    network.infos.publish(CODEC.rsu_info_to_msg(info("bad", range_bias_sd_m=-1.0)))
    network.wait_for(
        "rsus", "0 RSUs known; RsuInfo of bad refused: bias sd of bad", DiagnosticStatus.ERROR
    )
    network.describe()
    network.wait_for("rsus", "4 RSUs known; RsuInfo of bad refused", DiagnosticStatus.WARN)
    for k in range(20):
        for vue, (change, _) in FAULTS.items():
            network.send(epoch(vue, 0.1 * k, **change))
        network.send(epoch("well", 0.1 * k))
    for vue, (_, words) in FAULTS.items():
        level = DiagnosticStatus.WARN if vue == "millimetres" else DiagnosticStatus.ERROR
        network.wait_for(vue, words, level)
        first = status[vue].wait_for(1)[0]
        assert first.state == TrackStatus.WAITING
        assert words in status[vue].messages[-1].reason
    network.wait_for("well", "tracking", DiagnosticStatus.OK)
    network.wait_for("rsu r9", "all refused: unknown_rsu", DiagnosticStatus.ERROR)
    network.wait_for("rsu bad", "RsuInfo refused: bias sd of bad", DiagnosticStatus.ERROR)
    assert "refused" in network.said("rsu a").message
    assert network.said("rsu a").level == DiagnosticStatus.WARN
    for k in range(20, 40):
        network.send(epoch("variance", 0.1 * k))
    network.wait_for("variance", "tracking", DiagnosticStatus.OK)
    assert tracker.running


def wait_for_odometry(network: Network, odometry: Collector) -> None:
    """Send until something comes back: discovery takes its time."""
    end_s, k = time.monotonic() + 30.0, 0
    while not odometry.messages and time.monotonic() < end_s:
        network.describe()
        network.send(epoch("vue_1", 0.1 * k))
        k += 1
        time.sleep(0.1)
    assert odometry.messages


def test_best_effort_and_volatile_publishers_are_heard(graph: Graph) -> None:
    network = Network(graph, infos=VOLATILE, qos=SENSOR)
    odometry = graph.collect(topics.of_vue("vue_1", "odometry"), Odometry)
    start(graph)
    wait_for_odometry(network, odometry)
    words = "4 RSUs known; /rsu/info: best effort or volatile"
    line = network.wait_for("rsus", words, DiagnosticStatus.WARN)
    assert "/rsu/measurements: best effort or volatile" in line.message


def test_a_second_graph_is_noticed(graph: Graph) -> None:
    network = Network(graph)
    start(graph)
    start(graph)
    network.wait_for(
        "rsus", "another node publishes /vue_1/odometry too: stop it", DiagnosticStatus.WARN
    )


def test_an_rsu_with_another_time_is_named_and_the_track_goes_on(graph: Graph) -> None:
    network = Network(graph)
    odometry = graph.collect(topics.of_vue("vue_1", "odometry"), Odometry)
    start(graph)
    graph.wait_for_subscribers(MEASUREMENTS)
    network.describe()
    network.wait_for("rsus", "4 RSUs known", DiagnosticStatus.OK)
    for k in range(60):
        measured = epoch("vue_1", 0.1 * k)
        if k >= 20:
            wrong = replace(measured[1], stamp_ns=measured[1].stamp_ns + 37 * S)
            measured = [measured[0], wrong, *measured[2:]]
        network.send(measured)
        time.sleep(0.02)
    network.wait_for("rsu b", "clock 37.0 s ahead of three others", DiagnosticStatus.ERROR)
    for name in "acd":
        assert network.said(f"rsu {name}").message == "ok"
    last = odometry.messages[-1]
    assert last.header.stamp.sec - T0 // S == 5
    east, north = last.pose.pose.position.x, last.pose.pose.position.y
    assert np.hypot(east - PLACE[0], north - PLACE[1]) < 0.3


def test_a_device_that_nobody_hears_is_coasting(graph: Graph) -> None:
    network = Network(graph)
    status = graph.collect(topics.of_vue("vue_1", "track_status"), TrackStatus)
    start(graph)
    graph.wait_for_subscribers(MEASUREMENTS)
    network.describe()
    network.wait_for("rsus", "4 RSUs known", DiagnosticStatus.OK)
    for k in range(20):
        network.send(epoch("vue_1", 0.1 * k))
    status.wait_for(20)
    assert status.messages[-1].state == TrackStatus.TRACKING
    wait_until(lambda: status.messages[-1].state == TrackStatus.COASTING, "COASTING")
    last = status.messages[-1]
    assert last.reason.startswith("nothing taken for ")
    assert last.position_sd > 1.5 * status.messages[19].position_sd
    network.wait_for("vue_1", "s; was tracking", DiagnosticStatus.STALE)


def test_invented_devices_take_no_room_from_an_honest_one(graph: Graph) -> None:
    """Two hundred names nobody knows, twenty places: the tracker stays small and says so. Nothing
    sound comes of them: they have no topics."""
    network = Network(graph)
    odometry = graph.collect(topics.of_vue("honest", "odometry"), Odometry)
    start(graph, vues=["honest"], max_devices=20)
    graph.wait_for_subscribers(MEASUREMENTS)
    network.describe()
    network.wait_for("rsus", "4 RSUs known", DiagnosticStatus.OK)
    for k in range(200):
        network.send(epoch(f"made_up_{k}", 0.0, range_var=0.0))
        if k % 10 == 0:
            network.send(epoch("honest", 0.01 * k))
    words = "devices not admitted (too_many_devices; the last: 'made_up_199'): max_devices is 20"
    network.wait_for("rsus", words, DiagnosticStatus.WARN)
    assert len(odometry.wait_for(10)) >= 10
    listed = {name for name, _ in graph.node.get_topic_names_and_types()}
    assert "/honest/odometry" in listed
    assert not [name for name in listed if name.startswith("/made_up_")]
