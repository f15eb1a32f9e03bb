"""The simulator: reproducible, consistent with its stated variances, honest about who hears
whom."""

from __future__ import annotations

import itertools
import math
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from netpos.messages.values import (
    Beacon,
    ClockState,
    Field,
    ImuSample,
    InitialPose,
    Odometry,
    RsuMeasurement,
)
from netpos.radio.clocks import NetworkClockModel, clock_error, clock_tones
from netpos.scenario import Scenario, Simulation, load_scenario
from netpos.world.maps import METIS_MADRID
from scipy import stats

C = 299_792_458.0


def _same(a: object, b: object) -> bool:
    assert is_dataclass(a)
    return type(a) is type(b) and all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a)
    )


def _short(name: str, **changes: object) -> Scenario:
    return load_scenario(name, changes={"max_duration_s": 8.0, **changes})


def _beacons(simulation: Simulation) -> list[Beacon]:
    return [e for e in simulation.events() if isinstance(e, Beacon)]


@pytest.mark.parametrize("name", ["metis_madrid", "intersection_turn"])
def test_two_simulations_are_identical_and_measure_in_any_order(name: str) -> None:
    first, second = Simulation(_short(name)), Simulation(_short(name))
    events = list(first.events())
    assert all(_same(a, b) for a, b in zip(events, second.events(), strict=True))
    beacons = _beacons(first)
    forward = {b.stamp_ns: first.measure(b) for b in beacons}
    for beacon in reversed(beacons[::7]):
        again = second.measure(beacon)
        assert all(_same(a, b) for a, b in zip(forward[beacon.stamp_ns], again, strict=True))


def test_another_seed_gives_other_noise_on_the_same_road() -> None:
    a, b = (Simulation(load_scenario("fast_pass", seed=s)) for s in (1, 2))
    first, second = _beacons(a)[0], _beacons(b)[0]
    np.testing.assert_array_equal(first.position, second.position)
    assert a.measure(first)[0].azimuth_rad != b.measure(second)[0].azimuth_rad


