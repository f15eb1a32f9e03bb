"""Attitude against scipy rotations and closed-form motions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.inertial.attitude import (
    GRAVITY_MPS2,
    AttitudeConfig,
    AttitudeFilter,
    level,
    multiply,
    rotate,
    wrap_angle,
)
from scipy.spatial.transform import Rotation

G_MAP = np.array([0.0, 0.0, GRAVITY_MPS2])
FIELD_MAP = np.array([0.0, 18e-6, -45e-6])  # magnetic north = y, dip 68 deg
DT_NS = 10_000_000


def as_rotation(q: tuple[float, float, float, float]) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


def angle_deg(a: Rotation, b: Rotation) -> float:
    return math.degrees(float((a.inv() * b).magnitude()))


def tup(v: np.ndarray) -> tuple[float, float, float]:
    return (float(v[0]), float(v[1]), float(v[2]))


def rest(f: AttitudeFilter, truth: Rotation, n: int = 60, start_ns: int = 0) -> int:
    """Feed n samples of rest; return the last stamp."""
    force = tup(truth.inv().apply(G_MAP))
    for i in range(n):
        f.add_imu(start_ns + i * DT_NS, (0.0, 0.0, 0.0), force)
    return start_ns + (n - 1) * DT_NS


def test_multiply_and_rotate_match_scipy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        a, b = Rotation.random(rng=rng), Rotation.random(rng=rng)
        qa, qb = (tuple(np.roll(r.as_quat(), 1).tolist()) for r in (a, b))
        v = rng.normal(size=3)
        assert angle_deg(as_rotation(multiply(qa, qb)), a * b) < 1e-5
        np.testing.assert_allclose(rotate(qa, tup(v)), a.apply(v), atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3).filter(lambda v: np.dot(v, v) > 0.01))
def test_level_puts_force_up_and_forward_over_x(force: list[float]) -> None:
    r = as_rotation(level((force[0], force[1], force[2])))
    up = r.apply(np.array(force) / np.linalg.norm(force))
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)
    forward = r.apply([1.0, 0.0, 0.0])
    if math.hypot(forward[0], forward[1]) > 0.02:  # else z took its place
        assert abs(math.atan2(forward[1], forward[0])) < 1e-6


def test_level_refuses_no_direction() -> None:
    with pytest.raises(ValueError, match="not zero"):
        level((0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(math.pi, -math.pi), (-math.pi, -math.pi), (3.5 * math.pi, -math.pi / 2)],
)
def test_wrap_angle(angle: float, wrapped: float) -> None:
    assert wrap_angle(angle) == pytest.approx(wrapped, abs=1e-12)


def test_alignment_recovers_tilt_and_gyro_bias() -> None:
    truth = Rotation.from_euler("ZYX", [0.0, 25.0, -40.0], degrees=True)
    bias = np.array([0.01, -0.02, 0.03])
    f = AttitudeFilter()
    for i in range(60):
        f.add_imu(i * DT_NS, tup(bias), tup(truth.inv().apply(G_MAP)))
    assert f.aligned
    assert f.reference == "relative"
    assert angle_deg(f.rotation, truth) < 0.02
    np.testing.assert_allclose(f.bias_radps, bias, atol=5e-4)


def test_no_bias_is_learnt_from_a_turning_start() -> None:
    f = AttitudeFilter()
    for i in range(52):
        f.add_imu(i * DT_NS, (0.0, 0.0, 0.5), (0.0, 0.0, GRAVITY_MPS2))
    assert f.aligned
    assert f.bias_radps == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("jitter", [0.0, 0.6])
def test_a_turn_is_the_integral_of_the_rate_whatever_the_interval(jitter: float) -> None:
    """R(t) = R(0) exp(w t) about the vertical; samples come up to 60 % early or late."""
    rng = np.random.default_rng(3)
    tilt = Rotation.from_euler("ZYX", [0.0, 10.0, 20.0], degrees=True)
    f = AttitudeFilter()
    stamp = rest(f, tilt)
    start_ns, rate = stamp, 0.9
    for _ in range(600):
        stamp += round(DT_NS * (1.0 + jitter * rng.uniform(-1, 1)))
        truth = Rotation.from_euler("z", rate * (stamp - start_ns) * 1e-9) * tilt
        f.add_imu(stamp, tup(truth.inv().apply([0.0, 0.0, rate])), tup(truth.inv().apply(G_MAP)))
    assert angle_deg(f.rotation, truth) < 0.5


@pytest.mark.parametrize("tilt_time_s", [1.0, 3.0])
def test_tilt_error_decays_with_the_configured_time(tilt_time_s: float) -> None:
    """A body turned by 0.1 rad that the gyro did not see."""
    f = AttitudeFilter(AttitudeConfig(tilt_time_s=tilt_time_s))
    last = rest(f, Rotation.identity(), n=1000)
    tilted = Rotation.from_rotvec([0.1, 0.0, 0.0])
    errors = []
    for i in range(1, 2001):
        f.add_imu(last + i * DT_NS, (0.0, 0.0, 0.0), tup(tilted.inv().apply(G_MAP)))
        errors.append(float((f.rotation.inv() * tilted).magnitude()))
    half_s = 0.01 * next(i for i, error in enumerate(errors) if error < 0.05)
    assert 0.3 * tilt_time_s < half_s < 2.0 * tilt_time_s
    assert errors[-1] < 0.01


def test_fast_motion_does_not_tilt() -> None:
    """A body shaken along one axis with 1 g, three times a second: its mean force is gravity, and
    its largest 45 deg off."""
    f = AttitudeFilter()
    last, worst = rest(f, Rotation.identity(), n=600), 0.0
    for i in range(1, 3001):
        shaken = GRAVITY_MPS2 * math.sin(2.0 * math.pi * 3.0 * i * 0.01)
        f.add_imu(last + i * DT_NS, (0.0, 0.0, 0.0), (shaken, 0.0, GRAVITY_MPS2))
        worst = max(worst, angle_deg(f.rotation, Rotation.identity()))
    assert worst < 2.5


def test_constant_gyro_bias_is_estimated() -> None:
    bias = (0.02, -0.01, 0.015)
    f = AttitudeFilter()
    last = rest(f, Rotation.identity())
    for i in range(1, 4001):
        f.add_imu(last + i * DT_NS, bias, (0.0, 0.0, GRAVITY_MPS2))
    np.testing.assert_allclose(f.bias_radps, bias, atol=5e-4)


@pytest.mark.parametrize("yaw_deg", [-170.0, -90.0, 0.0, 35.0, 179.0])
@pytest.mark.parametrize("declination_rad", [0.0, 0.2])
def test_first_field_sample_sets_the_heading(yaw_deg: float, declination_rad: float) -> None:
    """An east declination turns magnetic north clockwise, seen from above."""
    truth = Rotation.from_euler("ZYX", [yaw_deg, 15.0, -8.0], degrees=True)
    field = Rotation.from_euler("z", -declination_rad).apply(FIELD_MAP)
    f = AttitudeFilter(AttitudeConfig(declination_rad=declination_rad))
    last = rest(f, truth)
    assert f.add_magnetic_field(last, tup(truth.inv().apply(field))) == "used"
    assert f.reference == "map"
    assert angle_deg(f.rotation, truth) < 0.02
    assert abs(wrap_angle(f.heading_rad - math.radians(yaw_deg))) < 1e-3


def test_heading_error_decays_with_the_configured_gain() -> None:
    f = AttitudeFilter(AttitudeConfig(heading_gain_per_s=0.5))
    truth = Rotation.identity()
    last = rest(f, truth)
    f.add_magnetic_field(last, tup(FIELD_MAP))
    f.turn(0.2)
    for i in range(1, 201):
        f.add_magnetic_field(last + i * DT_NS, tup(FIELD_MAP))
    assert f.heading_rad == pytest.approx(0.2 * math.exp(-0.5 * 2.0), rel=0.02)


@pytest.mark.parametrize(("scale", "result"), [(1.24, "used"), (1.26, "disturbed")])
def test_field_norm_gate_at_its_boundary(scale: float, result: str) -> None:
    f = AttitudeFilter(AttitudeConfig(field_tolerance=0.25))
    last = rest(f, Rotation.identity())
    f.add_magnetic_field(last, tup(FIELD_MAP))
    assert f.add_magnetic_field(last + DT_NS, tup(scale * FIELD_MAP)) == result


@pytest.mark.parametrize(("turn_rad", "result"), [(0.25, "used"), (0.27, "disturbed")])
def test_dip_gate_at_its_boundary(turn_rad: float, result: str) -> None:
    f = AttitudeFilter(AttitudeConfig(dip_tolerance_rad=0.26))
    last = rest(f, Rotation.identity())
    f.add_magnetic_field(last, tup(FIELD_MAP))
    dipped = Rotation.from_euler("x", turn_rad).apply(FIELD_MAP)
    assert f.add_magnetic_field(last + DT_NS, tup(dipped)) == result


@pytest.mark.parametrize(("factor", "result"), [(0.99, "used"), (1.01, "disturbed")])
@pytest.mark.parametrize("silent_s", [0.01, 20.0])
def test_heading_gate_at_its_boundary(factor: float, result: str, silent_s: float) -> None:
    """3 sd of the kept heading, which widens with time, and of the field; norm and dip agree."""
    config = AttitudeConfig(
        heading_gain_per_s=0.0, first_heading_sd_rad=0.1, magnetic_heading_sd_rad=0.05
    )
    f = AttitudeFilter(config)
    last = rest(f, Rotation.identity())
    f.add_magnetic_field(last, tup(FIELD_MAP))
    limit = 3 * math.hypot(0.1 + 0.005 * silent_s, 0.05)
    turned = Rotation.from_euler("z", factor * limit).apply(FIELD_MAP)
    assert f.add_magnetic_field(last + round(silent_s * 1e9), tup(turned)) == result


def test_heading_trust_grows_with_use_and_a_lasting_change_is_taken_in_the_end() -> None:
    """sd falls from 0.5 to 0.045 rad: a turn of 0.6 is used at first and refused after 90 s; the
    gyro's drift opens the gate again after (0.6^2 / 9 - 0.09^2)^0.5 rad - 0.045 at 0.005 rad/s.
    """
    f = AttitudeFilter(AttitudeConfig())
    last = rest(f, Rotation.identity())
    f.add_magnetic_field(last, tup(FIELD_MAP))
    turned = tup(Rotation.from_euler("z", 0.6).apply(FIELD_MAP))
    assert f.add_magnetic_field(last + DT_NS, turned) == "used"
    for i in range(2, 9001):
        f.add_magnetic_field(last + i * DT_NS, tup(FIELD_MAP))
    end = last + 9000 * DT_NS
    assert f.add_magnetic_field(end + DT_NS, turned) == "disturbed"
    opens_s = (math.sqrt(0.6**2 / 9 - 0.09**2) - 0.045) / 0.005
    assert f.add_magnetic_field(end + round((opens_s - 1.0) * 1e9), turned) == "disturbed"
    assert f.add_magnetic_field(end + round((opens_s + 1.5) * 1e9), turned) == "used"


def test_the_expected_field_follows_a_lasting_change() -> None:
    """norm0 relaxes to the new norm with ``field_memory_s``: a 20 % step is half learnt after
    0.69 memories, so 1.32 is then within 25 % of 1.1 although it never was of 1.
    """
    f = AttitudeFilter(AttitudeConfig(field_tolerance=0.25, field_memory_s=5.0))
    last = rest(f, Rotation.identity())
    f.add_magnetic_field(last, tup(FIELD_MAP))
    assert f.add_magnetic_field(last + DT_NS, tup(1.32 * FIELD_MAP)) == "disturbed"
    for i in range(2, 349):
        f.add_magnetic_field(last + i * DT_NS, tup(1.2 * FIELD_MAP))
    assert f.add_magnetic_field(last + 349 * DT_NS, tup(1.39 * FIELD_MAP)) == "disturbed"
    assert f.add_magnetic_field(last + 350 * DT_NS, tup(1.36 * FIELD_MAP)) == "used"


def test_a_field_cannot_tilt_the_attitude_nor_a_vertical_one_turn_it() -> None:
    f = AttitudeFilter()
    last = rest(f, Rotation.identity())
    assert f.add_magnetic_field(last, (0.0, 0.0, -50e-6)) == "field_vertical"
    for i in range(1, 100):
        f.add_magnetic_field(last + i * DT_NS, (20e-6, 5e-6, -40e-6))
    np.testing.assert_allclose(f.rotation.apply([0.0, 0.0, 1.0]), [0, 0, 1], atol=1e-12)


def test_wrong_gravity_never_aligns() -> None:
    f = AttitudeFilter()
    for i in range(300):  # specific force in g instead of m/s^2
        assert not f.add_imu(i * DT_NS, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def test_reset_keeping_the_heading_aligns_only_the_tilt() -> None:
    f = AttitudeFilter()
    last = rest(f, Rotation.identity())
    f.turn(1.0)
    f.reset(keep_heading=True)
    tilted = Rotation.from_euler("ZYX", [1.0, 0.3, 0.0])
    rest(f, tilted, start_ns=last + 10**9)
    assert f.heading_rad == pytest.approx(1.0, abs=1e-9)
    assert angle_deg(f.rotation, tilted) < 0.02


@pytest.mark.parametrize(
    "bad",
    [
        {"tilt_time_s": -0.1},
        {"alignment_time_s": 0.0},
        {"declination_rad": 11.0},
        {"field_tolerance": math.nan},
    ],
)
def test_bad_config_names_the_value(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        AttitudeConfig(**bad)
