"""Two trackers in one graph: namespaces, remapping, and a recording of one of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from feed import PLACES, measurement
from graph import LATCHED, Graph, wait_for_rsus, wait_until
from nav_msgs.msg import Odometry
from netpos.bags import BagReader
from netpos.messages.values import RsuInfo
from netpos_msgs.msg import ClockState, RsuMeasurement, TrackStatus
from netpos_msgs.msg import RsuInfo as RsuInfoMessage
from netpos_node import CODEC
from runs import ESTIMATES, assert_same, graphs, netpos

SHIFT_M = 1000.0
EPOCHS = 60


@pytest.fixture(name="graph")
def _graph(tmp_path: Path) -> Iterator[Graph]:
    with graphs(tmp_path) as (graph,):
        yield graph


def start(graph: Graph, package: str, executable: str, *arguments: str) -> Any:
    return graph.start(executable, ["ros2", "run", package, executable, *arguments])


def test_two_trackers_of_one_name_of_a_device(graph: Graph, tmp_path: Path) -> None:
    """Site b lies a kilometre east of site a and calls its measurements otherwise; each tracker
    hears its own RSUs only, and a recorder of site_a keeps site_a."""
    bag = tmp_path / "bag"
    ns = ("--ros-args", "-r", "__ns:=/site_a")
    recorder = start(graph, "netpos_bag", "record", "--output", str(bag), *ns)
    recorder.wait_for_output("recording to")
    found = {
        site: graph.collect(f"/{site}/vue_1/odometry", Odometry) for site in ("site_a", "site_b")
    }
    for topic, kind in (("clock_state", ClockState), ("track_status", TrackStatus)):
        graph.collect(f"/site_b/vue_1/{topic}", kind)  # as the recorder does at site_a
    trackers = [
        start(graph, "ekf_tracker", "ekf_tracker", *ns, "-p", "subscribers:=1"),
        start(graph, "ekf_tracker", "ekf_tracker", "--ros-args", "-r", "__ns:=/site_b",
              "-r", "rsu/measurements:=uwb/ranges", "-p", "base_frame:='b/{vue}'",
              "-p", "subscribers:=1"),
    ]  # fmt: skip
    told = graph.collect("/diagnostics", DiagnosticArray)
    infos, measured = {}, {}
    for site, topic in (("site_a", "rsu/measurements"), ("site_b", "uwb/ranges")):
        infos[site] = graph.publisher(f"/{site}/rsu/info", RsuInfoMessage, LATCHED)
        for name, (x, y) in PLACES.items():
            place = np.array([x + (SHIFT_M if site == "site_b" else 0.0), y, 0.0])
            infos[site].publish(CODEC.rsu_info_to_msg(RsuInfo(rsu_id=name, position=place)))
        measured[site] = graph.publisher(f"/{site}/{topic}", RsuMeasurement)
    for site, heard_by in (("site_a", 2), ("site_b", 1)):  # the recorder hears site_a, too
        for publisher in (infos[site], measured[site]):
            wait_until(lambda p=publisher, n=heard_by: p.get_subscription_count() >= n, site, 60.0)
        wait_for_rsus(told, len(PLACES), f"{site}/ekf_tracker")
    for k in range(EPOCHS):
        for name in PLACES:
            for publisher in measured.values():
                publisher.publish(measurement(name, 0.1 * k))
    east = {s: c.wait_for(EPOCHS, 60.0)[-1].pose.pose.position.x for s, c in found.items()}
    assert east["site_a"] == pytest.approx(8.0 * 5.9, abs=0.5)
    assert east["site_b"] == pytest.approx(8.0 * 5.9 + SHIFT_M, abs=0.5)
    frames = {c.messages[-1].child_frame_id for c in found.values()}
    assert frames == {"vue_1/base_link", "b/vue_1"}
    wanted = {"site_a/ekf_tracker: vue_1", "site_b/ekf_tracker: vue_1"}
    wait_until(lambda: wanted <= {s.name for m in told.messages for s in m.status}, "both")
    spoken = [s.message for message in told.messages for s in message.status]
    assert not any("another node publishes" in text for text in spoken)

    for process in (*trackers, recorder):
        assert process.interrupt() == 0
    with BagReader(bag) as reader:
        topics = set(reader.topics)
    assert {"/rsu/info", "/rsu/measurements", *ESTIMATES} <= topics
    assert not any("site_" in topic or "transition_event" in topic for topic in topics)
    netpos("replay", bag, "--out", tmp_path / "again")
    assert_same(tmp_path / "again", bag, ESTIMATES, at_least=EPOCHS)
