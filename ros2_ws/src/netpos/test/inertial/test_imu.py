"""The simulated IMU against an independent strapdown integrator, and its noise against its
model."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.inertial.imu import (
    ImuModel,
    ImuSamples,
    MagnetometerModel,
    interval_ns,
    simulate_imu,
    simulate_magnetometer,
)
from netpos.world.motion import Leg, Motion, follow, follow_legs
from scipy import stats
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 0.0, -9.80665])
START_NS = 1_000_000_000
PERFECT = ImuModel(
    gyro_noise_density_radps_sqrthz=0.0,
    accel_noise_density_mps2_sqrthz=0.0,
    gyro_constant_bias_sd_radps=0.0,
    accel_constant_bias_sd_mps2=0.0,
    gyro_bias_sd_radps=0.0,
    accel_bias_sd_mps2=0.0,
)


def _winding() -> Motion:
    return follow(
        [[0, 0], [40, 0], [40, -30], [70, -30]],
        3.0,
        corner_radius_m=4.0,
        acceleration_mps2=1.0,
        pauses_s=[1, 0, 0, 1],
    )


def _strapdown(imu: ImuSamples, motion: Motion) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Three-dimensional strapdown: half a turn, velocity increment, half a turn, trapezoid."""
    start = motion.at(0.0)
    attitude = Rotation.from_euler("z", start.yaw[0])
    velocity = np.array([*start.velocity[0], 0.0])
    position = np.array([*start.position[0], 0.0])
    last = START_NS
    track, speeds = [], []
    for stamp, rate, force in zip(
        imu.stamp_ns, imu.angular_velocity, imu.specific_force, strict=True
    ):
        dt = (stamp - last) * 1e-9
        half = Rotation.from_rotvec(rate * dt / 2)
        attitude = attitude * half
        new = velocity + (attitude.apply(force) + GRAVITY) * dt
        attitude = attitude * half
        position = position + (velocity + new) * dt / 2
        velocity, last = new, stamp
        track.append(position)
        speeds.append(velocity)
    return np.array(track), np.array(speeds), attitude


def test_strapdown_of_perfect_samples_returns_the_motion() -> None:
    motion = _winding()
    imu = simulate_imu(PERFECT, motion, START_NS, 1, "vue_1")
    track, speeds, attitude = _strapdown(imu, motion)
    truth = motion.at((imu.stamp_ns - START_NS) * 1e-9)
    np.testing.assert_allclose(speeds[:, :2], truth.velocity, atol=1e-9)
    np.testing.assert_allclose(track[:, :2], truth.position, atol=2e-4)
    np.testing.assert_allclose(track[:, 2], 0, atol=1e-9)
    assert attitude.as_euler("zyx")[0] == pytest.approx(truth.yaw[-1], abs=1e-9)


def test_first_stamp_and_rate() -> None:
    imu = simulate_imu(PERFECT, _winding(), START_NS, 1, "vue_1")
    assert imu.stamp_ns[0] == START_NS + 10_000_000
    assert (np.diff(imu.stamp_ns) == 10_000_000).all()


def test_specific_force_at_rest_points_up_and_left_in_a_left_turn() -> None:
    motion = follow([[0, 0], [20, 0], [20, 20]], 2.0, corner_radius_m=5.0)
    imu = simulate_imu(PERFECT, motion, START_NS, 1, "v")
    turning = imu.angular_velocity[:, 2] > 0.39
    assert turning.any()
    np.testing.assert_allclose(imu.specific_force[0], [0, 0, 9.80665], atol=1e-12)
    np.testing.assert_allclose(imu.specific_force[turning][5], [0, 4 / 5, 9.80665], atol=1e-4)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_arc_is_felt_as_v_squared_over_r_and_turned_at_v_over_r(side: float) -> None:
    """A sample is a mean over dt, in which the force turns by w dt: shorter by sinc(w dt / 2)."""
    speed, radius = 5.0, 8.0
    legs = [Leg(10.0), Leg(2 * np.pi * radius, side * 2 * np.pi), Leg(10.0)]
    imu = simulate_imu(PERFECT, follow_legs([0, 0], 0.3, legs, speed), START_NS, 1, "v")
    t = (imu.stamp_ns - START_NS) * 1e-9
    inside = (t > 2.0 + 0.011) & (t < 2.0 + 2 * np.pi * radius / speed - 0.001)
    assert inside.sum() == pytest.approx(2 * np.pi * radius / speed * 100, abs=3)
    half = speed / radius * 0.01 / 2
    force = [0.0, side * speed**2 / radius * np.sin(half) / half, 9.80665]
    np.testing.assert_allclose(imu.specific_force[inside], [force] * inside.sum(), atol=1e-9)
    rates = imu.angular_velocity[inside]
    np.testing.assert_allclose(rates, [[0.0, 0.0, side * speed / radius]] * len(rates), atol=1e-9)
    straight = t < 2.0
    np.testing.assert_allclose(imu.specific_force[straight][:, 1], 0.0, atol=1e-12)


