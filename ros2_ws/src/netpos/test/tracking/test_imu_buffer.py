"""IMU increments against dense numerical integrals, and what the IMU is worth to a track."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, ImuSample, InitialPose, Odometry
from netpos.scenario import Simulation, load_scenario
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.estimators.imu_buffer import ImuBuffer

MS = 1_000_000
T0 = 1_000_000_000


def sample(stamp_ns: int, rate: float, force: float) -> ImuSample:
    return ImuSample(
        stamp_ns=stamp_ns,
        vue_id="vue_1",
        angular_velocity=np.array([7.0, -7.0, rate]),
        specific_force=np.array([force, 7.0, 9.8]),
    )


def filled(stamps: Array, rates: Array, forces: Array) -> ImuBuffer:
    buffer = ImuBuffer()
    for stamp, rate, force in zip(stamps.tolist(), rates, forces, strict=True):
        assert buffer.add(sample(stamp, rate, force)) is None
    return buffer


def dense(stamps: Array, values: Array, from_ns: int, to_ns: int) -> float:
    """Integral of the broken line through the samples by NumPy, on a grid with all its corners."""
    inside = stamps[(stamps > from_ns) & (stamps < to_ns)]
    t = np.unique(np.concatenate([[from_ns, to_ns], inside, np.linspace(from_ns, to_ns, 997)]))
    seconds = (t - stamps[0]) * 1e-9
    return float(np.trapezoid(np.interp(seconds, (stamps - stamps[0]) * 1e-9, values), seconds))


@pytest.mark.parametrize("seed", range(5))
def test_increments_are_integrals_between_any_two_stamps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = T0 + np.cumsum(rng.integers(MS, 50 * MS, 200))
    rates, forces = rng.normal(size=(2, 200))
    buffer = filled(stamps, rates, forces)
    for _ in range(40):
        ends = np.sort(rng.integers(stamps[0], stamps[-1] + 1, 2))
        if rng.random() < 0.3:
            ends = np.sort(rng.choice(stamps, 2))  # on samples
        if rng.random() < 0.2:
            ends[1] = ends[0] + 1000  # within one step
        yaw, speed, uncovered_s = buffer.increments(int(ends[0]), int(ends[1]))
        assert yaw == pytest.approx(dense(stamps, rates, *ends), abs=1e-9)
        assert speed == pytest.approx(dense(stamps, forces, *ends), abs=1e-9)
        assert uncovered_s == 0.0


def test_increments_add_up() -> None:
    rng = np.random.default_rng(9)
    stamps = T0 + np.arange(100) * 10 * MS
    buffer = filled(stamps, *rng.normal(size=(2, 100)))
    whole = buffer.increments(T0 + 3 * MS, T0 + 907 * MS)
    cuts = [T0 + ms * MS for ms in (3, 10, 11, 555, 560, 907)]
    parts = [buffer.increments(a, b) for a, b in pairwise(cuts)]
    np.testing.assert_allclose(np.sum(parts, axis=0), whole, atol=1e-12)
    assert buffer.increments(cuts[2], cuts[2]) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("silence_ms", "hole"), [(50, False), (51, True), (2000, True)])
def test_a_hole_is_left_out_and_told(silence_ms: int, hole: bool) -> None:
    """Up to 50 ms are a step, more is a hole: nothing is integrated over it."""
    stamps = np.array([0, 10, 20, 20 + silence_ms, 30 + silence_ms]) * MS + T0
    rates, forces = np.full(5, 0.5), np.full(5, -2.0)
    buffer = filled(stamps, rates, forces)
    yaw, speed, uncovered_s = buffer.increments(int(stamps[0]), int(stamps[-1]))
    covered = 0.03 if hole else 0.03 + silence_ms * 1e-3
    assert (yaw, speed) == (pytest.approx(0.5 * covered), pytest.approx(-2.0 * covered))
    assert uncovered_s == pytest.approx(silence_ms * 1e-3 if hole else 0.0, abs=1e-12)
    if hole:  # from its middle
        middle = int(stamps[2]) + silence_ms * MS // 4
        yaw, _, uncovered_s = buffer.increments(middle, int(stamps[-1]))
        assert yaw == pytest.approx(0.005)
        assert uncovered_s == pytest.approx(0.75 * silence_ms * 1e-3, abs=1e-6)


def test_before_the_first_and_after_the_last_sample_nothing_is_known() -> None:
    empty = ImuBuffer()
    assert empty.increments(T0, T0 + 2 * 10**9) == (0.0, 0.0, 2.0)
    stamps = T0 + np.arange(11) * 10 * MS
    buffer = filled(stamps, np.full(11, 1.0), np.full(11, 3.0))
    assert buffer.increments(T0 - 500 * MS, T0 - 200 * MS) == (0.0, 0.0, pytest.approx(0.3))
    yaw, speed, uncovered_s = buffer.increments(T0 - 200 * MS, T0 + 50 * MS)
    assert (yaw, speed) == (pytest.approx(0.05), pytest.approx(0.15))
    assert uncovered_s == pytest.approx(0.2)
    yaw, speed, uncovered_s = buffer.increments(T0 + 50 * MS, T0 + 400 * MS)
    assert (yaw, speed) == (pytest.approx(0.05), pytest.approx(0.15))
    assert uncovered_s == pytest.approx(0.3)
    assert buffer.increments(T0 + 200 * MS, T0 + 400 * MS) == (0.0, 0.0, pytest.approx(0.2))


def test_duplicates_and_late_samples_change_nothing() -> None:
    stamps = T0 + np.arange(11) * 10 * MS
    buffer = filled(stamps, np.arange(11.0), -np.arange(11.0))
    before = buffer.increments(T0, T0 + 100 * MS)
    assert buffer.add(sample(T0 + 100 * MS, 99.0, 99.0)) == "duplicate"
    assert buffer.add(sample(T0 + 99 * MS, 99.0, 99.0)) == "late"
    assert buffer.increments(T0, T0 + 100 * MS) == before
    assert buffer.add(sample(T0 + 101 * MS, 1.0, 1.0)) is None


def test_the_past_is_trimmed_and_the_last_minute_kept() -> None:
    buffer = ImuBuffer()
    step, most = 40 * MS, 0
    rng = np.random.default_rng(1)
    rates = rng.normal(size=10_000)
    for k, rate in enumerate(rates):
        assert buffer.add(sample(T0 + k * step, rate, 0.0)) is None
        most = max(most, len(buffer._stamps))
    assert most <= 140_000_000_000 // step + 2
    assert 6 * len(buffer._stamps) == len(buffer._rates) == 6 * len(buffer._integrals)
    stamps = T0 + np.arange(10_000) * step
    for age_s in (69.0, 30.0, 0.5):
        start = int(stamps[-1]) - round(age_s * 1e9)
        yaw, _, uncovered_s = buffer.increments(start, int(stamps[-1]))
        assert yaw == pytest.approx(dense(stamps, rates, start, int(stamps[-1])), abs=1e-7)
        assert uncovered_s == 0.0


# in the tracker


def turn(seed: int) -> tuple[Any, list[Any]]:
    """The shipped intersection: RSUs and everything in time order, truth included."""
    simulation = Simulation(load_scenario("intersection_turn", seed=seed))
    items: list[Any] = []
    for event in simulation.events():
        if isinstance(event, Odometry | ImuSample | InitialPose):
            items.append(event)
        elif type(event).__name__ == "Beacon":
            items += simulation.measure(event)
    return simulation, items


def errors(simulation: Any, items: list[Any], imu_until_s: float, **change: Any) -> Array:
    """Position errors and squared Mahalanobis distances (n, 2) after the first 3 s."""
    config = TrackerConfig.from_mapping(dict(simulation.scenario.tracker) | change)
    tracker = Tracker(config)
    for info in simulation.rsus:
        tracker.add_rsu(info)
    true, outputs = {}, []
    start_ns = items[0].stamp_ns
    for item in items:
        if isinstance(item, Odometry):
            true[item.stamp_ns] = item.position[:2]
        elif not isinstance(item, ImuSample) or item.stamp_ns < start_ns + imu_until_s * 1e9:
            tracker.add(item)
            outputs += tracker.process()
    found = []
    for output in outputs + tracker.flush():
        stamp = output.status.stamp_ns
        if output.odometry is not None and stamp in true and stamp > start_ns + 3 * 10**9:
            assert np.isfinite(output.odometry.pose_cov).all()
            e = output.odometry.position[:2] - true[stamp]
            nees = e @ np.linalg.solve(output.odometry.pose_cov[:2, :2], e)
            found.append((math.hypot(*e), nees))
    assert len(found) > 100
    return np.array(found)


RUNS = [turn(seed) for seed in range(5)]


def test_the_imu_is_worth_its_weight() -> None:
    """RMSE of the shipped turn over five seeds, with and without; and it is consistent."""
    rmse = {"inertial": [], "constant_velocity": []}
    nees = []
    for simulation, items in RUNS:
        for model, found in rmse.items():
            e = errors(simulation, items, math.inf, motion_model=model)
            found.append(math.sqrt(np.mean(e[:, 0] ** 2)))
            if model == "inertial":
                nees.append(np.mean(e[:, 1]))
    assert np.mean(rmse["inertial"]) < 0.75 * np.mean(rmse["constant_velocity"]), rmse
    assert np.mean(nees) < 2.0 * 2.0, nees  # 2 for a consistent filter; runs are few


@pytest.mark.parametrize("until_s", [0.0, 8.0])
def test_without_its_imu_the_track_is_worse_and_says_so(until_s: float) -> None:
    """No sample ever, or none after 8 s: the heading opens, the covariance keeps up."""
    nees = []
    for simulation, items in RUNS:
        e = errors(simulation, items, until_s, motion_model="inertial")
        nees.append(np.mean(e[:, 1]))
        assert e[:, 0].max() < 20.0
    assert np.mean(nees) < 3.0 * 2.0, nees
