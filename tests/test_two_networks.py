"""Two networks live: a tracker each, the fusion of their tracks, one of them lost on the way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from graph import wait_until
from nav_msgs.msg import Odometry
from netpos.messages.fields import stamp_ns
from netpos.scenario import load_scenario
from netpos_msgs.msg import TrackStatus
from runs import (
    MEASUREMENTS,
    ODOMETRY,
    PATIENT,
    TRACK_STATUS,
    assert_same,
    changed_scenario,
    finish,
    graphs,
    messages,
    netpos,
    script,
)

NETWORKS = ("wimax", "wifi")
TRACKS = tuple(f"/networks/{name}/tracks" for name in NETWORKS)
OWN = ("/networks/wimax/vue_1/odometry", "/networks/wifi/wifi_1/odometry")
FUSED = (ODOMETRY, TRACK_STATUS)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The scenario live, offline, and the offline bag through live trackers."""
    folder = tmp_path_factory.mktemp("two_networks")
    short = changed_scenario(
        folder / "short.yaml",
        "two_networks",
        tracker=PATIENT,
        max_duration_s=25.0,
        fusion={**load_scenario("two_networks").fusion, **PATIENT},
    )
    made = {name: folder / name for name in ("live", "offline", "played", "replayed")}
    netpos("run", short, "--offline", "--bag", made["offline"])
    with graphs(folder, 2) as (first, second):
        finish(
            script(first, "run_graph", short, made["live"], "2"),
            script(second, "play_bag", made["offline"], made["played"], "2"),
        )
    netpos("replay", made["live"], "--out", made["replayed"])
    return made


@pytest.mark.parametrize("name", ["live", "played", "replayed"])
def test_same_tracks_and_same_fused_odometry(bags: dict[str, Path], name: str) -> None:
    topics = (MEASUREMENTS, *TRACKS, *OWN, *FUSED)
    assert_same(bags[name], bags["offline"], topics, at_least=40)


def test_both_networks_are_in_the_fused_track(bags: dict[str, Path]) -> None:
    statuses = messages(bags["live"], TRACK_STATUS)
    both = [s for s in statuses if set(s.sources) == {"wimax/vue_1", "wifi/wifi_1"}]
    assert len(both) > 0.8 * len(statuses)


def test_fused_better_than_each_network_claims(bags: dict[str, Path]) -> None:
    fused = {stamp_ns(m.header.stamp): m for m in messages(bags["live"], ODOMETRY)}
    for topic in OWN:
        alone = messages(bags["live"], topic)[-1]
        same_time = fused[stamp_ns(alone.header.stamp)]
        assert same_time.pose.covariance[0] < alone.pose.covariance[0]


def test_the_fusion_goes_on_when_a_network_is_lost(tmp_path: Path) -> None:
    """The tracker of one network is killed; the device stays, the diagnostics say why."""
    scenario = {"scenario": "two_networks"}
    with graphs(tmp_path) as (graph,):
        odometry = graph.collect(ODOMETRY, Odometry)
        status = graph.collect(TRACK_STATUS, TrackStatus)
        told = graph.collect("/diagnostics", DiagnosticArray)
        graph.run("track_fusion", "track_fusion", parameters=scenario)
        trackers = {
            name: graph.run(
                "ekf_tracker",
                "ekf_tracker",
                "--ros-args",
                "-r",
                f"__node:=ekf_tracker_{name}",
                parameters=scenario | {"network": name},
            )
            for name in NETWORKS
        }
        graph.run("rsu_sensor", "rsu_sensor", parameters=scenario | {"subscribers": 2})
        graph.wait_for_nodes("track_fusion", "rsu_sensor", "ekf_tracker_wifi", "ekf_tracker_wimax")
        graph.run("vue_sim", "vue_sim", parameters=scenario | {"rate": 2.0, "subscribers": 1})
        wait_until(lambda: any(s.used == 2 for s in status.messages), "both networks fused", 60.0)
        trackers["wifi"].kill()
        before = len(odometry.messages)
        wait_until(
            lambda: [s.used for s in status.messages[-5:]] == [1] * 5, "one network fused", 30.0
        )
        assert len(odometry.messages) > before
        assert status.messages[-1].sources == ["wimax/vue_1"]
        wait_until(lambda: _is_told(told.messages), "the silence told in /diagnostics", 10.0)


def _is_told(arrays: list[Any]) -> bool:
    return any(
        entry.name == "track_fusion: network wifi" and entry.message == "silent: left out"
        for array in arrays
        for entry in array.status
    )
