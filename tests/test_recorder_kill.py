"""The recorder of a running graph is killed: what it lost, what is recovered, what it is worth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from graph import Graph
from nav_msgs.msg import Odometry
from netpos.bags import BagError, BagReader
from runs import (
    ESTIMATES,
    INFOS,
    MEASUREMENTS,
    ODOMETRY,
    TRUTH,
    long_road,
    netpos,
    run_netpos,
    stamps,
)

NS = 1_000_000_000
ESTIMATES_BEFORE = 50


def test_killed_recorder_loses_at_most_a_second_of_a_run(graph: Graph, tmp_path: Path) -> None:
    bag, scenario = tmp_path / "killed", str(long_road(tmp_path / "long_road.yaml"))
    truth = graph.collect(TRUTH, Odometry)
    odometry = graph.collect(ODOMETRY, Odometry)
    recorder = graph.run("netpos_bag", "record", "--output", str(bag))
    recorder.wait_for_output("recording to")
    tracker = graph.run("ekf_tracker", "ekf_tracker", parameters={"scenario": scenario})
    graph.run("rsu_sensor", "rsu_sensor", parameters={"scenario": scenario, "subscribers": 2})
    graph.wait_for_nodes("ekf_tracker", "rsu_sensor")
    graph.run("vue_sim", "vue_sim", parameters={"scenario": scenario, "subscribers": 2})
    odometry.wait_for(ESTIMATES_BEFORE, 90.0)
    known_ns = stamps(truth.messages)[-1]  # simulated time runs at real time
    assert recorder.kill() == -9
    graph.processes.remove(recorder)

    # nobody else minds
    odometry.wait_for(len(odometry.messages) + 20)
    assert tracker.running, tracker.describe()

    with pytest.raises(BagError, match="netpos recover"):
        BagReader(bag)
    left = {file.name: file.read_bytes() for file in bag.iterdir()}
    said = netpos("recover", bag)
    recovered = tmp_path / "killed_recovered"
    assert str(recovered) in said
    assert {file.name: file.read_bytes() for file in bag.iterdir()} == left

    with BagReader(recovered) as reader:
        assert reader.end_ns > known_ns - NS
        assert reader.metadata["netpos_version"]
        assert reader.topics[INFOS].count == 67
        for topic in (TRUTH, MEASUREMENTS, *ESTIMATES):
            last_ns = stamps([entry.message for entry in reader.messages([topic])])[-1]
            assert last_ns > known_ns - NS, topic
        sequences = [entry.message.sequence for entry in reader.messages(["/vue_1/beacon"])]
    assert sequences == list(range(len(sequences)))

    figures = tmp_path / "figures.json"
    netpos("evaluate", recovered, "--json", figures)
    scored = json.loads(figures.read_text(encoding="utf-8"))["vues"]["vue_1"]
    assert scored["n"] >= 15
    assert scored["rmse_m"] < 2.0
    again = run_netpos("recover", bag)
    assert again.returncode == 2
    assert "exists" in again.stderr
