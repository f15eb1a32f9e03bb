"""Simulated inertial sensors of a moving body: gyroscope, accelerometer, magnetometer.

The gyroscope and the accelerometer give increments over the sample interval (t - dt, t], divided
by dt. The specific force is the velocity increment less gravity, in the axes the body has half-way
through the rotation of the interval, so that a strapdown integrator which turns by half the angle,
adds the increment and turns by the other half returns the true velocity. The difference to the
body-fixed mean is of order (w dt)^2 / 24.

    w_m = (1 + s_g) r / dt + b_g + n_g,    f_m = (1 + s_a) R_mid^T (dv / dt - g) + b_a + n_a
    m_m = (I + S) R^T B(p) + h + n_m

r is the rotation vector of the interval. Scale errors s, soft iron S and hard iron h are drawn
once; biases b are a constant drawn once plus a first-order Gauss-Markov process; n is white with
the given density. Readings beyond a sensor's range stay at its end."""

from __future__ import annotations

import math
from dataclasses import dataclass as plain_dataclass

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from netpos.inertial.attitude import GRAVITY_MPS2
from netpos.radio.noise import generator, normals, stream_key
from netpos.world.body import BodyMotion

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

NS = 1_000_000_000

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, slots=True, kw_only=True, config=_STRICT)
class ImuModel:
    """Errors of an inertial sensor; the same for the three axes.

    The defaults are typical of an industrial MEMS unit (ADIS16470 class): noise densities of 0.008
    deg/s/sqrt(Hz) and 60 ug/sqrt(Hz)."""

    rate_hz: float = Field(default=100.0, gt=0)
    gyro_noise_density_radps_sqrthz: float = Field(default=1.4e-4, ge=0)
    accel_noise_density_mps2_sqrthz: float = Field(default=6e-4, ge=0)
    gyro_constant_bias_sd_radps: float = Field(default=1e-3, ge=0)
    accel_constant_bias_sd_mps2: float = Field(default=2e-2, ge=0)
    gyro_bias_sd_radps: float = Field(default=4e-5, ge=0)
    accel_bias_sd_mps2: float = Field(default=1e-3, ge=0)
    bias_correlation_time_s: float = Field(default=100.0, gt=0)
    gyro_scale_sd: float = Field(default=0.0, ge=0)
    accel_scale_sd: float = Field(default=0.0, ge=0)
    gyro_range_radps: float | None = Field(default=None, gt=0)
    accel_range_mps2: float | None = Field(default=None, gt=0)


@dataclass(frozen=True, slots=True, kw_only=True, config=_STRICT)
class MagneticDisturbance:
    """Iron or a current that adds to the field near a point: ``field_t`` (east, north, up) at
    ``center`` (x, y) in map [m], fading with the distance d as exp(-d^2 / (2 radius_m^2))."""

    center: tuple[float, float]
    radius_m: float = Field(gt=0)
    field_t: tuple[float, float, float]

    def at(self, position: Array) -> Array:
        """(n, 3) field [T] at positions (n, 2 or 3)."""
        away = np.sum((position[:, :2] - np.array(self.center)) ** 2, axis=1)
        share: Array = np.exp(-away / (2 * self.radius_m**2))
        return np.outer(share, self.field_t)


@dataclass(frozen=True, slots=True, kw_only=True, config=_STRICT)
class MagnetometerModel:
    """The earth's field at the place and the sensor's white noise per sample.

    Declination is positive where magnetic north lies east of north, inclination positive where the
    field points down (both as in the World Magnetic Model). Defaults: about St Petersburg.
    ``hard_iron_sd_t`` (per axis) and ``soft_iron_sd`` (per element of a symmetric matrix) are of
    magnets and iron worn with the sensor."""

    rate_hz: float = Field(default=50.0, gt=0)
    field_t: float = Field(default=52e-6, gt=0)
    declination_deg: float = Field(default=11.0, ge=-180, le=180)
    inclination_deg: float = Field(default=73.0, gt=-90, lt=90)
    noise_sd_t: float = Field(default=0.3e-6, ge=0)
    hard_iron_sd_t: float = Field(default=0.0, ge=0)
    soft_iron_sd: float = Field(default=0.0, ge=0, le=0.5)
    disturbances: tuple[MagneticDisturbance, ...] = ()

    @property
    def field_map(self) -> Array:
        """(3,) field in map (east, north, up) [T]."""
        declination = math.radians(self.declination_deg)
        inclination = math.radians(self.inclination_deg)
        level = math.cos(inclination)
        return self.field_t * np.array(
            [level * math.sin(declination), level * math.cos(declination), -math.sin(inclination)]
        )


@plain_dataclass(frozen=True, slots=True, kw_only=True)
class ImuSamples:
    """stamp_ns (n,), angular_velocity (n, 3) rad/s, specific_force (n, 3) m/s^2 in base_link;
    white-noise variances per axis."""

    stamp_ns: Stamps
    angular_velocity: Array
    specific_force: Array
    angular_velocity_var: float
    specific_force_var: float


