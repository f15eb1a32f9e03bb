"""A scenario too large for the memory is refused before it is built, with limit and key."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from netpos.scenario import size
from netpos.scenario.load import ScenarioError, load_scenario, scenario_names
from netpos.scenario.simulation import Simulation


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"devices.0.beacon_interval_s": 1e-9}, "2e+10 messages, at most 2e+07 .* devices.0"),
        (
            {"devices.0.route.points": [[0.0, 0.0], [1e9, 0.0]]},
            r"count 1, beacon_interval_s 0.1, 2.38e\+07 s; lower count, raise beacon_interval_s, "
            "shorten its route or set max_duration_s",
        ),
        ({"devices.0.beacon_interval_s": 1e308}, "beacon_interval_s.*1000000"),
        ({"devices.0.count": 10**9}, "devices.0.count.*100000"),
        ({"devices.0.count": 100_000}, "count 100000"),
        (
            {"devices.0.ground_truth_rate_hz": 1e9},
            "messages, at most",
        ),
        (
            {
                "devices.0.route.points": [[0.0, 0.0], [1e12, 0.0]],
                "devices.0.wander_density_mps2_sqrthz": 0.1,
            },
            "a device that wanders may take 20000000: shorten its route or raise beacon",
        ),
        (
            {
                "devices.0.route": {
                    "kind": "rectangle",
                    "width_m": 1.0,
                    "height_m": 1.0,
                    "laps": 10**9,
                }
            },
            "laps.*10000",
        ),
    ],
)
def test_too_large(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(
        ScenarioError,
        match=words.replace("2e+10", r"[0-9.]+e\+[0-9]+").replace("2e+07", r"2e\+07"),
    ):
        load_scenario("fast_pass", changes=changes)


@pytest.mark.timeout(20)
def test_a_walk_of_a_million_kilometres() -> None:
    changes: dict[str, Any] = {"devices.0.route.width_m": 1e9}
    with pytest.raises(ScenarioError, match=r"about 6\.27e\+09 steps, at most 1e\+06 are walked"):
        load_scenario("pedestrian_walk", changes=changes)
    changes = {"devices.0.gait.step_length_m": 1e-9}
    with pytest.raises(ScenarioError, match="step_length_m"):
        load_scenario("pedestrian_walk", changes=changes)


def test_a_long_route_that_is_cut_short_is_fine() -> None:
    changes = {"devices.0.route.points": [[0.0, -10.0], [1e9, -10.0]], "max_duration_s": 5.0}
    scenario = load_scenario("fast_pass", changes=changes)
    assert sum(1 for _ in Simulation(scenario).events()) < 1000


def test_just_below_and_above_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("fast_pass")
    messages = size.messages_of(scenario.devices[0], scenario.measurement.nearest, 1e9)
    monkeypatch.setattr(size, "MESSAGES_MAX", messages * 1.001)
    load_scenario("fast_pass")
    monkeypatch.setattr(size, "MESSAGES_MAX", messages * 0.999)
    with pytest.raises(ScenarioError, match="messages, at most"):
        load_scenario("fast_pass")


@pytest.mark.parametrize("name", scenario_names())
def test_estimate_is_near_what_a_run_has(name: str) -> None:
    """Of a part of the run: events and, at most, the measurements of the beacons."""
    scenario = load_scenario(name, changes={"max_duration_s": 3.0})
    simulation = Simulation(scenario)
    count = 0
    for event in itertools.islice(simulation.events(), 20_000):
        count += 1
        if type(event).__name__ == "Beacon":
            count += len(simulation.measure(event))
    nearest = scenario.measurement.nearest
    heard = min(nearest, len(scenario.rsus.units) or nearest)
    estimated = sum(d.count * size.messages_of(d, heard, 3.0) for d in scenario.devices)
    assert estimated / 4 < count < 2 * estimated + 10
