"""Dead-reckoning core on synthetic walks with known path."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.pdr_output import step_velocity
from netpos.inertial.steps import StepConfig
from scipy.spatial.transform import Rotation
from straight_walk import CADENCE_HZ, G, Walk, heading_error, run, walk


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
