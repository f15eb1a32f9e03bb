"""A live run carries the same measurements and estimates as the offline run of its scenario."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from netpos.bags import BagReader
from netpos.bags.qos import is_latched, is_reliable
from netpos.scenario.load import scenario_of_text
from runs import (
    ESTIMATES,
    INFOS,
    MEASUREMENTS,
    PATIENT,
    assert_same,
    changed_scenario,
    finish,
    graphs,
    netpos,
    payloads,
    script,
)

SEED = "11"
SIMULATED = ("beacon", "ground_truth", "ground_truth_clock")
INERTIAL = ("imu", "mag", "initialpose")


@dataclass(frozen=True)
class Pair:
    """Recordings of one scenario."""

    live: Path
    offline: Path
    topics: tuple[str, ...]


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Pair]:
    """fast_pass by `netpos run` at real time, a short METIS with an IMU by the script at 4x."""
    folder = tmp_path_factory.mktemp("live_offline")
    device: dict[str, Any] = {"imu": {"rate_hz": 100.0}, "magnetometer": {"rate_hz": 50.0}}
    device["route"] = {"kind": "metis_random", "corner_radius_m": 3.0}
    metis = changed_scenario(
        folder / "metis_short.yaml",
        "metis_madrid",
        device,
        tracker=PATIENT,
        max_duration_s=12.0,
    )
    made = {
        name: Pair(
            folder / f"{name}_live",
            folder / f"{name}_offline",
            tuple(f"/vue_1/{topic}" for topic in topics),
        )
        for name, topics in {"fast_pass": SIMULATED, "metis": SIMULATED + INERTIAL}.items()
    }
    with graphs(folder, 2) as (first, second):
        command = ["netpos", "run", "fast_pass", "--bag", str(made["fast_pass"].live)]
        started = [
            first.start("netpos_run", command),
            script(second, "run_graph", metis, made["metis"].live, "4", SEED),
        ]
        netpos("run", "fast_pass", "--offline", "--bag", made["fast_pass"].offline)
        netpos("run", metis, "--offline", "--seed", SEED, "--bag", made["metis"].offline)
        finish(*started)
    return made


@pytest.mark.parametrize("name", ["fast_pass", "metis"])
def test_same_simulation_and_measurements(pairs: dict[str, Pair], name: str) -> None:
    pair = pairs[name]
    topics = (INFOS, MEASUREMENTS, *pair.topics)
    assert_same(pair.live, pair.offline, topics)


@pytest.mark.parametrize("name", ["fast_pass", "metis"])
def test_same_estimates(pairs: dict[str, Pair], name: str) -> None:
    assert_same(pairs[name].live, pairs[name].offline, ESTIMATES, at_least=40)


def test_a_seed_of_its_own_gives_other_noise(pairs: dict[str, Pair], tmp_path: Path) -> None:
    """Otherwise the equalities above might hold whatever the seed."""
    other = tmp_path / "other"
    netpos("run", "fast_pass", "--offline", "--seed", "12", "--bag", other)
    mine = payloads(pairs["fast_pass"].offline, (MEASUREMENTS, "/vue_1/beacon"))
    theirs = payloads(other, (MEASUREMENTS, "/vue_1/beacon"))
    assert len(mine[MEASUREMENTS]) == len(theirs[MEASUREMENTS])
    assert mine[MEASUREMENTS] != theirs[MEASUREMENTS]


def test_a_live_recording_replays_to_its_own_estimates(
    pairs: dict[str, Pair], tmp_path: Path
) -> None:
    """It carries its parameters, so `netpos replay` needs nothing else."""
    for pair in pairs.values():
        again = tmp_path / pair.live.name
        netpos("replay", pair.live, "--out", again)
        assert_same(again, pair.live, ESTIMATES)


def test_a_live_recording_carries_the_parameters_of_its_tracker(pairs: dict[str, Pair]) -> None:
    """The same as an offline one: replaying it does not depend on a scenario that may change."""
    for pair in pairs.values():
        with BagReader(pair.live) as live, BagReader(pair.offline) as offline:
            (said,) = live.facts["tracker"]
            assert yaml.safe_load(said)["device_height_m"] is not None
            assert offline.facts["tracker"] == (said,)
            assert live.facts["scenario"] == offline.facts["scenario"]


def test_a_live_recording_notes_run_and_qos(pairs: dict[str, Pair]) -> None:
    with BagReader(pairs["metis"].live) as bag:
        (text,) = bag.facts["scenario"]
        scenario = scenario_of_text(text, bag.path)
        assert (scenario.name, str(scenario.seed)) == ("metis_short", SEED)
        assert bag.facts["rate"] == ("4",)
        assert is_latched(bag.topics[INFOS].qos)
        for topic in (MEASUREMENTS, *ESTIMATES, *pairs["metis"].topics):
            assert is_reliable(bag.topics[topic].qos)
            assert is_latched(bag.topics[topic].qos) is topic.endswith("initialpose")
