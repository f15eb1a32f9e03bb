"""A track after a silence: as after a first fix, with everything that is possible."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement, TrackState
from netpos.tracking import Tracker, TrackerConfig, TrackOutput

NS = 1_000_000_000
RANGE_SD_M = 0.2
# Four anchors on a car body, heard one after the other, 36 times a second in all
ANCHORS = {"a": (2.0, 1.0), "b": (-2.5, 0.9), "c": (-2.4, -1.1), "d": (1.9, -1.2)}


def info(name: str) -> RsuInfo:
    return RsuInfo(rsu_id=name, position=np.array([*ANCHORS[name], 0.0]))


def walk(rng: np.random.Generator, duration_s: float) -> tuple[Array, Array]:
    """Times (n,) every 1/36 s and positions (n, 2) under white acceleration of 0.5 m/s^2/sqrt(Hz)
    and a spring that keeps the device some 20 m from the anchors."""
    dt, n = 1.0 / 36.0, int(36 * duration_s)
    position, velocity = np.empty((n, 2)), rng.normal(0.0, 1.0, 2)
    position[0] = rng.uniform(-25.0, 25.0, 2)
    for k in range(1, n):
        pull = 0.01 * position[k - 1] + 0.1 * velocity
        velocity = velocity - dt * pull + 0.5 * np.sqrt(dt) * rng.normal(size=2)
        position[k] = position[k - 1] + dt * velocity
    return np.arange(n) * dt, position


def ranged(t_s: float, name: str, distance_m: float) -> RsuMeasurement:
    return RsuMeasurement(
        stamp_ns=NS + round(t_s * 1e9),
        rsu_id=name,
        vue_id="vue_1",
        fields=Field.RANGE,
        range_m=max(distance_m, 0.01),
        range_var=RANGE_SD_M**2,
    )


def tracker_of_anchors() -> Tracker:
    config = TrackerConfig(
        accel_density_mps2_sqrthz=0.5,
        initial_speed_sd_mps=2.0,
        coverage_radius_m=60.0,
        hold_s=0.0,
        max_gap_s=100.0,
    )
    tracker = Tracker(config)
    for name in ANCHORS:
        tracker.add_rsu(info(name))
    return tracker


def outputs_of(
    times: Array,
    position: Array,
    rng: np.random.Generator,
    silent_s: tuple[float, float],
    heard_after: tuple[str, ...] = tuple(ANCHORS),
) -> list[tuple[float, TrackOutput]]:
    """What the tracker says after the silence; ``heard_after``: the anchors heard then."""
    tracker = tracker_of_anchors()
    said = []
    for k, (t, p) in enumerate(zip(times, position, strict=True)):
        name = list(ANCHORS)[k % 4]
        if silent_s[0] <= t < silent_s[1] or (t >= silent_s[1] and name not in heard_after):
            continue
        distance = float(np.linalg.norm(p - ANCHORS[name]))
        tracker.add(ranged(t, name, distance + RANGE_SD_M * rng.normal()))
        said += [(t, output) for output in tracker.process() if t >= silent_s[1]]
    return said


@pytest.mark.parametrize("silence_s", [5.0, 15.0, 25.0, 40.0])
@pytest.mark.parametrize("seed", range(5))
def test_never_tracking_on_the_wrong_side(silence_s: float, seed: int) -> None:
    rng = np.random.default_rng([seed, int(silence_s)])
    times, position = walk(rng, 12.0 + silence_s + 8.0)
    said = outputs_of(times, position, rng, (12.0, 12.0 + silence_s))
    errors, tracking = [], 0
    for t, output in said:
        assert output.odometry is not None
        truth = [np.interp(t, times, position[:, axis]) for axis in (0, 1)]
        error = float(np.hypot(*(output.odometry.position[:2] - truth)))
        if output.status.state is TrackState.TRACKING:
            tracking += 1
            # the other side would be many levels away; chance may exceed one by a little
            assert error <= 1.5 * output.status.protection_level_m
        if t > 12.0 + silence_s + 4.0:
            errors.append(error)
    assert tracking > 0.8 * len(said)
    # who knows the place to 0.2 m along and some metres across the line of sight
    assert np.sqrt(np.mean(np.square(errors))) < 0.1 * np.abs(position[-1]).max() + 0.5


def test_two_anchors_leave_two_sides_and_the_status_says_so() -> None:
    """The truth is one of the modes, and odometry claims neither."""
    rng = np.random.default_rng(3)
    times, position = walk(rng, 40.0)
    said = outputs_of(times, position, rng, (12.0, 37.0), heard_after=("a", "b"))
    ambiguous = [(t, o) for t, o in said if o.status.state is TrackState.AMBIGUOUS]
    assert len(ambiguous) > 0.5 * len(said)
    t, output = ambiguous[-1]
    truth = np.array([np.interp(t, times, position[:, axis]) for axis in (0, 1)])
    modes = output.status.modes
    assert len(modes) >= 2
    assert sum(mode.weight for mode in modes) == pytest.approx(1.0, abs=1e-2)
    nearest = min(np.hypot(mode.x_m - truth[0], mode.y_m - truth[1]) for mode in modes)
    assert nearest < 3.0
    assert output.odometry is not None
    error = np.hypot(*(output.odometry.position[:2] - truth))
    assert error <= output.status.protection_level_m


@pytest.mark.parametrize("place", [0, 3, 20])
def test_what_comes_late_after_a_silence_is_applied_in_order(place: int) -> None:
    """The same bits, whether a range after the silence comes in time or ten ranges late."""
    rng = np.random.default_rng(9)
    times, position = walk(rng, 34.0)
    heard = []
    for k, (t, p) in enumerate(zip(times, position, strict=True)):
        name = list(ANCHORS)[k % 4]
        distance = float(np.linalg.norm(p - ANCHORS[name])) + RANGE_SD_M * rng.normal()
        if not 12.0 <= t < 32.0:
            heard.append(ranged(t, name, distance))
    first = next(i for i, m in enumerate(heard) if m.stamp_ns >= NS + 32 * NS) + place
    late = [*heard[:first], *heard[first + 1 : first + 11], heard[first], *heard[first + 11 :]]
    last = []
    for measurements in (heard, late):
        tracker = tracker_of_anchors()
        outputs: list[TrackOutput] = []
        for measurement in measurements:
            tracker.add(measurement)
            outputs += tracker.process()
        odometry = outputs[-1].odometry
        assert odometry is not None
        last.append((odometry.position.tobytes(), odometry.pose_cov.tobytes()))
    assert last[0] == last[1]