def interval_ns(rate_hz: float) -> int:
    """Sample interval in whole nanoseconds.

    Raises
    ------
    ValueError  the interval is not a whole number of nanoseconds
    """
    interval = round(NS / rate_hz)
    if interval < 1 or abs(interval * rate_hz - NS) > 1e-6 * rate_hz:
        raise ValueError(
            f"rate_hz must divide a second into whole nanoseconds (such as 100), got {rate_hz}"
        )
    return interval


def simulate_imu(
    model: ImuModel, motion: BodyMotion, start_ns: int, seed: int, name: str
) -> ImuSamples:
    """All samples of a motion that starts at ``start_ns``; the first is stamped one interval after
    it.

    Raises
    ------
    ValueError  the motion jumps in velocity or heading, which no inertial sensor can follow
    """
    if not motion.smooth:
        raise ValueError(
            "an IMU needs a motion without jumps: give corners a corner_radius_m > 0 (or a "
            "pause to turn in) and pauses an acceleration_mps2"
        )
    dt_ns = interval_ns(model.rate_hz)
    ticks = np.arange(int(motion.duration_s * NS) // dt_ns + 1, dtype=np.int64) * dt_ns
    state = motion.body_at(ticks / NS)
    dt = dt_ns / NS
    turn = (state.rotation[:-1].inv() * state.rotation[1:]).as_rotvec()
    middle = state.rotation[:-1] * Rotation.from_rotvec(turn / 2)
    acceleration = np.diff(state.velocity, axis=0) / dt
    stamps = start_ns + ticks[1:]
    force = middle.inv().apply(acceleration + np.array([0.0, 0.0, GRAVITY_MPS2]))
    scale = generator(seed, f"{name}/imu/scale").standard_normal(6)
    gyro = turn / dt * (1 + model.gyro_scale_sd * scale[:3])
    force = force * (1 + model.accel_scale_sd * scale[3:])
    gyro_var = model.gyro_noise_density_radps_sqrthz**2 / dt
    force_var = model.accel_noise_density_mps2_sqrthz**2 / dt
    white = normals(stamps, 6, stream_key(seed, f"{name}/imu"))
    bias = _biases(model, stamps, dt, seed, name)
    return ImuSamples(
        stamp_ns=stamps,
        angular_velocity=_within(
            gyro + bias[:, :3] + math.sqrt(gyro_var) * white[:, :3], model.gyro_range_radps
        ),
        specific_force=_within(
            force + bias[:, 3:] + math.sqrt(force_var) * white[:, 3:], model.accel_range_mps2
        ),
        angular_velocity_var=gyro_var,
        specific_force_var=force_var,
    )


def _within(values: Array, limit: float | None) -> Array:
    return values if limit is None else np.clip(values, -limit, limit)


def _biases(model: ImuModel, stamps: Stamps, dt: float, seed: int, name: str) -> Array:
    """(n, 6) gyro and accelerometer biases: constant plus stationary Gauss-Markov."""
    constant_sd = np.repeat(
        [model.gyro_constant_bias_sd_radps, model.accel_constant_bias_sd_mps2], 3
    )
    moving_sd = np.repeat([model.gyro_bias_sd_radps, model.accel_bias_sd_mps2], 3)
    constant = constant_sd * generator(seed, f"{name}/imu/bias").standard_normal(6)
    decay = math.exp(-dt / model.bias_correlation_time_s)
    step = normals(stamps, 6, stream_key(seed, f"{name}/imu/bias_walk"))
    step[1:] *= math.sqrt(1 - decay**2)
    walk = lfilter([1.0], [1.0, -decay], step, axis=0)
    return np.asarray(constant + moving_sd * walk)


def simulate_magnetometer(
    model: MagnetometerModel, motion: BodyMotion, start_ns: int, seed: int, name: str
) -> tuple[Stamps, Array]:
    """Stamps (n,) from ``start_ns`` on, and the field (n, 3) in base_link [T]."""
    dt_ns = interval_ns(model.rate_hz)
    ticks = np.arange(int(motion.duration_s * NS) // dt_ns + 1, dtype=np.int64) * dt_ns
    state = motion.body_at(ticks / NS)
    field = model.field_map + sum((d.at(state.position) for d in model.disturbances), np.zeros(3))
    drawn = generator(seed, f"{name}/mag/iron").standard_normal(9)
    soft = np.eye(3)
    soft[np.triu_indices(3)] += model.soft_iron_sd * drawn[:6]
    soft[np.tril_indices(3, -1)] = soft.T[np.tril_indices(3, -1)]
    body = state.rotation.inv().apply(field) @ soft.T + model.hard_iron_sd_t * drawn[6:]
    stamps = start_ns + ticks
    noise = normals(stamps, 3, stream_key(seed, f"{name}/mag"))
    return stamps, body + model.noise_sd_t * noise