def test_noise_and_biases_have_the_stated_size() -> None:
    motion = follow([[0, 0], [100, 0]], 1.0)
    model = ImuModel()
    clean = simulate_imu(PERFECT, motion, START_NS, 1, "v")
    constants = []
    for seed in range(80):
        noisy = simulate_imu(model, motion, START_NS, seed, "v")
        error = np.hstack(
            [
                noisy.angular_velocity - clean.angular_velocity,
                noisy.specific_force - clean.specific_force,
            ]
        )
        constants.append(error.mean(axis=0))
        if seed == 0:
            white = np.diff(error, axis=0).var(axis=0) / 2
            np.testing.assert_allclose(white[:3], noisy.angular_velocity_var, rtol=0.05)
            np.testing.assert_allclose(white[3:], noisy.specific_force_var, rtol=0.05)
            assert noisy.angular_velocity_var == pytest.approx(1.4e-4**2 * 100)
    sd = np.array([1e-3] * 3 + [2e-2] * 3)
    for column in (np.array(constants) / sd).T:
        assert stats.kstest(column, "norm").pvalue > 1e-3


def test_gauss_markov_bias_is_stationary_with_its_correlation_time() -> None:
    quiet = ImuModel(
        gyro_noise_density_radps_sqrthz=0.0,
        accel_noise_density_mps2_sqrthz=0.0,
        gyro_constant_bias_sd_radps=0.0,
        accel_constant_bias_sd_mps2=0.0,
        gyro_bias_sd_radps=1e-3,
        accel_bias_sd_mps2=0.0,
        bias_correlation_time_s=1.0,
    )
    motion = follow([[0, 0], [2000, 0]], 1.0)
    bias = simulate_imu(quiet, motion, START_NS, 5, "v").angular_velocity[:, 0] / 1e-3
    assert bias.std() == pytest.approx(1.0, abs=0.1)
    assert np.corrcoef(bias[:-100], bias[100:])[0, 1] == pytest.approx(math.exp(-1), abs=0.1)


def test_a_jump_or_a_broken_rate_is_refused() -> None:
    with pytest.raises(ValueError, match="corner_radius_m > 0"):
        simulate_imu(PERFECT, follow([[0, 0], [9, 0], [9, 9]], 1.0), START_NS, 1, "v")
    with pytest.raises(ValueError, match="whole nanoseconds"):
        interval_ns(30.0)


def test_magnetometer_reads_the_field_in_body_axes() -> None:
    """Heading north the body sees (north, -east, up); the heading comes back from the field."""
    model = MagnetometerModel(noise_sd_t=0.0)
    motion = follow([[0, 0], [0, 10]], 1.0)
    stamps, field = simulate_magnetometer(model, motion, START_NS, 1, "v")
    assert stamps[0] == START_NS
    east, north, up = model.field_map
    np.testing.assert_allclose(field[3], [north, -east, up], atol=1e-12)
    assert np.linalg.norm(field[0]) == pytest.approx(52e-6)
    assert up < 0
    assert math.degrees(math.atan2(east, north)) == pytest.approx(11.0)
