"""Odometry between the epochs of a strapdown track, and smoothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from netpos.messages.values import Array, Beacon, ImuSample, Odometry, RsuMeasurement
from netpos.scenario import Simulation, load_scenario
from netpos.tracking import Tracker, TrackerConfig, TrackOutput

NS = 1_000_000_000
VUE = "vue_1"
Item = RsuMeasurement | ImuSample


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    changes = {"max_duration_s": 60.0, "measurement.fewest": 3, "measurement.nearest": 5}
    return Simulation(load_scenario("blocked_5g_drive", seed=5000, changes=changes))


@pytest.fixture(scope="module")
def items(simulation: Simulation) -> list[Item]:
    beacons = [e for e in simulation.events() if isinstance(e, Beacon)]
    measured = [m for beacon in beacons for m in simulation.measure(beacon)]
    return sorted([*simulation.imu(VUE), *measured], key=lambda item: item.stamp_ns)


def run(
    simulation: Simulation, items: list[Item], *, smooth: bool = False, **changes: object
) -> tuple[list[TrackOutput], list[Odometry]]:
    parameters = {**simulation.scenario.tracker, **changes}
    tracker = Tracker(TrackerConfig.from_mapping(parameters), keep_posteriors=smooth)
    for rsu in simulation.rsus:
        tracker.add_rsu(rsu)
    outputs = []
    for item in items:
        tracker.add(item)
        outputs += tracker.process()
    outputs += tracker.flush()
    return outputs, tracker.smoothed()[VUE] if smooth else []


def rows(outputs: list[TrackOutput]) -> dict[int, list[float]]:
    return {
        o.odometry.stamp_ns: [*o.odometry.position, *o.odometry.pose_cov.ravel()]
        for o in outputs
        if o.odometry is not None
    }


def truth(simulation: Simulation, found: list[Odometry]) -> Array:
    return simulation.truth(VUE, np.array([o.stamp_ns for o in found])).position


@pytest.mark.parametrize("rate_hz", [20.0, 100.0])
def test_odometry_between_epochs_leaves_the_epochs_as_they_are(
    simulation: Simulation, items: list[Item], rate_hz: float
) -> None:
    """Bit for bit, at every multiple of the interval, as good as an INS of a second is."""
    sparse, dense = (rows(run(simulation, items, odometry_rate_hz=r)[0]) for r in (0.0, rate_hz))
    assert all(dense[stamp] == value for stamp, value in sparse.items())
    stamps = sorted(dense)
    np.testing.assert_array_equal(np.diff(stamps), round(NS / rate_hz))
    assert stamps[-1] - stamps[0] > 50 * NS
    places = np.array([dense[s][:3] for s in stamps])
    error = places - simulation.truth(VUE, np.array(stamps)).position
    epochs = np.isin(stamps, sorted(sparse))
    assert np.sqrt((error[~epochs][500:] ** 2).mean()) < 1.3 * np.sqrt((error[epochs] ** 2).mean())


def test_what_comes_in_another_order_gives_the_same_odometry(
    simulation: Simulation, items: list[Item]
) -> None:
    """Measurements 0.3 s after their IMU samples, as over a slow network, within the hold."""
    late = sorted(
        items, key=lambda i: i.stamp_ns + (300_000_000 if isinstance(i, RsuMeasurement) else 0)
    )
    first = rows(run(simulation, items, odometry_rate_hz=50.0)[0])
    assert rows(run(simulation, late, odometry_rate_hz=50.0)[0]) == first


def test_a_late_measurement_is_applied_behind_the_ticks(
    simulation: Simulation, items: list[Item]
) -> None:
    """Nothing is held: a measurement 0.3 s late changes the estimate it belongs to."""
    late = sorted(
        items, key=lambda i: i.stamp_ns + (300_000_000 if isinstance(i, RsuMeasurement) else 0)
    )
    outputs, _ = run(simulation, late, odometry_rate_hz=50.0, hold_s=0.0)
    in_time = rows(run(simulation, items, odometry_rate_hz=50.0)[0])
    revised = rows([o for o in outputs if o.revised])
    assert len(revised) > 40
    assert outputs[-1].status.rejected.get("late", 0) == 0
    for stamp, values in revised.items():  # of one stamp the last counts
        if stamp > simulation.scenario.start_ns + 10 * NS:
            np.testing.assert_allclose(values[:3], in_time[stamp][:3], atol=1e-6)


def test_smoothing_halves_the_error_and_knows_it(
    simulation: Simulation, items: list[Item]
) -> None:
    outputs, smoothed = run(simulation, items, smooth=True)
    found = [o.odometry for o in outputs if o.odometry is not None]
    assert [o.stamp_ns for o in smoothed] == [o.stamp_ns for o in found]
    np.testing.assert_array_equal(smoothed[-1].position, found[-1].position)
    before = np.array([o.position for o in found]) - truth(simulation, found)
    after = np.array([o.position for o in smoothed]) - truth(simulation, smoothed)
    assert np.sqrt((after**2).mean()) < 0.75 * np.sqrt((before**2).mean())
    nees = [
        e @ np.linalg.solve(o.pose_cov[:3, :3], e) for e, o in zip(after, smoothed, strict=True)
    ]
    assert 1.0 < np.mean(nees) < 6.0
    for later, earlier in zip(smoothed, found, strict=True):
        slack = np.linalg.eigvalsh(earlier.pose_cov - later.pose_cov)
        assert slack.min() > -1e-9 * earlier.pose_cov.max()


def test_an_outage_is_bridged_from_both_ends(simulation: Simulation, items: list[Item]) -> None:
    start = simulation.scenario.start_ns
    heard = [
        i for i in items
        if isinstance(i, ImuSample) or not start + 30 * NS < i.stamp_ns < start + 45 * NS
    ]  # fmt: skip
    outputs, smoothed = run(simulation, heard, smooth=True, odometry_rate_hz=1.0)
    assert {o.stamp_ns for o in smoothed} <= {o.status.stamp_ns for o in outputs}
    assert max(np.diff([o.stamp_ns for o in smoothed])) == 15 * NS
    error = np.array([o.position for o in smoothed]) - truth(simulation, smoothed)
    assert np.abs(error).max() < 2.0


def test_smoothing_a_restarted_and_revised_track_is_in_order(
    simulation: Simulation, items: list[Item]
) -> None:
    """Late measurements and a gap that ends the track: passages apart, every epoch once."""
    start = simulation.scenario.start_ns
    cut = [i for i in items if not start + 25 * NS < i.stamp_ns < start + 32 * NS]
    late = sorted(
        cut,
        key=lambda i: (
            i.stamp_ns
            + (1_500_000_000 if isinstance(i, RsuMeasurement) and i.stamp_ns // NS % 5 == 0 else 0)
        ),
    )
    changes = {"hold_s": 0.0, "history_s": 3.0, "max_gap_s": 5.0}
    outputs, smoothed = run(simulation, late, smooth=True, **changes)
    stamps = [o.stamp_ns for o in smoothed]
    assert stamps == sorted(set(stamps))
    assert any(o.revised for o in outputs)
    _, in_time = run(simulation, cut, smooth=True, **changes)
    common = [(a, b) for a in smoothed for b in in_time if a.stamp_ns == b.stamp_ns]
    assert len(common) == len(in_time)
    for a, b in common:
        np.testing.assert_allclose(a.position, b.position, atol=1e-6)


def test_a_planar_track_reports_at_its_epochs_whatever_the_rate() -> None:
    tracker = Tracker(TrackerConfig(motion_model="inertial", odometry_rate_hz=100.0))
    sample = ImuSample(
        stamp_ns=NS, vue_id=VUE, angular_velocity=np.zeros(3), specific_force=np.ones(3)
    )
    for k in range(300):
        tracker.add(replace(sample, stamp_ns=NS + k * 10_000_000))
    assert tracker.process() == []
