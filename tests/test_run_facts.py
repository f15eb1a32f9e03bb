"""What a bag says about its run, however it was recorded, and what a recorder says it missed."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
import yaml
from graph import Graph
from nav_msgs.msg import Odometry
from netpos.bags import LOST_METADATA, BagReader, BagWriter
from netpos.evaluation.contents import notes_of
from netpos.scenario import load_scenario
from netpos.scenario.load import scenario_of_text
from netpos.scenario.settings import bag_settings
from runs import ESTIMATES, ODOMETRY, assert_same, changed_scenario, netpos, run_netpos

MASTS = {"device_height_m": 1.25, "manoeuvre_speed_sd_mps": 2.0}


def record_by_hand(graph: Graph, scenario: str, bag: Path) -> None:
    """Every node started alone, the tracker with parameters of its own."""
    odometry = graph.collect(ODOMETRY, Odometry)
    recorder = graph.run("netpos_bag", "record", "--output", str(bag))
    recorder.wait_for_output("recording to")
    tracker = graph.run(
        "ekf_tracker", "ekf_tracker", parameters={"scenario": scenario, "hold_s": 10.0} | MASTS
    )
    rsus = graph.run("rsu_sensor", "rsu_sensor", parameters={"scenario": scenario})
    graph.wait_for_nodes("ekf_tracker", "rsu_sensor")
    device = graph.run(
        "vue_sim", "vue_sim", parameters={"scenario": scenario, "subscribers": 2, "rate": 4.0}
    )
    assert device.wait(120.0) == 0, device.describe()
    for process in (rsus, tracker, recorder):
        assert process.interrupt() == 0, process.describe()
    assert odometry.messages


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(changed_scenario(tmp_path_factory.mktemp("own") / "my_road.yaml", "fast_pass"))


def test_a_graph_started_by_hand_replays_to_its_own_estimates(
    graph: Graph, scenario: str, tmp_path: Path
) -> None:
    bag = tmp_path / "by_hand"
    record_by_hand(graph, scenario, bag)
    with BagReader(bag) as source:
        parameters = bag_settings(source).parameters
        assert {name: parameters[name] for name in MASTS} == MASTS
        (text,) = source.facts["scenario"]
        assert scenario_of_text(text, bag) == load_scenario(scenario)
        assert source.facts["rate"] == ("4",)
        assert source.facts["netpos_version"]
        assert yaml.safe_load(source.metadata[LOST_METADATA]) == {}
    said = netpos("replay", bag, "--out", tmp_path / "again")
    assert "device_height_m 1.25" in said
    assert str(bag) in said
    assert_same(tmp_path / "again", bag, ESTIMATES, at_least=40)


def test_a_recording_that_does_not_say_is_not_guessed_at(scenario: str, tmp_path: Path) -> None:
    whole, bare = tmp_path / "whole", tmp_path / "bare"
    netpos("run", scenario, "--offline", "--bag", whole)
    with BagReader(whole) as source, BagWriter(bare) as out:
        for entry in source.messages(["/rsu/info", "/rsu/measurements"]):
            out.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
    refused = run_netpos("replay", bare, "--out", tmp_path / "no")
    assert refused.returncode == 2
    assert "does not say with which parameters" in refused.stderr
    assert "--parameters" in refused.stderr
    assert not (tmp_path / "no").exists()
    assert "of fast_pass" in netpos(
        "replay", bare, "--out", tmp_path / "named", "--parameters", "fast_pass"
    )
    said = netpos("replay", bare, "--out", tmp_path / "usual", "--parameters", "defaults")
    assert "not the default: none" in said


def test_what_a_stopped_recorder_missed_is_counted(graph: Graph, tmp_path: Path) -> None:
    """It stands still while more is published than waits for it; told at the end and kept."""
    bag = tmp_path / "missed"
    publisher = graph.publisher("/vue_1/odometry", Odometry)
    recorder = graph.run("netpos_bag", "record", "--output", str(bag))
    recorder.wait_for_output("recording to")
    graph.wait_for_subscribers("/vue_1/odometry")
    sent = 0
    for stopped in (False, True, False):
        if stopped:
            recorder.signal(signal.SIGSTOP)
        for _ in range(5000 if stopped else 10):
            publisher.publish(Odometry())
            sent += 1
        if stopped:
            recorder.signal(signal.SIGCONT)
        time.sleep(1.0)
    assert recorder.interrupt() == 0
    with BagReader(bag) as source:
        kept = source.topics["/vue_1/odometry"].count
        assert 20 <= kept < sent
        assert yaml.safe_load(source.metadata[LOST_METADATA]) == {"/vue_1/odometry": sent - kept}
        assert f"LOST while recording: {sent - kept} of /vue_1/odometry" in notes_of(source)
    assert f"LOST /vue_1/odometry: {sent - kept}" in recorder.output
