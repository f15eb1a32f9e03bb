"""What a strapdown track knows beside its motion: the device's clock, biases of RSUs, blocked
paths, and RSUs that lie."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, Beacon, ClockState, ImuSample, RsuMeasurement
from netpos.radio.noise import generator
from netpos.scenario import Simulation, load_scenario
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from netpos.tracking.estimators.epoch_rows import epoch_rows_of
from netpos.tracking.estimators.spatial import ROWS_3D
from netpos.tracking.first_fix.strapdown_start import sound_fix
from netpos.tracking.health.health import RsuState
from netpos.tracking.rsus.rsu import Rsu

NS = 1_000_000_000
VUE = "vue_1"
Item = RsuMeasurement | ImuSample


def simulated(seed: int, seconds: float, stations: tuple[int, int], **changes: Any) -> Simulation:
    settings = {
        "max_duration_s": seconds,
        "measurement.fewest": stations[0],
        "measurement.nearest": stations[1],
        **changes,
    }
    return Simulation(load_scenario("blocked_5g_drive", seed=seed, changes=settings))


def one_way(seed: int, seconds: float, stations: tuple[int, int]) -> Simulation:
    """Times of arrival of 1 m instead of ranges: the clock is 100 us and 30 ppm off."""
    return simulated(
        seed, seconds, stations,
        **{
            "measurement.quantities": ["azimuth", "elevation", "toa"],
            "measurement.errors.toa_sd_s": 1.0 / 299_792_458.0,
        },
    )  # fmt: skip


def items_of(simulation: Simulation) -> list[Item]:
    beacons = [e for e in simulation.events() if isinstance(e, Beacon)]
    measured = [m for beacon in beacons for m in simulation.measure(beacon)]
    return sorted([*simulation.imu(VUE), *measured], key=lambda item: item.stamp_ns)


def run(
    simulation: Simulation,
    items: Iterable[Item],
    rsus: Callable[..., Any] = replace,
    **changes: Any,
) -> tuple[list[TrackOutput], Tracker]:
    parameters = {**simulation.scenario.tracker, "clock_walk_density": 6.3e-8, **changes}
    tracker = Tracker(TrackerConfig.from_mapping(parameters))
    for rsu in simulation.rsus:
        tracker.add_rsu(rsus(rsu))
    outputs = []
    for item in items:
        tracker.add(item)
        outputs += tracker.process()
    return outputs + tracker.flush(), tracker


def errors(simulation: Simulation, outputs: list[TrackOutput]) -> Array:
    found = [o.odometry for o in outputs if o.odometry is not None]
    truth = simulation.truth(VUE, np.array([o.stamp_ns for o in found]))
    return np.array([o.position for o in found]) - truth.position


def rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


def clock_errors(simulation: Simulation, clocks: list[ClockState]) -> tuple[Array, Array]:
    """(n, 2) of offset and drift, and their (n, 2, 2) covariances."""
    beacons = simulation.beacons(VUE)
    at = np.searchsorted(beacons.stamp_ns, [c.stamp_ns for c in clocks])
    offset = np.array([c.offset_s for c in clocks]) - beacons.clock_offset_s[at]
    drift = np.array([c.drift for c in clocks]) - beacons.clock_drift[at]
    return np.column_stack([offset, drift]), np.array([c.cov for c in clocks])


def test_the_clock_is_found_with_the_place_from_one_or_two_stations() -> None:
    """Offsets to 6 ns with honest covariances, over four blocked drives (2 degrees each)."""
    nees = []
    for seed in range(5100, 5104):
        simulation = one_way(seed, 90.0, (1, 2))
        outputs, _ = run(simulation, items_of(simulation))
        clocks = [o.clock for o in outputs if o.clock is not None]
        assert len(clocks) == sum(o.odometry is not None for o in outputs)
        assert all(o.status.rejected == {} for o in outputs)
        error, cov = clock_errors(simulation, clocks)
        nees.append(np.mean([e @ np.linalg.solve(P, e) for e, P in zip(error, cov, strict=True)]))
        assert rms(error[20:, 0]) < 9e-9
        assert rms(errors(simulation, outputs)[20:, :2]) < 2.5
    assert 1.0 < np.mean(nees) < 3.2


def test_times_tell_the_place_as_ranges_do_once_the_clock_is_known() -> None:
    found = [
        rms(errors(simulation, run(simulation, items_of(simulation))[0])[20:])
        for simulation in (simulated(5200, 60.0, (4, 8)), one_way(5200, 60.0, (4, 8)))
    ]
    assert found[1] < 1.5 * found[0]


def test_without_times_there_is_no_clock_to_tell_of() -> None:
    simulation = simulated(5300, 15.0, (4, 8))
    assert all(o.clock is None for o in run(simulation, items_of(simulation))[0])


@pytest.fixture(scope="module")
def drive() -> tuple[Simulation, list[Item]]:
    simulation = simulated(5400, 60.0, (4, 8))
    return simulation, items_of(simulation)


def test_biases_of_rsus_are_states(drive: tuple[Simulation, list[Item]]) -> None:
    """Every RSU's ranges are off by 5 m or so, for minutes: declared, the biases are estimated;
    taken for noise they would cost more, not declared much more."""
    simulation, items = drive
    offset = {
        rsu.rsu_id: 5.0 * generator(1, rsu.rsu_id).standard_normal() for rsu in simulation.rsus
    }
    bent = [
        replace(i, range_m=i.range_m + offset[i.rsu_id]) if isinstance(i, RsuMeasurement) else i
        for i in items
    ]

    def declared(rsu: Any) -> Any:
        return replace(rsu, range_bias_sd_m=5.0, bias_correlation_time_s=1e4)

    def noisy(item: Item) -> Item:
        if isinstance(item, RsuMeasurement):
            return replace(item, range_var=item.range_var + 25.0)
        return item

    known, _ = run(simulation, bent, declared, isolate_rsus=False)
    noise, _ = run(simulation, map(noisy, bent), isolate_rsus=False)
    blind, _ = run(simulation, bent, isolate_rsus=False)
    late = [rms(errors(simulation, outputs)[20:, :2]) for outputs in (known, noise, blind)]
    assert late[0] < 0.8 * late[1]
    assert late[0] < 0.6 * late[2]
    assert sum(known[-1].status.rejected.values()) <= 2
    found = [o.odometry for o in known if o.odometry is not None][20:]
    nees = [
        e @ np.linalg.solve(o.pose_cov[:3, :3], e)
        for e, o in zip(errors(simulation, known)[20:], found, strict=True)
    ]
    assert 0.8 < np.mean(nees) < 6.0


def loudest(items: list[Item], from_ns: int) -> str:
    """The RSU most often heard after ``from_ns``."""
    heard = [i.rsu_id for i in items if isinstance(i, RsuMeasurement) and i.stamp_ns > from_ns]
    return max(sorted(set(heard)), key=heard.count)


def test_a_lying_rsu_is_named_isolated_and_trusted_again() -> None:
    """A station turned by 40 degrees and 30 m off from 15 s to 50 s; it stands beside the road and
    is heard to the end. The device drives slowly so that it stays in sight."""
    simulation = simulated(
        5500, 90.0, (6, 8), **{"devices.0.speed_mps": 1.0, "devices.0.beacon_interval_s": 0.5}
    )
    start = simulation.scenario.start_ns
    items = items_of(simulation)
    liar = loudest(items, start + 15 * NS)

    def bent(item: Item) -> Item:
        lies = isinstance(item, RsuMeasurement) and item.rsu_id == liar
        if lies and start + 15 * NS < item.stamp_ns < start + 50 * NS:
            return replace(item, range_m=item.range_m + 30.0)  # type: ignore[call-arg]
        return item

    half = [bent(i) for i in items if i.stamp_ns < start + 45 * NS]
    outputs, tracker = run(simulation, half)
    report = {r.rsu_id: r for r in tracker.rsu_reports()}[liar]
    assert report.state is RsuState.EXCLUDED
    assert re.search(r"range late by (29|30|31)\.\d m", report.text)
    assert outputs[-1].status.rejected["isolated_rsu"] > 20
    assert all(r.state is not RsuState.EXCLUDED or r.rsu_id == liar for r in tracker.rsu_reports())
    assert np.abs(errors(simulation, outputs)[-30:]).max() < 1.5
    whole, tracker = run(simulation, map(bent, items))
    assert {r.rsu_id: r for r in tracker.rsu_reports()}[liar].state is RsuState.OK
    assert liar in whole[-1].status.sources
    free, _ = run(simulation, half, isolate_rsus=False)
    assert "isolated_rsu" not in free[-1].status.rejected


@pytest.mark.parametrize(
    ("option", "most"),
    [
        ({"nlos_probability": 0.4, "nlos_mean_excess_m": 3.0}, 0.85),
        ({"robust": "student_t"}, 0.97),
    ],
)
def test_blocked_paths_cost_less_with_the_options(option: dict[str, Any], most: float) -> None:
    """Two ranges in five come late by 3 m on average: too little for the gate."""
    found: list[list[float]] = []
    for seed in (5600, 5601):
        simulation = simulated(seed, 60.0, (4, 8))

        def late(item: Item) -> Item:
            if not isinstance(item, RsuMeasurement) or item.stamp_ns < 10 * NS:
                return item
            rng = generator(item.stamp_ns, f"{item.rsu_id}/late")
            excess = rng.exponential(3.0) if rng.random() < 0.4 else 0.0
            return replace(item, range_m=item.range_m + excess)

        bent = list(map(late, items_of(simulation)))
        outputs = [run(simulation, bent, isolate_rsus=False, **o)[0] for o in ({}, option)]
        found.append([rms(errors(simulation, o)[20:]) for o in outputs])
    plain, aware = np.mean(found, axis=0)
    assert aware < most * plain


@pytest.mark.parametrize("times", [False, True])
def test_a_station_that_lies_from_the_beginning_does_not_prevent_the_start(times: bool) -> None:
    """The nearest of four to eight stations is 40 m off: the first fixes go without it."""
    made = one_way if times else simulated
    simulation = made(5700, 25.0, (5, 8))
    items = items_of(simulation)
    liar = loudest([i for i in items if i.stamp_ns < simulation.scenario.start_ns + 10 * NS], 0)

    def bent(item: Item) -> Item:
        if not isinstance(item, RsuMeasurement) or item.rsu_id != liar:
            return item
        return replace(item, range_m=item.range_m + 40.0, toa_s=item.toa_s + 40.0 / 299_792_458.0)

    outputs, _ = run(simulation, map(bent, items))
    first = next(o for o in outputs if o.odometry is not None)
    assert first.status.stamp_ns - simulation.scenario.start_ns <= 8 * NS
    assert np.abs(errors(simulation, outputs)).max() < 4.0


def test_without_a_single_culprit_the_fix_says_less() -> None:
    """Two of four stations lie, each its own way: nobody is left out, the covariance grows."""
    simulation = simulated(5800, 3.0, (4, 4))
    beacon = next(e for e in simulation.events() if isinstance(e, Beacon))
    measured = simulation.measure(beacon)
    known = {rsu.rsu_id: Rsu.of(rsu) for rsu in simulation.rsus}

    def fix(lies: dict[int, float]) -> tuple[Array, Array]:
        bent = [replace(m, range_m=m.range_m + lies.get(i, 0.0)) for i, m in enumerate(measured)]
        found = sound_fix(epoch_rows_of(bent, known, None, ROWS_3D).rows, 1.5)
        assert found is not None
        return found

    place, cov = fix({})
    doubted, wide = fix({0: 60.0, 1: -25.0})
    assert np.linalg.norm(place - beacon.position) < 4.0
    assert np.trace(wide) > 10.0 * np.trace(cov)
    one, sure = fix({0: 60.0})
    assert np.linalg.norm(one - beacon.position) < 5.0
    assert np.trace(sure) < 10.0 * np.trace(cov)
    assert np.linalg.norm(doubted - beacon.position) > 5.0
