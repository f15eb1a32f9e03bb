"""Dead-reckoning core on synthetic walks with known path, and on broken input."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.pdr_output import StepEvent, StepVelocity, step_velocity
from netpos.inertial.steps import StepConfig
from scipy.spatial.transform import Rotation

G = 9.80665
FIELD_MAP = np.array([0.0, 18e-6, -45e-6])
RATE_HZ = 100.0
CADENCE_HZ = 1.8


@dataclass
class Walk:
    stamps: np.ndarray  # (n,)
    rate: np.ndarray  # (n, 3)
    force: np.ndarray  # (n, 3)
    field: np.ndarray  # (n, 3)


def walk(
    heading_deg: float = 0.0,
    turn_deg: float = 0.0,
    walk_s: float = 20.0,
    rest_s: tuple[float, float] = (3.0, 4.0),
    start_ns: int = 10**18,
) -> Walk:
    """Rest, straight walk (after half of it a turn in one second), rest; level body."""
    t = np.arange(0.0, rest_s[0] + walk_s + rest_s[1], 1 / RATE_HZ)
    u = (t - rest_s[0]) * CADENCE_HZ
    ramp = np.clip(np.minimum(u, walk_s * CADENCE_HZ - u) + 0.25, 0.0, 1.0)
    yaw_rate = np.where(np.abs(t - rest_s[0] - walk_s / 2) < 0.5, math.radians(turn_deg), 0.0)
    yaw = math.radians(heading_deg) + np.cumsum(yaw_rate) / RATE_HZ
    force = np.column_stack([0 * t, 0 * t, G - 2.5 * ramp * np.cos(2 * np.pi * u)])
    rng = np.random.default_rng(4)
    return Walk(
        start_ns + np.rint(t * 1e9).astype(np.int64),
        np.column_stack([0 * t, 0 * t, yaw_rate]) + rng.normal(scale=0.01, size=(t.size, 3)),
        force + rng.normal(scale=0.02, size=(t.size, 3)),
        Rotation.from_rotvec(np.outer(yaw, [0.0, 0.0, 1.0])).inv().apply(FIELD_MAP),
    )


def run(
    w: Walk, config: PdrConfig | None = None, magnetic: bool = False
) -> tuple[PedestrianDeadReckoning, list[StepEvent], list[StepVelocity]]:
    core = PedestrianDeadReckoning(config)
    events: list[StepEvent] = []
    velocities: list[StepVelocity] = []
    for i, stamp in enumerate(w.stamps.tolist()):
        out = core.add_imu(stamp, w.rate[i], w.force[i])
        if magnetic:
            core.add_magnetic_field(stamp, w.field[i])
        if out is None:
            continue
        assert all(e.stamp_ns == stamp for e in out.steps)
        events += out.steps
        if out.velocity is not None:
            assert out.velocity.stamp_ns == stamp
            velocities.append(out.velocity)
    return core, events, velocities


def heading_error(event: StepEvent, heading_deg: float) -> float:
    d = event.heading_rad - math.radians(heading_deg)
    return abs(math.atan2(math.sin(d), math.cos(d)))


@pytest.mark.parametrize("heading_deg", [-135.0, 0.0, 60.0, 180.0])
def test_straight_walk_with_magnetometer_heads_along_the_map(heading_deg: float) -> None:
    core, events, velocities = run(walk(heading_deg), magnetic=True)
    assert len(events) == round(20.0 * CADENCE_HZ)
    assert [e.count for e in events] == list(range(1, len(events) + 1))
    for e in events:
        assert e.length_sd_m == pytest.approx(math.hypot(0.1, 0.06) * e.length_m)
        assert e.heading_reference == "map"
        assert heading_error(e, heading_deg) < 0.04  # tilt error times tan(dip)
        assert e.cadence_hz == pytest.approx(CADENCE_HZ, rel=0.2)
    walking = [v for v in velocities if v.moving and np.any(v.velocity != 0)]
    speed = np.array([np.linalg.norm(v.velocity) for v in walking])
    lengths = np.array([e.length_m for e in events])
    assert float(np.median(speed)) == pytest.approx(float(np.median(lengths)) * 1.8, rel=0.03)
    unit = np.array([math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))])
    for v in walking:
        assert float(v.velocity @ unit) == pytest.approx(
            float(np.linalg.norm(v.velocity)), rel=1e-3
        )
    assert core.counters.get("magnetic_disturbed", 0) == 0


def test_without_magnetometer_the_first_heading_is_zero_and_the_turn_is_kept() -> None:
    _, events, _ = run(walk(heading_deg=75.0, turn_deg=90.0))
    assert {e.heading_reference for e in events} == {"relative"}
    middle = 10**18 + 13 * 10**9
    for e in events:
        if e.end_ns < middle - 10**9:
            assert heading_error(e, 0.0) < 0.03
        if e.start_ns > middle + 10**9:
            assert heading_error(e, 90.0) < 0.03


def test_mount_heading_turns_the_path() -> None:
    _, events, _ = run(walk(30.0), PdrConfig(mount_heading_rad=-math.pi / 2), magnetic=True)
    assert max(heading_error(e, -60.0) for e in events) < 0.04


def test_device_tilt_does_not_change_steps_or_heading() -> None:
    """Pitch and roll of the mounting leave count, length and heading alone."""
    w = walk(0.0)
    _, reference, _ = run(w)
    for angles in ([0.0, 35.0, 0.0], [0.0, 0.0, 80.0], [0.0, -20.0, 40.0]):
        r = Rotation.from_euler("ZYX", angles, degrees=True).inv()
        tilted = Walk(w.stamps, r.apply(w.rate), r.apply(w.force), r.apply(w.field))
        _, events, _ = run(tilted)
        assert [e.end_ns for e in events] == [e.end_ns for e in reference]
        assert events[5].length_m == pytest.approx(reference[5].length_m, rel=1e-6)
        assert max(heading_error(e, 0.0) for e in events) < 0.05  # 20 s of gyro noise


def test_rest_gives_a_tight_zero_and_the_walk_does_not() -> None:
    config = PdrConfig(still_speed_sd_mps=0.04)
    w = walk()
    _, _, velocities = run(w, config)
    t = np.array([v.stamp_ns - 10**18 for v in velocities]) * 1e-9
    for i, v in enumerate(velocities):
        if 1.2 < t[i] < 2.8 or t[i] > 25.0:
            assert not v.moving
            np.testing.assert_array_equal(v.velocity, 0.0)
            np.testing.assert_allclose(v.covariance, 0.04**2 * np.eye(2))
        if 3.6 < t[i] < 22.5:
            assert v.moving
            assert np.trace(v.covariance) > 0.005


def test_before_the_bout_is_confirmed_the_velocity_is_undecided() -> None:
    config = PdrConfig(undecided_speed_sd_mps=1.3)
    _, events, velocities = run(walk(), config)
    opening = [v for v in velocities if 10**18 + 3.7e9 < v.stamp_ns < events[0].stamp_ns]
    assert opening
    for v in opening:
        assert v.moving
        np.testing.assert_array_equal(v.velocity, 0.0)
        np.testing.assert_allclose(v.covariance, 1.3**2 * np.eye(2))


@pytest.mark.parametrize("rate_hz", [1.0, 10.0, 40.0])
def test_output_ticks_keep_their_rate_on_the_stamps(rate_hz: float) -> None:
    _, _, velocities = run(walk(), PdrConfig(output_rate_hz=rate_hz))
    stamps = np.array([v.stamp_ns for v in velocities])
    assert (stamps[-1] - stamps[0]) * 1e-9 * rate_hz == pytest.approx(len(stamps) - 1, abs=1.0)
    assert np.all(np.diff(stamps) > 0)


def test_heading_sd_grows_without_a_magnetometer_only() -> None:
    config = PdrConfig(heading_sd_rad=0.05, heading_drift_radps=0.01)
    _, relative, _ = run(walk(), config)
    _, fixed, _ = run(walk(), config, magnetic=True)
    last = relative[-1]
    age_s = (last.stamp_ns - 10**18) * 1e-9 - 0.5
    assert last.heading_sd_rad == pytest.approx(math.hypot(0.05, 0.01 * age_s), rel=0.03)
    assert fixed[-1].heading_sd_rad == pytest.approx(0.05, rel=0.03)


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        ("rate", math.nan, "not_finite"),
        ("force", math.inf, "not_finite"),
        ("force", 157.0, "accelerometer_saturated"),
        ("rate", -35.0, "gyro_saturated"),
    ],
)
def test_a_bad_sample_is_counted_and_changes_nothing(
    column: str, value: float, reason: str
) -> None:
    w = walk()
    bad = Walk(w.stamps, w.rate.copy(), w.force.copy(), w.field)
    rows = range(400, 2000, 400)
    for row in rows:
        getattr(bad, column)[row, 1] = value
    core, events, velocities = run(bad)
    assert core.counters == {reason: len(rows)}
    assert len(events) == len(run(w)[1])
    for v in velocities:
        assert np.all(np.isfinite(v.velocity))
        assert np.all(np.isfinite(v.covariance))


@pytest.mark.parametrize(
    ("range_mps2", "counted"), [(30.0, True), (30.001, False)]
)  # the sample has 30 m/s^2
def test_saturation_at_its_boundary(range_mps2: float, counted: bool) -> None:
    core = PedestrianDeadReckoning(PdrConfig(accelerometer_range_mps2=range_mps2))
    core.add_imu(0, (0, 0, 0), (0, 0, -30.0))
    assert core.counters.get("accelerometer_saturated", 0) == int(counted)


def test_malformed_vectors_are_counted() -> None:
    core = PedestrianDeadReckoning()
    assert core.add_imu(0, (0.0, 0.0), (0.0, 0.0, G)) is None
    core.add_magnetic_field(0, (1e-5, 1e-5))
    assert core.counters == {"malformed": 1, "magnetic_malformed": 1}


def test_stamps_duplicated_or_backwards_are_refused() -> None:
    core = PedestrianDeadReckoning()
    for stamp in (0, 10_000_000, 10_000_000, 5_000_000, 20_000_000):
        core.add_imu(stamp, (0, 0, 0), (0, 0, G))
    assert core.counters == {"stamp_duplicate": 1, "stamp_backwards": 1}


@pytest.mark.parametrize(("back_ns", "reset"), [(999_999_999, False), (1_000_000_000, True)])
def test_a_clock_set_back_restarts_at_its_boundary(back_ns: int, reset: bool) -> None:
    core = PedestrianDeadReckoning(PdrConfig(clock_reset_s=1.0))
    for i in range(200):
        core.add_imu(i * 10**7, (0, 0, 0), (0, 0, G))
    assert core.attitude.aligned
    core.add_imu(199 * 10**7 - back_ns, (0, 0, 0), (0, 0, G))
    assert core.counters == ({"clock_reset": 1} if reset else {"stamp_backwards": 1})
    assert core.attitude.aligned is not reset


@pytest.mark.parametrize(("gap_s", "gaps"), [(0.25, 0), (0.26, 1)])
def test_gap_at_its_boundary(gap_s: float, gaps: int) -> None:
    core = PedestrianDeadReckoning(PdrConfig(max_gap_s=0.25))
    core.add_imu(0, (0, 0, 0), (0, 0, G))
    core.add_imu(round(gap_s * 1e9), (0, 0, 0), (0, 0, G))
    assert core.counters.get("gap", 0) == gaps


def test_after_a_gap_the_heading_is_kept_with_a_larger_sd() -> None:
    w = walk(turn_deg=90.0)
    keep = (w.stamps < 10**18 + 15 * 10**9) | (w.stamps >= 10**18 + 16 * 10**9)
    cut = Walk(w.stamps[keep], w.rate[keep], w.force[keep], w.field[keep])
    core, events, _ = run(cut, PdrConfig(heading_drift_radps=0.0, gap_rate_sd_radps=0.5))
    assert core.counters["gap"] == 1
    late = [e for e in events if e.start_ns > 10**18 + 17 * 10**9]
    assert max(heading_error(e, 90.0) for e in late) < 0.06
    assert late[-1].heading_sd_rad == pytest.approx(math.hypot(0.1, 0.5 * 1.01), rel=0.02)
    _, fixed, _ = run(cut, magnetic=True)
    assert fixed[-1].heading_sd_rad == pytest.approx(0.1, rel=0.03)


def test_walking_covariance_is_that_of_the_last_step_plus_its_age() -> None:
    q = 0.5
    _, events, velocities = run(walk(40.0), PdrConfig(speed_drift_mps2=q), magnetic=True)
    checked = 0
    for v in velocities:
        known = [e for e in events if e.stamp_ns <= v.stamp_ns]
        if not known or not np.any(v.velocity):
            continue
        e = known[-1]
        duration = (e.end_ns - e.start_ns) * 1e-9
        mean, cov = step_velocity(
            e.length_m, duration, e.heading_rad, e.length_sd_m, e.heading_sd_rad
        )
        age = (v.stamp_ns - e.end_ns) * 1e-9
        np.testing.assert_allclose(v.velocity, mean, rtol=1e-12)
        np.testing.assert_allclose(v.covariance, cov + (q * age) ** 2 * np.eye(2), rtol=1e-9)
        checked += 1
    assert checked > 150


def test_shaking_without_steps_after_a_walk_is_undecided() -> None:
    """15 Hz vibration is neither still nor a step; the last step is not believed for ever."""
    w = walk(rest_s=(3.0, 8.0))
    t = (w.stamps - 10**18) * 1e-9
    w.force[:, 2] += np.where(t > 23.0, 1.5 * np.sin(2 * np.pi * 15 * t), 0.0)
    _, events, velocities = run(w)
    last = events[-1]
    horizon_ns = round(1.5 * (last.end_ns - last.start_ns) + StepConfig().delay_s * 1e9)
    late = [v for v in velocities if v.stamp_ns > events[-1].end_ns + horizon_ns]
    early = [v for v in velocities if 0 < events[-1].end_ns + horizon_ns - v.stamp_ns < 10**9]
    assert late
    assert all(v.moving and not np.any(v.velocity) for v in late)
    assert all(np.any(v.velocity) for v in early)


@pytest.mark.parametrize(("rate_radps", "sd"), [(0.19, 0.05), (0.21, 0.3)])
def test_a_turning_body_is_less_surely_still_at_the_threshold(
    rate_radps: float, sd: float
) -> None:
    """Constant specific force alone (turning about the vertical) does not prove stillness."""
    core = PedestrianDeadReckoning(PdrConfig(still_rate_radps=0.2))
    out = None
    for i in range(600):
        rate = (0.0, 0.0, rate_radps if i > 100 else 0.0)
        out = core.add_imu(i * 10**7, rate, (0.0, 0.0, G)) or out
    assert out is not None
    assert out.velocity is not None
    assert out.velocity.moving is (sd == 0.3)
    np.testing.assert_array_equal(out.velocity.velocity, 0.0)
    np.testing.assert_allclose(out.velocity.covariance, sd**2 * np.eye(2))


def test_heading_sd_doubles_when_the_forward_axis_is_pitched_60_deg() -> None:
    w, config = walk(), PdrConfig(heading_sd_rad=0.08, heading_drift_radps=0.0)
    r = Rotation.from_euler("ZYX", [0.0, 60.0, 0.0], degrees=True).inv()
    _, events, _ = run(Walk(w.stamps, r.apply(w.rate), r.apply(w.force), w.field), config)
    assert events[-1].heading_sd_rad == pytest.approx(0.16, rel=0.03)


def test_no_burst_of_ticks_after_a_gap() -> None:
    w = walk()
    keep = (w.stamps < 10**18 + 10 * 10**9) | (w.stamps >= 10**18 + 14 * 10**9)
    cut = Walk(w.stamps[keep], w.rate[keep], w.force[keep], w.field[keep])
    _, _, velocities = run(cut, PdrConfig(output_rate_hz=10.0))
    assert np.min(np.diff([v.stamp_ns for v in velocities])) >= 80_000_000


def test_a_late_magnetometer_never_mixes_the_frames() -> None:
    w, heading_deg, on_ns = walk(120.0), 120.0, 10**18 + 12 * 10**9
    core, headings = PedestrianDeadReckoning(), []
    for i, stamp in enumerate(w.stamps.tolist()):
        out = core.add_imu(stamp, w.rate[i], w.force[i])
        if stamp >= on_ns:
            core.add_magnetic_field(stamp, w.field[i])
        if out is None:
            continue
        for e in out.steps:
            expected = heading_deg if e.heading_reference == "map" else 0.0
            assert heading_error(e, expected) < 0.04
        if out.velocity is not None and np.any(out.velocity.velocity):
            v = out.velocity
            expected = heading_deg if v.heading_reference == "map" else 0.0
            seen = math.atan2(v.velocity[1], v.velocity[0])
            assert abs(seen - math.radians(expected)) < 0.04
            headings.append(v.heading_reference)
    assert set(headings) == {"map", "relative"}


def test_wrong_rate_is_counted_and_undecided() -> None:
    core = PedestrianDeadReckoning(PdrConfig(min_rate_hz=25.0))
    velocities = []
    for i in range(100):
        out = core.add_imu(i * 10**8, (0, 0, 0), (0, 0, G))  # 10 Hz, at rest
        velocities += [out.velocity] if out and out.velocity else []
    assert core.counters["rate_out_of_range"] >= 8
    assert velocities[-1].moving


def test_force_in_g_is_reported_and_never_aligns() -> None:
    core = PedestrianDeadReckoning()
    outs = [core.add_imu(i * 10**7, (0, 0, 0), (0, 0, 1.0)) for i in range(300)]
    assert not any(outs)
    assert core.counters["gravity_implausible"] == pytest.approx(5, abs=1)


def test_field_in_microtesla_is_counted_and_ignored() -> None:
    w = walk()
    micro = Walk(w.stamps, w.rate, w.force, w.field * 1e6)
    core, events, _ = run(micro, magnetic=True)
    assert core.counters == {"magnetic_out_of_range": len(w.stamps)}
    assert events[-1].heading_reference == "relative"


def test_nothing_after_rest_depends_on_the_epoch() -> None:
    """Integer stamps: the same walk two decades apart gives the same numbers."""
    a, b = run(walk(start_ns=0))[1], run(walk(start_ns=17 * 10**17))[1]
    assert [e.end_ns for e in a] == [e.end_ns - 17 * 10**17 for e in b]
    assert [e.length_m for e in a] == [e.length_m for e in b]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_input_raises_or_gives_nan(seed: int) -> None:
    rng = np.random.default_rng(seed)
    core, stamp = PedestrianDeadReckoning(PdrConfig(output_rate_hz=50.0)), 0
    special = [math.nan, math.inf, -math.inf, 0.0, 1e-300, 1e300, 200.0]
    for _ in range(300):
        stamp += int(rng.choice([-2 * 10**9, -5, 0, 10**7, 10**7, 10**7, 10**9], p=None))
        rate, force, field = rng.normal(0, 3, 3), rng.normal(0, 10, 3), rng.normal(0, 5e-5, 3)
        if rng.random() < 0.1:
            [rate, force, field][rng.integers(3)][rng.integers(3)] = rng.choice(special)
        core.add_magnetic_field(stamp, field)
        out = core.add_imu(stamp, rate, force)
        if out is not None and out.velocity is not None:
            assert np.all(np.isfinite(out.velocity.velocity))
            assert np.all(np.linalg.eigvalsh(out.velocity.covariance) > 0)


@pytest.mark.parametrize(
    "bad",
    [
        {"output_rate_hz": 0.0},
        {"weinberg_k": -0.4},
        {"heading_drift_radps": -1e-9},
        {"mount_heading_rad": 90.0},
        {"max_gap_s": 0.01},
        {"max_rate_hz": 20.0},
        {"still_speed_sd_mps": math.nan},
    ],
)
def test_bad_config_names_the_value(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        PdrConfig(**bad)


def test_nested_config_reaches_the_detector() -> None:
    w = walk(walk_s=2.2)  # four steps
    assert len(run(w, PdrConfig(steps=StepConfig(bout_steps=9)))[1]) == 0
    assert len(run(w, PdrConfig(steps=StepConfig(bout_steps=2)))[1]) >= 4


@pytest.mark.parametrize("late_ns", [0, 40_000_000, 90_000_000])
def test_the_order_of_arrival_of_imu_and_field_does_not_matter(late_ns: int) -> None:
    """Field samples less than ``field_hold_s`` late give the same output to the last bit."""
    w = walk(40.0, turn_deg=60.0)

    def through(field_first: bool) -> list[tuple[float, ...]]:
        core, out, waiting = PedestrianDeadReckoning(), [], []
        for i, stamp in enumerate(w.stamps.tolist()):
            waiting.append((stamp, w.field[i]))
            while waiting and field_first:
                core.add_magnetic_field(*waiting.pop(0))
            got = core.add_imu(stamp, w.rate[i], w.force[i])
            while waiting and waiting[0][0] + late_ns <= stamp:
                core.add_magnetic_field(*waiting.pop(0))
            if got is not None and got.velocity is not None:
                out.append((got.velocity.stamp_ns, *got.velocity.velocity))
        return out

    expected, got = through(True), through(False)
    assert expected[50:] == got[50:]
    assert len(got) > 200


def test_a_gyro_bias_that_comes_later_is_learnt_while_standing() -> None:
    """0.01 rad/s from 5 s to 45 s: without learning the heading ends 0.4 rad off."""
    core, rng = PedestrianDeadReckoning(), np.random.default_rng(6)
    for i in range(4500):
        rate, force = rng.normal(scale=0.002, size=(2, 3))
        rate[2] += 0.01 if i > 500 else 0.0
        force[2] += G
        core.add_imu(i * 10**7, rate, force)
    assert core.attitude.bias_radps[2] == pytest.approx(0.01, abs=1.5e-3)
    assert abs(core.attitude.heading_rad) < 0.15