@pytest.mark.parametrize("name", ["metis_madrid", "intersection_turn"])
def test_with_seed_is_the_scenario_loaded_with_that_seed(name: str) -> None:
    first = Simulation(_short(name))
    before = first.observations("vue_1")
    other, loaded = first.with_seed(41), Simulation(load_scenario(name, 41, {"max_duration_s": 8}))
    assert other.scenario == loaded.scenario
    assert all(_same(a, b) for a, b in zip(other.events(), loaded.events(), strict=True))
    for ours, theirs in zip(
        other.observations("vue_1"), loaded.observations("vue_1"), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(first.observations("vue_1").values, before.values)
    with pytest.raises(ValueError, match="seed must be >= 0, got -1"):
        first.with_seed(-1)


def test_order_epoch_and_grid() -> None:
    scenario = _short("metis_madrid")
    events = list(Simulation(scenario).events())
    stamps = [e.stamp_ns for e in events]
    assert stamps == sorted(stamps)
    assert [type(e) for e in events[:4]] == [InitialPose, Odometry, ClockState, Beacon]
    assert stamps[0] == 1_000_000_000
    beacons = [e for e in events if isinstance(e, Beacon)]
    assert [b.sequence for b in beacons] == list(range(len(beacons)))
    assert {b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(beacons)} == {83_650_000}
    truth = {e.stamp_ns: e for e in events if isinstance(e, Odometry)}
    clock = {e.stamp_ns: e for e in events if isinstance(e, ClockState)}
    for beacon in beacons:
        np.testing.assert_array_equal(beacon.position, truth[beacon.stamp_ns].position)
        assert beacon.clock_offset_s == clock[beacon.stamp_ns].offset_s


def _residuals(simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Normalised azimuth and TOA errors, from the geometry written out anew."""
    places = {r.rsu_id: r.position for r in simulation.rsus}
    azimuths, times = [], []
    for beacon in _beacons(simulation):
        for m in simulation.measure(beacon):
            d = beacon.position - places[m.rsu_id]
            azimuth = (m.azimuth_rad - math.atan2(d[1], d[0]) + math.pi) % (2 * math.pi) - math.pi
            azimuths.append(azimuth / math.sqrt(m.azimuth_var))
            delay = m.toa_s - np.linalg.norm(d) / C - beacon.clock_offset_s
            times.append(delay / math.sqrt(m.toa_var))
    return np.array(azimuths), np.array(times)


@pytest.mark.parametrize("name", ["metis_madrid", "fast_pass_100hz"])
def test_errors_agree_with_the_stated_variances(name: str) -> None:
    for z in _residuals(Simulation(load_scenario(name))):
        low, high = stats.chi2(len(z)).ppf([1e-4, 1 - 1e-4])
        assert low < (z**2).sum() < high
        assert stats.kstest(z, "norm").pvalue > 1e-4
        assert abs(np.corrcoef(z[:-2], z[2:])[0, 1]) < 5 / math.sqrt(len(z))  # white per RSU


def test_times_of_arrival_carry_the_errors_of_the_rsus_clocks() -> None:
    """The same beacons with and without; one error per RSU and instant, none at the reference."""
    clock = {"sd_s": 4e-9, "reference": "rsu_2", "declared": False}
    perfect = Simulation(load_scenario("fast_pass"))
    simulation = Simulation(load_scenario("fast_pass", changes={"rsus.clock": clock}))
    model = NetworkClockModel(**clock)
    for beacon in _beacons(perfect):
        for m, ideal in zip(simulation.measure(beacon), perfect.measure(beacon), strict=True):
            tones = clock_tones(model, perfect.scenario.seed, m.rsu_id)
            error = clock_error(beacon.stamp_ns * 1e-9, tones)
            assert m.toa_s - ideal.toa_s == pytest.approx(-error, abs=1e-18)
            assert (error == 0.0) == (m.rsu_id == "rsu_2")
            assert m.azimuth_rad == ideal.azimuth_rad
    assert all(rsu.range_bias_sd_m == 0.0 for rsu in simulation.rsus)


def test_rsus_declare_the_errors_of_their_clocks() -> None:
    clock = {"sd_s": 4e-9, "correlation_time_s": 30.0, "reference": "rsu_2"}
    rsus = Simulation(load_scenario("fast_pass", changes={"rsus.clock": clock})).rsus
    declared = {r.rsu_id: (r.range_bias_sd_m, r.bias_correlation_time_s) for r in rsus}
    assert declared == {"rsu_1": (pytest.approx(4e-9 * C), 30.0), "rsu_2": (0.0, 0.0)}
    with pytest.raises(ValueError, match="reference 'rsu_9' is not one of the RSUs: rsu_1, rsu_2"):
        Simulation(
            load_scenario("fast_pass", changes={"rsus.clock": {**clock, "reference": "rsu_9"}})
        )


def test_fixed_errors_are_those_of_the_paper() -> None:
    simulation = Simulation(load_scenario("fast_pass"))
    m = simulation.measure(_beacons(simulation)[0])[0]
    assert math.degrees(math.sqrt(m.azimuth_var)) == pytest.approx(2.0)
    assert math.sqrt(m.toa_var) == pytest.approx(50e-9)
    assert m.fields == Field.AZIMUTH | Field.TOA


def test_the_two_nearest_visible_rsus_report() -> None:
    """Against a brute-force search that samples the segments."""
    scenario = load_scenario("metis_madrid")
    simulation = Simulation(scenario)
    houses = METIS_MADRID.buildings
    share = np.linspace(0, 1, 3001)[:, None]
    for beacon in _beacons(simulation)[::97]:
        here = beacon.position[:2]
        ranked = sorted(simulation.rsus, key=lambda r: float(np.hypot(*(r.position[:2] - here))))
        visible = []
        for rsu in ranked[:12]:
            path = here + share * (rsu.position[:2] - here)
            inside = (path[:, None] > houses[:, :2] + 0.01).all(2)
            inside &= (path[:, None] < houses[:, 2:] - 0.01).all(2)
            if not inside.any() and np.hypot(*(rsu.position[:2] - here)) <= 150:
                visible.append(rsu.rsu_id)
        heard = simulation.measure(beacon)
        assert [m.rsu_id for m in heard] == visible[:2]
        assert all(m.expected == len(heard) for m in heard)


def test_d_los_cuts_at_its_distance() -> None:
    simulation = Simulation(load_scenario("intersection_turn"))
    inside = Beacon(
        stamp_ns=5,
        vue_id="vue_1",
        sequence=0,
        position=np.array([40.0, 6.0, 0.0]),
        clock_offset_s=0.0,
    )
    assert {m.rsu_id for m in simulation.measure(inside)} == {"rsu_1", "rsu_2"}
    outside = replace(inside, position=np.array([40.001, 6.0, 0.0]))
    assert {m.rsu_id for m in simulation.measure(outside)} == {"rsu_2"}


def test_arrays_and_single_measurements_are_the_same_values() -> None:
    simulation = Simulation(_short("metis_madrid"))
    seen = simulation.observations("vue_1")
    for i, beacon in enumerate(_beacons(simulation)):
        single = simulation.measure(beacon)
        assert len(single) == seen.heard_by[i]
        for j, m in enumerate(single):
            assert simulation.rsus[seen.rsu[i, j]].rsu_id == m.rsu_id
            assert (m.azimuth_rad, m.toa_s) == (seen.values[i, j, 0], seen.values[i, j, 2])
            assert (m.azimuth_var, m.toa_var) == (seen.variances[i, j, 0], seen.variances[i, j, 2])


SPATIAL = """\
rsus:
  units: [{id: rsu_1, position: [0.0, 0.0, 10.0], yaw_deg: 90.0}]
measurement:
  quantities: [azimuth, elevation, range]
  nearest: 1
  errors:
    model: cramer_rao
    array: {kind: planar, field_of_view_deg: 120.0}
    waveform: {tx_power_dbm: 20.0}
devices:
  - route: {kind: waypoints, points: [[-40.0, 20.0], [40.0, 20.0]]}
    speed_mps: 4.0
    antenna_height_m: 1.5
    beacon_interval_s: 0.1
"""


def test_turned_planar_array_in_space(tmp_path: Path) -> None:
    """Boresight north, device 20 m north: azimuth 0 abeam, served within 60 degrees only."""
    path = tmp_path / "spatial.yaml"
    path.write_text(SPATIAL, encoding="utf-8")
    simulation = Simulation(load_scenario(str(path)))
    for beacon in _beacons(simulation):
        x = beacon.position[0]
        heard = simulation.measure(beacon)
        assert bool(heard) == (abs(x) <= 20 * math.tan(math.radians(60)))
        for m in heard:
            assert m.fields == Field.AZIMUTH | Field.ELEVATION | Field.RANGE
            assert m.toa_s == m.toa_var == 0.0
            assert m.azimuth_rad == pytest.approx(math.atan2(-x, 20), abs=6 * m.azimuth_var**0.5)
            elevation = math.atan2(-8.5, math.hypot(x, 20))
            assert m.elevation_rad == pytest.approx(elevation, abs=6 * m.elevation_var**0.5)
            distance = math.sqrt(x**2 + 20**2 + 8.5**2)
            assert m.range_m == pytest.approx(distance, abs=6 * m.range_var**0.5)
            assert m.rssi_dbm == pytest.approx(
                20 - 32.4 - 21 * math.log10(distance) - 10.88, abs=0.01
            )


def test_itu_probability_is_met_on_average_and_constant_in_a_place() -> None:
    heard, chance = [], []
    position = np.array([30.0, 6.0, 0.0])
    for seed in range(400):
        scenario = load_scenario(
            "intersection_turn", seed=seed, changes={"measurement.los.probability": "umi"}
        )
        simulation = Simulation(scenario)
        ids = [
            {
                m.rsu_id
                for m in simulation.measure(
                    Beacon(
                        stamp_ns=t,
                        vue_id="vue_1",
                        sequence=0,
                        position=position,
                        clock_offset_s=0.0,
                    )
                )
            }
            for t in (10, 20)
        ]
        assert ids[0] == ids[1]
        heard.append("rsu_1" in ids[0])
        chance.append(0.6 + 0.4 * math.exp(-30 / 36))
    assert stats.binomtest(sum(heard), len(heard), chance[0]).pvalue > 1e-3


def test_several_devices_have_draws_of_their_own() -> None:
    simulation = Simulation(_short("metis_madrid", **{"devices.0.count": 3}))
    assert simulation.scenario.vue_ids == ("vue_1", "vue_2", "vue_3")
    starts = {v: simulation.beacons(v) for v in simulation.scenario.vue_ids}
    assert len({b.clock_offset_s[0] for b in starts.values()}) == 3
    alone = Simulation(_short("metis_madrid")).beacons("vue_1")
    np.testing.assert_array_equal(alone.position, starts["vue_1"].position)


def test_initial_pose_is_drawn_with_its_sd() -> None:
    errors = []
    for seed in range(300):
        simulation = Simulation(load_scenario("metis_madrid", seed=seed))
        pose = simulation.initial_pose("vue_1")
        assert pose is not None
        errors.append((pose.position - simulation.beacons("vue_1").position[0])[:2])
        np.testing.assert_array_equal(np.diag(pose.cov), [25.0, 25.0, 0.0])
    for column in (np.array(errors) / 5).T:
        assert stats.kstest(column, "norm").pvalue > 1e-3


def test_imu_runs_with_the_device() -> None:
    samples = [
        e for e in Simulation(_short("intersection_turn")).events() if isinstance(e, ImuSample)
    ]
    assert len(samples) == 800


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vue_id": "vue_9"}, "unknown device 'vue_9'"),
        ({"position": np.array([0, math.nan, 0])}, "not finite"),
        ({"clock_offset_s": math.inf}, "not finite"),
        ({"stamp_ns": 0}, "no valid stamp"),
    ],
)
def test_a_bad_beacon_is_refused(change: dict[str, object], message: str) -> None:
    simulation = Simulation(load_scenario("fast_pass"))
    good = _beacons(simulation)[0]
    assert isinstance(simulation.measure(good)[0], RsuMeasurement)
    with pytest.raises(ValueError, match=message):
        simulation.measure(replace(good, **change))  # type: ignore[arg-type]


def test_a_wandering_drive_leaves_the_straight_line_with_the_seed() -> None:
    changes = {"devices.0.wander_density_mps2_sqrthz": 0.5}
    straight = Simulation(load_scenario("fast_pass")).beacons("vue_1").position
    first, second = (
        Simulation(load_scenario("fast_pass", seed, changes)).beacons("vue_1").position
        for seed in (1, 2)
    )
    assert 0.01 < np.abs(first - straight).max() < 20.0
    assert not np.array_equal(first, second)


def test_wandering_needs_a_drive_without_imu() -> None:
    changes = {"devices.0.wander_density_mps2_sqrthz": 0.5}
    with pytest.raises(ValueError, match="wander_density_mps2_sqrthz is for a device that drives"):
        load_scenario("intersection_turn", changes=changes)
