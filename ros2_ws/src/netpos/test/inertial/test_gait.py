"""The simulated walk against numerical differentiation, strapdown integration, its words."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.inertial.gait import Gait, GaitModel, walk, walk_legs
from netpos.inertial.imu import (
    ImuModel,
    MagneticDisturbance,
    MagnetometerModel,
    simulate_imu,
    simulate_magnetometer,
)
from netpos.world.motion import Leg
from netpos.world.routes import rectangle
from scipy.spatial.transform import Rotation

STILL_BODY = {
    "bounce_m": 0.0,
    "sway_m": 0.0,
    "surge_m": 0.0,
    "impact_mps2": 0.0,
    "yaw_swing_deg": 0.0,
    "roll_swing_deg": 0.0,
    "pitch_swing_deg": 0.0,
    "lean_deg": 0.0,
}
PAPER = GaitModel(step_length_m=0.6375, cadence_hz=1 / 0.6375)
PERFECT = ImuModel(
    rate_hz=200.0,
    gyro_noise_density_radps_sqrthz=0.0,
    accel_noise_density_mps2_sqrthz=0.0,
    gyro_constant_bias_sd_radps=0.0,
    accel_constant_bias_sd_mps2=0.0,
    gyro_bias_sd_radps=0.0,
    accel_bias_sd_mps2=0.0,
)
ARCS = [Leg(3.0), Leg(3.0 * np.pi / 2, np.pi / 2), Leg(2.0 * np.pi, -np.pi)]
GAITS = [
    walk(rectangle((1.0, 2.0), 5.7, 4.5), PAPER, pauses_s=[0.5] * 5),
    walk([[0, 0], [6, 0], [6, -5]], GaitModel(), corner_radius_m=1.0),
    walk([[0, 0], [0, 2.0]], GaitModel(stance_pause_s=0.3, lean_deg=-12.0), pauses_s=[1, 2]),
    walk_legs([1, 2], 0.5, ARCS, GaitModel(), pauses_s=[1, 0, 2, 0]),
]


def test_the_paper_walks_its_rectangle_in_32_steps_and_25_5_seconds() -> None:
    gait = walk(rectangle((0.0, 0.0), 5.7, 4.5), PAPER, pauses_s=[0.51] * 5)
    assert gait.contact_s.size == 32
    assert gait.step_length_m.sum() == pytest.approx(20.4)
    assert gait.duration_s == pytest.approx(25.5)
    state = gait.body_at([0.0, gait.duration_s])
    np.testing.assert_allclose(state.position, 0.0, atol=1e-9)
    np.testing.assert_allclose(state.velocity, 0.0, atol=1e-9)


@pytest.mark.parametrize("gait", GAITS)
def test_velocity_and_body_rate_are_the_derivatives(gait: Gait) -> None:
    step = 1e-4
    t = np.linspace(2 * step, gait.duration_s - 2 * step, 4001)
    now, before, after = gait.body_at(t), gait.body_at(t - step), gait.body_at(t + step)
    slope = (after.position - before.position) / (2 * step)
    np.testing.assert_allclose(now.velocity, slope, atol=2e-4)
    turn = (before.rotation.inv() * after.rotation).as_rotvec() / (2 * step)
    kink = np.abs(turn - now.angular_velocity).max(axis=1) > 1e-3  # where an arc begins or ends
    assert kink.sum() <= 4
    np.testing.assert_allclose(now.angular_velocity[~kink], turn[~kink], atol=1e-3)


@pytest.mark.parametrize("gait", GAITS)
def test_nothing_jumps(gait: Gait) -> None:
    t = np.arange(0.0, gait.duration_s, 1e-3)
    state = gait.body_at(t)
    assert np.abs(np.diff(state.velocity, axis=0)).max() < 0.01  # 10 m/s^2
    assert np.abs(np.diff(state.position, axis=0)).max() < 0.003
    assert (state.rotation[:-1].inv() * state.rotation[1:]).magnitude().max() < 0.008


@pytest.mark.parametrize("gait", GAITS)
def test_strapdown_of_perfect_samples_returns_the_walk(gait: Gait) -> None:
    """Half a turn, velocity increment, half a turn, trapezoid; gravity as the textbooks print."""
    start_ns = 10**9
    imu = simulate_imu(PERFECT, gait, start_ns, 1, "vue_1")
    begin = gait.body_at(0.0)
    attitude, velocity, position = begin.rotation[0], begin.velocity[0], begin.position[0]
    truth = gait.body_at((imu.stamp_ns - start_ns) * 1e-9)
    dt = 1 / PERFECT.rate_hz
    for i, (rate, force) in enumerate(zip(imu.angular_velocity, imu.specific_force, strict=True)):
        half = Rotation.from_rotvec(rate * dt / 2)
        attitude = attitude * half
        new = velocity + (attitude.apply(force) - np.array([0.0, 0.0, 9.80665])) * dt
        attitude = attitude * half
        position, velocity = position + (velocity + new) * dt / 2, new
        if i % 100 == 0:
            assert np.abs(position - truth.position[i]).max() < 2e-3
            assert np.abs(velocity - truth.velocity[i]).max() < 1e-9
            assert (attitude.inv() * truth.rotation[i]).magnitude() < 1e-9
    assert np.abs(position - truth.position[-1]).max() < 2e-3


def test_amplitudes_are_those_of_the_model() -> None:
    model = GaitModel(
        bounce_m=0.05, sway_m=0.06, surge_m=0.0, impact_mps2=0.0, yaw_swing_deg=6, lean_deg=10
    )
    gait = walk([[0, 0], [0, 40]], model)
    steady = gait.body_at(np.linspace(2.0, gait.duration_s - 2.0, 5001))
    assert np.ptp(steady.position[:, 2]) == pytest.approx(0.05, rel=1e-3)
    assert np.ptp(steady.position[:, 0]) == pytest.approx(0.06, rel=1e-3)
    yaw, pitch, roll = steady.rotation.as_euler("ZYX", degrees=True).T
    assert np.abs(yaw - 90).max() == pytest.approx(6.0, rel=1e-3)
    assert pitch.mean() == pytest.approx(10.0, abs=0.1)
    assert np.abs(roll).max() == pytest.approx(3.0, rel=1e-3)
    speed = np.hypot(*steady.velocity[:, :2].T).mean()
    assert speed == pytest.approx(0.6375 * 1.57, rel=0.02)


def test_the_waist_is_lowest_just_after_each_contact_and_sways_to_alternate_sides() -> None:
    gait = walk([[0, 0], [20, 0]], GaitModel(impact_mps2=0.0))
    assert gait.contact_s.size == 31
    np.testing.assert_allclose(gait.step_length_m, 20 / 31)
    for contact in gait.contact_s[1:-1]:
        near = np.linspace(contact - 0.2, contact + 0.2, 401)
        lowest = near[np.argmin(gait.body_at(near).position[:, 2])]
        assert lowest - contact == pytest.approx(0.08 / 1.57, abs=2e-3)
    middle = gait.contact_s[:-1] + (0.5 + 0.08) / 1.57
    side = np.sign(gait.body_at(middle).position[1:-1, 1])
    assert (side[1:] == -side[:-1]).all()


def test_each_contact_jolts_the_waist_and_nothing_else_does() -> None:
    """Against a walker without impacts: a burst of the stated size within 50 ms, over in 0.4 s."""
    soft, hard = (walk([[0, 0], [10, 0]], GaitModel(impact_mps2=i)) for i in (0.0, 4.0))
    a, b = (simulate_imu(PERFECT, g, 0, 1, "v") for g in (soft, hard))
    jolt = np.linalg.norm(b.specific_force - a.specific_force, axis=1)
    t = b.stamp_ns * 1e-9
    since = t[:, None] - hard.contact_s
    since = np.where(since > 0, since, np.inf).min(axis=1)
    assert jolt[t < hard.contact_s[0]].max() < 1e-9
    assert jolt[since > 0.4].max() < 0.02
    for contact in hard.contact_s:
        burst = (t > contact) & (t < contact + 0.3)
        assert 2.0 < jolt[burst].max() < 5.0
        assert t[burst][np.argmax(jolt[burst])] - contact < 0.07


def test_a_stiff_walker_is_a_vehicle() -> None:
    """Without swings the specific force is gravity and the way's acceleration alone."""
    gait = walk([[0, 0], [10, 0]], GaitModel(**STILL_BODY))
    imu = simulate_imu(PERFECT, gait, 0, 1, "v")
    np.testing.assert_allclose(imu.angular_velocity, 0.0, atol=1e-12)
    np.testing.assert_allclose(imu.specific_force[:, 1:], [[0.0, 9.80665]] * len(imu.stamp_ns))
    dt = 1 / PERFECT.rate_hz
    assert imu.specific_force[:, 0].sum() * dt == pytest.approx(0.0, abs=1e-5)


