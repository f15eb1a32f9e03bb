"""A device driven by the yaw rate and forward acceleration of its IMU: states their biases
[rad/s], [m/s^2], random walks."""

from __future__ import annotations

import math

from netpos.common.parameters import real
from netpos.estimation.compile import inlined, leaf
from netpos.estimation.motion.model import MotionModel
from netpos.estimation.motion.parameters import OWN, Parameter
from netpos.estimation.motion.process_noise import add_white_acceleration
from netpos.estimation.state import X
from netpos.messages.values import Array

_GYRO_BIAS_WALK, _ACCEL_BIAS_WALK = OWN, OWN + 1  # [rad/s/sqrt(s)], [m/s^2/sqrt(s)]
# Below this speed [m/s] a forward acceleration says nothing about a direction.
_CREEP_MPS = 0.2


@leaf
def _turned(mean: Array, dt: float, motion: Array) -> tuple[float, float, float]:
    """Rotated velocity w and speed increment a, biases removed."""
    theta = motion[Parameter.YAW_INCREMENT] - mean[X.GYRO_BIAS] * dt
    c, s = math.cos(theta), math.sin(theta)
    wx = c * mean[X.VX] - s * mean[X.VY]
    wy = s * mean[X.VX] + c * mean[X.VY]
    return wx, wy, motion[Parameter.SPEED_INCREMENT] - mean[X.ACCEL_BIAS] * dt


@inlined
def propagate(mean: Array, dt: float, motion: Array) -> None:
    """The velocity is turned and made longer; the position moves by the mean of both."""
    vx, vy = mean[X.VX], mean[X.VY]
    wx, wy, gain = _turned(mean, dt, motion)
    size = math.sqrt(wx * wx + wy * wy + _CREEP_MPS * _CREEP_MPS)
    mean[X.VX] = wx * (1.0 + gain / size)
    mean[X.VY] = wy * (1.0 + gain / size)
    mean[X.PX] += dt * (vx + mean[X.VX]) / 2.0
    mean[X.PY] += dt * (vy + mean[X.VY]) / 2.0


@leaf
def transition(mean: Array, dt: float, motion: Array, F: Array) -> None:
    """Derivatives of turning and of making longer."""
    theta = motion[Parameter.YAW_INCREMENT] - mean[X.GYRO_BIAS] * dt
    c, s = math.cos(theta), math.sin(theta)
    wx, wy, gain = _turned(mean, dt, motion)
    size = math.sqrt(wx * wx + wy * wy + _CREEP_MPS * _CREEP_MPS)
    cube = size * size * size
    axx = 1.0 + gain * (1.0 / size - wx * wx / cube)
    ayy = 1.0 + gain * (1.0 / size - wy * wy / cube)
    axy = -gain * wx * wy / cube
    F[X.VX, X.VX], F[X.VX, X.VY] = axx * c + axy * s, -axx * s + axy * c
    F[X.VY, X.VX], F[X.VY, X.VY] = axy * c + ayy * s, -axy * s + ayy * c
    F[X.VX, X.GYRO_BIAS], F[X.VY, X.GYRO_BIAS] = (
        dt * (axx * wy - axy * wx),
        dt * (axy * wy - ayy * wx),
    )
    F[X.VX, X.ACCEL_BIAS], F[X.VY, X.ACCEL_BIAS] = -dt * wx / size, -dt * wy / size
    for axis in range(2):
        p, v = X.PX + axis, X.VX + axis
        F[p, X.VX], F[p, X.VY] = dt / 2.0 * F[v, X.VX], dt / 2.0 * F[v, X.VY]
        F[p, X.GYRO_BIAS] = dt / 2.0 * F[v, X.GYRO_BIAS]
        F[p, X.ACCEL_BIAS] = dt / 2.0 * F[v, X.ACCEL_BIAS]
        F[p, v] += dt / 2.0


@leaf
def add_noise(mean: Array, dt: float, motion: Array, cov: Array) -> None:
    """Continuous white acceleration, the walk of both biases, and the angle random walk of the
    gyro, which acts across ``mean``."""
    add_white_acceleration(dt, motion, True, cov)
    angle = motion[Parameter.GYRO] ** 2 * dt
    across = (-mean[X.VY] * dt / 2.0, mean[X.VX] * dt / 2.0, -mean[X.VY], mean[X.VX])
    for i in range(4):
        for j in range(4):
            cov[i, j] += angle * across[i] * across[j]
    cov[X.GYRO_BIAS, X.GYRO_BIAS] += motion[_GYRO_BIAS_WALK] ** 2 * dt
    cov[X.ACCEL_BIAS, X.ACCEL_BIAS] += motion[_ACCEL_BIAS_WALK] ** 2 * dt


MODEL = MotionModel(
    name="INERTIAL",
    propagate=propagate,
    transition=transition,
    add_noise=add_noise,
    summary="driven by the device's IMU",
    states=("GYRO_BIAS", "ACCEL_BIAS"),
    initial_sd=lambda config: (config.gyro_bias_sd_radps, config.accel_bias_sd_mps2),
    parameters={
        "inertial_manoeuvre_speed_sd_mps": real(
            0.0,
            0.0,
            1e3,
            "inertial, in place of manoeuvre_speed_sd_mps: velocity step that the IMU does not"
            " show",
        ),
        "gyro_bias_walk": real(
            1e-4, 0.0, 1.0, "inertial: walk of the yaw-rate bias [rad/s/sqrt(s)]"
        ),
        "accel_bias_walk": real(
            1e-2, 0.0, 10.0, "inertial: walk of the forward acceleration's bias [m/s^2/sqrt(s)]"
        ),
    },
    own={"gyro_bias": "gyro_bias_walk", "accel_bias": "accel_bias_walk"},
    accel_density="inertial_accel_density_mps2_sqrthz",
    manoeuvre_speed="inertial_manoeuvre_speed_sd_mps",
    uses_imu=True,
)
