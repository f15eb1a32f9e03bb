"""The offline bag holds the simulator's values, topic by topic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from netpos.bags import BagReader, codec
from netpos.inertial.gait import Gait
from netpos.messages.values import Beacon
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.offline import simulate_to_bag, timeline
from netpos.scenario.topics import device_topics


def test_bag_holds_every_event_and_measurement(tmp_path: Path) -> None:
    scenario = load_scenario("intersection_turn", changes={"max_duration_s": 5.0})
    simulation = Simulation(scenario)
    beacons = [e for e in simulation.events() if isinstance(e, Beacon)]
    expected = [m for b in beacons for m in simulation.measure(b)]
    written = simulate_to_bag(scenario, tmp_path / "bag")
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) == {
            "/clock",
            "/rsu/info",
            "/rsu/measurements",
            *device_topics(scenario),
        }
        assert sum(t.count for t in bag.topics.values()) == written
        assert {t: bag.topics[t].type_name for t in device_topics(scenario)} == device_topics(
            scenario
        )
        read = [
            codec().measurement_from_msg(e.message) for e in bag.messages({"/rsu/measurements"})
        ]
        stamps = [e.log_time_ns for e in bag.messages({"/clock"})]
    key = [(m.stamp_ns, m.rsu_id, m.azimuth_rad, m.toa_s, m.expected) for m in expected]
    assert [(m.stamp_ns, m.rsu_id, m.azimuth_rad, m.toa_s, m.expected) for m in read] == key
    assert stamps == sorted(set(stamps))
    assert stamps[-1] == beacons[-1].stamp_ns


def test_a_bag_is_never_overwritten(tmp_path: Path) -> None:
    scenario = load_scenario("fast_pass")
    simulate_to_bag(scenario, tmp_path / "bag")
    with pytest.raises(FileExistsError):
        simulate_to_bag(scenario, tmp_path / "bag")


def test_clock_leads_every_event_and_never_lags_a_period() -> None:
    scenario = load_scenario("metis_madrid", changes={"max_duration_s": 3.0})
    now = 0
    for item in timeline(Simulation(scenario), 50.0, measured=True):
        if isinstance(item, int):
            assert item > now
            now = item
        elif now:
            assert now <= item.stamp_ns < now + 20_000_000


@pytest.mark.parametrize("clock_hz", [0.0, -1.0, float("nan")])
def test_bad_clock_rate_is_refused(clock_hz: float) -> None:
    with pytest.raises(ValueError, match="clock_hz"):
        next(timeline(Simulation(load_scenario("fast_pass")), clock_hz))


def test_who_walks_is_dead_reckoned_and_who_drives_is_not(tmp_path: Path) -> None:
    """5 s of the person of ``pedestrian_walk``: steps of the true contacts, velocities in map."""
    walk = load_scenario("pedestrian_walk", changes={"max_duration_s": 6.0})
    gait = walk.devices[0].motion(walk.seed, "vue_1")
    assert isinstance(gait, Gait)
    simulate_to_bag(walk, tmp_path / "walk")
    make = codec()
    with BagReader(tmp_path / "walk") as bag:
        steps = [e.message for e in bag.messages(["/vue_1/step"])]
        velocities = [
            make.velocity_from_msg(e.message, "vue_1")
            for e in bag.messages(["/vue_1/step_velocity"])
        ]
    ends = np.array([s.end.sec + s.end.nanosec * 1e-9 for s in steps]) - walk.start_s
    known = gait.contact_s[gait.contact_s < 6.0 - 0.5]
    assert len(known) >= 4
    np.testing.assert_allclose(ends[: len(known)], known, atol=0.1)
    assert len(velocities) == pytest.approx(10 * 5.5, abs=2)
    assert {v.frame_id for v in velocities[2:]} == {"map"}
    drive = load_scenario("intersection_turn", changes={"max_duration_s": 2.0})
    simulate_to_bag(drive, tmp_path / "drive")
    with BagReader(tmp_path / "drive") as bag:
        assert not {"/vue_1/step", "/vue_1/step_velocity"} & set(bag.topics)