def test_the_body_turns_during_the_pause_at_a_corner() -> None:
    gait = walk([[0, 0], [3, 0], [3, 3]], GaitModel(**STILL_BODY), pauses_s=[0, 1.0, 0])
    first = 6 / 1.57  # 5 steps
    yaw = gait.body_at([first, first + 0.5, first + 1.0]).rotation.as_euler("ZYX")[:, 0]
    np.testing.assert_allclose(yaw, [0.0, math.pi / 4, math.pi / 2], atol=1e-9)
    rate = gait.body_at(first + 0.5).angular_velocity[0, 2]
    assert rate == pytest.approx(math.pi / 2 * 1.875)
    np.testing.assert_allclose(gait.body_at(first + 0.5).velocity, 0.0)


def test_a_stance_pause_stops_after_every_step() -> None:
    model = GaitModel(step_length_m=0.5, cadence_hz=2.0, stance_pause_s=0.25)
    gait = walk([[0, 0], [2, 0]], model)
    assert gait.duration_s == pytest.approx(4 * 1.0 + 3 * 0.25)
    np.testing.assert_allclose(gait.contact_s, [0.5, 1.75, 3.0, 4.25])
    state = gait.body_at(np.arange(3) * 1.25 + 1.1)
    np.testing.assert_allclose(state.position[:, 0], [0.5, 1.0, 1.5], atol=1e-9)
    np.testing.assert_allclose(state.velocity, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": [[0, 0], [3, 0], [3, 3]]}, "each a pause in pauses_s"),
        ({"points": [[0, 0]]}, "at least two"),
        ({"points": [[0, 0], [3, 0]], "pauses_s": [-1, 0]}, "pauses_s must be finite"),
        ({"points": [[0, 0], [3, 0]], "pauses_s": [1]}, "one value per way-point"),
    ],
)
def test_bad_routes_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        walk(model=GaitModel(), **arguments)


