"""All devices: what is refused and counted, order, services, robustness."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from netpos.estimation.state import X
from netpos.messages.values import (
    AngleConvention,
    Field,
    GroundSpeed,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    Velocity,
)
from netpos.tracking import Tracker, TrackerConfig, TrackOutput

T0 = 1_000_000_000
STATE = np.array([30.0, 0.0, 5.0, 0.0, 0.0, 0.0])


def at(t_s: float) -> np.ndarray:
    state = STATE.copy()
    state[X.PX] += 5.0 * t_s
    return state


def bits(outputs: list[TrackOutput]) -> list[bytes]:
    """Every number an output carries, bit by bit."""
    out = []
    for o in outputs:
        status = o.status
        numbers = [status.stamp_ns, status.nis, status.position_sd_m, status.accepted]
        numbers.append(status.protection_level_m)
        parts = [
            np.array(numbers, dtype=float),
            *(
                []
                if o.odometry is None
                else [
                    o.odometry.position,
                    o.odometry.quaternion,
                    o.odometry.linear_velocity,
                    o.odometry.pose_cov,
                    o.odometry.twist_cov,
                ]
            ),
        ]
        if o.clock is not None:
            parts += [np.array([o.clock.offset_s, o.clock.drift]), o.clock.cov]
        text = str((status.vue_id, status.state, status.sources, sorted(status.rejected.items())))
        out.append(b"".join(np.ascontiguousarray(p).tobytes() for p in parts) + text.encode())
    return out


# refusals


def good(**change: Any) -> RsuMeasurement:
    values: dict[str, Any] = {
        "stamp_ns": T0 + 10**9,
        "rsu_id": "a",
        "vue_id": "vue_1",
        "expected": 1,
        "fields": Field.RANGE,
        "range_m": 31.0,
        "range_var": 0.1,
    }
    return RsuMeasurement(**(values | change))


REFUSED = [
    ("unknown_rsu", good(rsu_id="nobody")),
    ("not_finite", good(range_m=math.nan)),
    ("not_finite", good(range_m=math.inf)),
    ("not_finite", good(range_var=math.nan)),
    ("variance", good(range_var=0.0)),
    ("variance", good(range_var=-0.1)),
    ("zero_stamp", good(stamp_ns=0)),
    ("no_fields", good(fields=Field(0))),
    ("unknown_fields", good(fields=Field(128 | 8))),
    ("no_baseline", good(fields=Field.PHASE, phase_difference_var=0.1)),
    (
        "phase_not_wrapped",
        good(fields=Field.PHASE, phase_difference_rad=3.2, phase_difference_var=0.1),
    ),
    ("negative_range", good(range_m=-1.0)),
    (
        "frame",
        Velocity(stamp_ns=T0, vue_id="vue_1", frame_id="odom", velocity=np.ones(2), cov=np.eye(2)),
    ),
    ("variance", Velocity(stamp_ns=T0, vue_id="vue_1", velocity=np.ones(2), cov=-np.eye(2))),
    ("not_finite", GroundSpeed(stamp_ns=T0, vue_id="vue_1", speed_mps=math.nan, speed_var=1.0)),
    (
        "variance",
        InitialPose(stamp_ns=T0, vue_id="vue_1", position=np.zeros(3), cov=np.zeros((3, 3))),
    ),
]


@pytest.mark.parametrize(("reason", "item"), REFUSED)
def test_refused_with_its_reason_and_counted(world: Any, reason: str, item: Any) -> None:
    tracker = world.tracker()
    assert tracker.add(item) == reason
    assert tracker.add(item) == reason
    assert tracker.rejected() == {"vue_1": {reason: 2}}
    (told,) = tracker.process()
    assert told.odometry is None
    assert (told.status.state, told.status.rejected) == (TrackState.WAITING, {reason: 2})
    assert told.status.reason.startswith(f"all refused: {reason}: ")
    assert tracker.flush() == []


@pytest.mark.parametrize("history_s", [0.0, 0.1])
def test_late_and_duplicate_are_counted_in_the_status(
    world: Any, feed: Any, history_s: float
) -> None:
    tracker = world.tracker(history_s=history_s)
    feed(tracker, world.measure(1.0, at(1.0)))
    assert tracker.add(world.measure(1.0, at(1.0))[0]) == "duplicate"
    tracker.add_rsu(replace(world.rsus["a"], rsu_id="z"))  # whose other stamps are not near
    late = world.measure(1.0 - history_s - 1e-9, at(1.0))[0]
    assert tracker.add(replace(late, rsu_id="z")) == "late"
    (output,) = feed(tracker, world.measure(1.1, at(1.1)))
    assert output.status.rejected == {"duplicate": 1, "late": 1}


def test_disabled_refuses_everything_until_enabled(world: Any, feed: Any) -> None:
    tracker = world.tracker()
    assert tracker.enabled
    tracker.enabled = False
    for item in world.measure(0.0, at(0.0)):
        assert tracker.add(item) == "disabled"
    assert tracker.add(good(rsu_id="nobody")) == "disabled"
    assert tracker.flush() == []
    tracker.enabled = True
    assert len(feed(tracker, world.measure(0.1, at(0.1)))) == 1
    assert tracker.rejected()["vue_1"]["disabled"] == 4


def test_no_initial_pose(world: Any, feed: Any) -> None:
    tracker = world.tracker(require_initial_pose=True)
    (output,) = feed(tracker, world.measure(0.0, at(0.0)))
    assert output.odometry is None
    assert output.status.rejected == {"no_initial_pose": 3}
    assert output.status.state is TrackState.WAITING
    pose = InitialPose(
        stamp_ns=T0 + 10**8, vue_id="vue_1", position=np.array([31.0, 1.0, 0.0]), cov=np.eye(3)
    )
    (output,) = feed(tracker, [pose])
    assert output.odometry is not None
    (output,) = feed(tracker, world.measure(0.2, at(0.2)))
    assert output.status.used == 3
    assert output.status.rejected == {"no_initial_pose": 3}


def test_rsu_refused() -> None:
    tracker = Tracker()
    with pytest.raises(ValueError, match="RSU refused: orientation of a is not a unit quaternion"):
        tracker.add_rsu(RsuInfo(rsu_id="a", position=np.zeros(3), quaternion=np.zeros(4)))
    assert tracker.rsu_count == 0
    assert tracker.add(good()) == "unknown_rsu"


def test_rsu_replaced(world: Any, feed: Any) -> None:
    """With ``trust: any`` a corrected description is used from then on."""
    tracker = world.tracker(trust="any")
    assert tracker.rsu_count == 3
    for info in world.rsus.values():
        tracker.add_rsu(replace(info, position=info.position + np.array([1000.0, 0.0, 0.0])))
    assert tracker.rsu_count == 3
    (output,) = feed(tracker, world.measure(0.0, at(0.0)))
    np.testing.assert_allclose(output.odometry.position[:2], [1030.0, 0.0], atol=0.2)


def test_config_is_the_effective_one() -> None:
    config = TrackerConfig(hold_s=0.5)
    assert Tracker(config).config is config
    assert Tracker().config == TrackerConfig()


# devices and order


def run(world: Any, order: Callable[[list[Any]], Any], hold_s: float) -> list[bytes]:
    tracker = world.tracker(hold_s=hold_s)
    outputs: list[TrackOutput] = []
    for k in range(30):
        t = 0.1 * k
        velocity = Velocity(
            stamp_ns=T0 + round(t * 1e9),
            vue_id="vue_1",
            velocity=np.array([5.0, 0.0]),
            cov=0.1 * np.eye(2),
        )
        world.rng = np.random.default_rng(k)
        for item in order([*world.measure(t, at(t)), velocity]):
            assert tracker.add(item) is None
            if k:
                outputs += tracker.process()
    return bits(outputs + tracker.flush())


def test_same_input_twice_is_bit_identical(world: Any) -> None:
    first = run(world, list, 0.25)
    assert len(first) == 30
    assert run(world, list, 0.25) == first


def test_order_of_arrival_within_the_hold_is_bit_identical(world: Any) -> None:
    first = run(world, list, 0.25)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        shuffled = run(world, lambda items, r=rng: [items[i] for i in r.permutation(4)], 0.25)
        assert shuffled == first
    for order in permutations(range(4)):
        assert run(world, lambda items, o=order: [items[i] for i in o], 0.25) == first


def test_two_devices_do_not_disturb_each_other(world: Any, feed: Any) -> None:
    def alone(vue_id: str, y: float) -> list[bytes]:
        tracker = world.tracker()
        out: list[TrackOutput] = []
        for k in range(10):
            state = at(0.1 * k) + np.array([0, y, 0, 0, 0, 0])
            out += feed(tracker, world.measure(0.1 * k, state, vue_id=vue_id))
        return bits(out)

    tracker = world.tracker()
    out: list[TrackOutput] = []
    for k in range(10):
        for vue_id, y in (("vue_2", 4.0), ("vue_1", 0.0)):
            state = at(0.1 * k) + np.array([0, y, 0, 0, 0, 0])
            for m in world.measure(0.1 * k, state, vue_id=vue_id):
                assert tracker.add(m) is None
        out += tracker.process()
    assert [o.status.vue_id for o in out[:2]] == ["vue_1", "vue_2"]  # device by device
    for vue_id, y in (("vue_1", 0.0), ("vue_2", 4.0)):
        assert bits([o for o in out if o.status.vue_id == vue_id]) == alone(vue_id, y)
    assert tracker.add(good(vue_id="vue_3", rsu_id="nobody")) == "unknown_rsu"
    assert set(tracker.rejected()) == {"vue_1", "vue_2", "vue_3"}


def test_hold_is_in_seconds(world: Any) -> None:
    """An incomplete epoch waits for 0.25 s of newer stamps."""
    tracker = world.tracker(hold_s=0.25)
    speed = {"vue_id": "vue_1", "speed_mps": 5.0, "speed_var": 1.0}
    tracker.add(GroundSpeed(stamp_ns=T0 - 10**8, **speed))
    tracker.process()
    assert tracker.add(world.measure(0.0, at(0.0))[0]) is None
    tracker.add(GroundSpeed(stamp_ns=T0 + 249_999_999, **speed))
    assert tracker.process() == []
    tracker.add(GroundSpeed(stamp_ns=T0 + 250_000_000, **speed))
    assert next(o.status.stamp_ns for o in tracker.process()) == T0


def test_reset_forgets_tracks_and_pending_but_not_rsus_or_counts(world: Any, feed: Any) -> None:
    tracker = world.tracker(hold_s=0.25)
    feed(tracker, world.measure(10.0, at(0.0)))
    tracker.add(world.measure(11.0, at(1.0))[0])
    tracker.add(good(rsu_id="nobody"))
    tracker.reset()
    assert tracker.flush() == []
    assert tracker.rsu_count == 3
    # the clock jumped back: what would have been late is welcome
    (output,) = feed(tracker, world.measure(1.0, at(0.0), Field.RANGE, ["a"]))
    assert output.odometry is None
    assert output.status.state is TrackState.WAITING
    assert output.status.rejected == {"unknown_rsu": 1}
    assert output.status.accepted == 3


# robustness

VALUES = st.sampled_from([0.0, 1e-9, 0.5, 1.0, 3.0, -2.0, 20.0, 50.0] * 3 + [1e4, -9e8, math.nan])
VARIANCES = st.sampled_from([1e-6, 1e-4, 0.01, 0.1, 1.0, 1e6] * 4 + [0.0, -1.0, 1e300, math.inf])


@st.composite
def measurements(draw: st.DrawFn) -> RsuMeasurement:
    return RsuMeasurement(
        stamp_ns=T0 + draw(st.integers(0, 50)) * draw(st.sampled_from([0, 10**8, 10**9])),
        rsu_id=draw(st.sampled_from("abc")),
        vue_id="vue_1",
        fields=Field(draw(st.integers(0, 127))),
        azimuth_rad=draw(VALUES),
        azimuth_var=draw(VARIANCES),
        elevation_rad=draw(VALUES),
        elevation_var=draw(VARIANCES),
        toa_s=draw(VALUES) * 1e-7,
        toa_var=draw(VARIANCES) * 1e-17,
        range_m=draw(VALUES),
        range_var=draw(VARIANCES),
        phase_difference_var=1.0,
        position=np.array([draw(VALUES), draw(VALUES), 0.0]),
        position_cov=np.diag([draw(VARIANCES), draw(VARIANCES), 1.0]),
    )


@st.composite
def others(draw: st.DrawFn) -> Any:
    stamp = T0 + draw(st.integers(0, 50)) * 10**8
    match draw(st.integers(0, 2)):
        case 0:
            return GroundSpeed(
                stamp_ns=stamp, vue_id="vue_1", speed_mps=draw(VALUES), speed_var=draw(VARIANCES)
            )
        case 1:
            return Velocity(
                stamp_ns=stamp,
                vue_id="vue_1",
                velocity=np.array([draw(VALUES), draw(VALUES)]),
                cov=np.diag([draw(VARIANCES), draw(VARIANCES)]),
            )
        case _:
            return InitialPose(
                stamp_ns=stamp,
                vue_id="vue_1",
                position=np.array([draw(VALUES), draw(VALUES), 0.0]),
                cov=np.diag([draw(VARIANCES), draw(VARIANCES), 1.0]),
            )


CONFIGS = st.fixed_dictionaries(
    {
        "filter": st.sampled_from(["ekf", "iekf", "ukf", "srukf"]),
        "process_noise": st.sampled_from(["continuous", "werner", "white_acceleration"]),
        "gate_probability": st.sampled_from([0.99, 1.0]),
        "manoeuvre_speed_sd_mps": st.sampled_from([0.0, 5.0]),
        "clock_offset_sd_s": st.sampled_from([0.0, 1e-4]),
        "clock_drift_sd": st.sampled_from([0.0, 3e-5]),
        "clock_walk_density": st.sampled_from([0.0, 1e-30, 2.5e-7]),
    }
)


def station(rsu_id: str) -> RsuInfo:
    """Tilted nowhere, biased everywhere; one is a linear array."""
    return RsuInfo(
        rsu_id=rsu_id,
        position=np.array([{"a": 0.0, "b": 60.0, "c": 120.0}[rsu_id], 5.0, 3.0]),
        angle_convention=AngleConvention(int(rsu_id == "c")),
        range_bias_sd_m=0.5 if rsu_id == "b" else 0.0,
        azimuth_bias_sd_rad=0.05 if rsu_id == "b" else 0.0,
        bias_correlation_time_s=10.0,
        common_range_bias_sd_m=0.2,
        common_bias_correlation_time_s=5.0,
        noise_correlation_time_s=0.3,
    )


def numbers(output: TrackOutput) -> Iterator[np.ndarray]:
    status = output.status
    yield np.array([status.nis, status.position_sd_m, status.protection_level_m])
    if output.odometry is not None:
        o = output.odometry
        yield from (o.position, o.quaternion, o.linear_velocity)
        yield from (o.pose_cov.reshape(-1), o.twist_cov.reshape(-1))
    if output.clock is not None:
        yield np.array([output.clock.offset_s, output.clock.drift, *output.clock.cov.reshape(-1)])


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(CONFIGS, st.lists(st.one_of(measurements(), measurements(), others()), max_size=25))
def test_whatever_comes_nothing_raises_and_no_nan_leaves(config: Any, items: list[Any]) -> None:
    tracker = Tracker(TrackerConfig(hold_s=0.1, **config))
    for rsu_id in "abc":
        tracker.add_rsu(station(rsu_id))
    refused = conflicts = 0
    for item in items:
        reason = tracker.add(item)
        refused += reason not in (None, "clock_ahead", "conflict")
        conflicts += reason == "conflict"
        for output in tracker.process():
            assert all(np.isfinite(part).all() for part in numbers(output))
    for output in tracker.flush():
        assert all(np.isfinite(part).all() for part in numbers(output))
    later = {"gate", "track_lost", "no_initial_pose", "initialpose", "diverged"}
    later |= {"clock_ahead", "conflict"}
    counted = [pair for counts in tracker.rejected().values() for pair in counts.items()]
    assert sum(n for reason, n in counted if reason not in later) == refused
    # The first of two that differ was taken, and is refused with the second.
    in_conflict = sum(n for reason, n in counted if reason == "conflict")
    assert conflicts <= in_conflict <= 2 * conflicts