@pytest.mark.parametrize("time_s", [-0.1, 100.0, math.nan])
def test_times_outside_the_walk_are_refused(time_s: float) -> None:
    with pytest.raises(ValueError, match="time must be in"):
        GAITS[0].body_at(time_s)


def test_scale_errors_and_ranges() -> None:
    gait = GAITS[0]
    clean = simulate_imu(PERFECT, gait, 0, 1, "v")
    scaled = ImuModel(**{**_plain(PERFECT), "gyro_scale_sd": 0.01, "accel_scale_sd": 0.02})
    factors = []
    for seed in range(60):
        dirty = simulate_imu(scaled, gait, 0, seed, "v")
        ratio = dirty.specific_force[:, 2] / clean.specific_force[:, 2]
        assert np.ptp(ratio) < 1e-9
        busy = np.abs(clean.angular_velocity[:, 1]) > 0.05
        turn = dirty.angular_velocity[busy, 1] / clean.angular_velocity[busy, 1]
        assert np.ptp(turn) < 1e-9
        factors.append([ratio[0] - 1, turn[0] - 1])
    assert np.std(factors, axis=0) == pytest.approx([0.02, 0.01], rel=0.35)
    narrow = ImuModel(**{**_plain(PERFECT), "accel_range_mps2": 10.5, "gyro_range_radps": 0.4})
    cut = simulate_imu(narrow, gait, 0, 1, "v")
    assert np.abs(cut.specific_force).max() == 10.5
    assert np.abs(cut.angular_velocity).max() == 0.4
    np.testing.assert_allclose(cut.specific_force, np.clip(clean.specific_force, -10.5, 10.5))


def _plain(model: ImuModel) -> dict[str, float]:
    return {name: getattr(model, name) for name in ImuModel.__slots__}


def test_magnetometer_turns_with_the_body_and_meets_iron_and_disturbances() -> None:
    disturbance = MagneticDisturbance(center=(6.7, 2.0), radius_m=0.5, field_t=(30e-6, 0.0, 5e-6))
    clean, iron = (
        MagnetometerModel(noise_sd_t=0.0),
        MagnetometerModel(
            noise_sd_t=0.0, hard_iron_sd_t=5e-6, soft_iron_sd=0.03, disturbances=(disturbance,)
        ),
    )
    gait = GAITS[0]
    stamps, field = simulate_magnetometer(clean, gait, 0, 1, "v")
    state = gait.body_at(stamps * 1e-9)
    np.testing.assert_allclose(
        state.rotation.apply(field), np.tile(clean.field_map, (len(field), 1)), atol=1e-15
    )
    _, worn = simulate_magnetometer(iron, gait, 0, 1, "v")
    away = np.hypot(*(state.position[:, :2] - disturbance.center).T)
    assert away.min() < 0.1
    far = away > 4.0
    design = np.hstack([field[far], np.ones((far.sum(), 1))])
    fit = np.linalg.lstsq(design, worn[far], rcond=None)[0]  # m = S b + h, linear in both
    np.testing.assert_allclose(fit[:3], fit[:3].T, atol=1e-6)
    assert 0.005 < np.abs(fit[:3] - np.eye(3)).max() < 0.12
    assert 1e-6 < np.abs(fit[3]).max() < 15e-6
    near = np.argmin(away)
    extra = state.rotation[near].apply(
        np.linalg.solve(fit[:3].T, worn[near] - fit[3]) - field[near]
    )
    expected = np.array(disturbance.field_t) * math.exp(-(away[near] ** 2) / 0.5)
    np.testing.assert_allclose(extra, expected, atol=1e-8)


def test_a_walk_of_lines_and_arcs_ends_where_they_do() -> None:
    """3 m along +x, a quarter of 3 m to the left, half a circle of 2 m to the right."""
    gait = walk_legs([0, 0], 0.0, ARCS, GaitModel(), pauses_s=[1, 0, 2, 0])
    np.testing.assert_allclose(
        gait.body_at(gait.duration_s).position[0, :2], [10.0, 3.0], atol=1e-9
    )
    assert gait.step_length_m.sum() == pytest.approx(3.0 + 3.5 * np.pi)
