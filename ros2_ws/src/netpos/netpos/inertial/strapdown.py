"""Strapdown inertial navigation in the local level: position, velocity, attitude from increments.

Navigation state (``NAV``, 16): position p and velocity v in map (east, north, up) [m, m/s],
quaternion x y z w of base_link to map, accelerometer bias [m/s^2], gyro bias [rad/s].
Error state (``ERR``, 15, true minus estimate): position, velocity, attitude phi in map axes with
C_true = exp(phi x) C, accelerometer bias, gyro bias.

With the increments of an interval T after one of length S (a = angle, d = velocity, both without
their biases; ' of the interval before; k = T^2 / (6 S (S + T)), 1/12 for S = T; exact for rates
and forces linear in time, Savage, J. Guidance Control Dynamics 21, 1998):

    coning     phi = a + k a' x a                                              (I1)
    sculling   s   = d + a x d / 2 + a x (a x d) / 6 + k (a' x d + d' x a)     (I2)
    velocity   v  += C s + (g - 2 w x v) T                                     (I3)
    attitude   C   = exp(-w T x) C exp(phi x), half of w T before (I2)         (I4)
    position   p  += (v_before + v_after) T / 2                                (I5)

w is the earth's rate and g its gravity in map. The map is flat: what turning with the curvature
of the earth would add (v / 6400 km, 0.5 deg/h at 16 m/s) is left to the gyro bias.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from netpos.inertial.attitude import GRAVITY_MPS2
from netpos.inertial.navigation_state import (
    ACCEL_BIAS,
    ACCEL_BIAS_ERR,
    ATTITUDE_ERR,
    ERR,
    GYRO_BIAS,
    GYRO_BIAS_ERR,
    NAV,
    POSITION,
    QUATERNION,
    VELOCITY,
)

__all__ = [
    "ACCEL_BIAS",
    "ACCEL_BIAS_ERR",
    "ATTITUDE_ERR",
    "EARTH_RATE_RADPS",
    "ERR",
    "GYRO_BIAS",
    "GYRO_BIAS_ERR",
    "NAV",
    "POSITION",
    "QUATERNION",
    "VELOCITY",
    "Earth",
    "InertialNoise",
    "cross",
    "decay_biases",
    "earth_at",
    "inject",
    "mechanise",
    "propagate",
    "rotate",
    "rotation_of",
    "still_earth",
    "transition",
]

Array = npt.NDArray[np.float64]

EARTH_RATE_RADPS = 7.292115e-5
_SMALL = 1e-8


class Earth(NamedTuple):
    """Gravity [m/s^2] and the earth's rate (3,) [rad/s] in map; the default does not turn."""

    gravity_mps2: float
    rate: Array


class InertialNoise(NamedTuple):
    """White noise and first-order Gauss-Markov biases (deng2022:eq.7), the same for all axes."""

    accel_density_mps2_sqrthz: float
    gyro_density_radps_sqrthz: float
    accel_bias_sd_mps2: float
    gyro_bias_sd_radps: float
    bias_correlation_time_s: float


def still_earth(gravity_mps2: float = GRAVITY_MPS2) -> Earth:
    """An earth that does not turn, as in the simulations."""
    return Earth(gravity_mps2, np.zeros(3))


def earth_at(latitude_rad: float, height_m: float = 0.0) -> Earth:
    """Gravity of the WGS 84 ellipsoid (Somigliana, free air) and the earth's rate at a place.

    Raises ``ValueError`` for a latitude outside [-pi/2, pi/2].
    """
    if not abs(latitude_rad) <= math.pi / 2:
        raise ValueError(f"latitude_rad must be within [-pi/2, pi/2], got {latitude_rad}")
    square = math.sin(latitude_rad) ** 2
    normal = 9.7803253359 * (1 + 0.00193185265241 * square)
    gravity = normal / math.sqrt(1 - 0.00669437999013 * square) - 3.086e-6 * height_m
    rate = EARTH_RATE_RADPS * np.array([0.0, math.cos(latitude_rad), math.sin(latitude_rad)])
    return Earth(gravity, rate)


@njit(cache=True, error_model="numpy")
def cross(a: Array, b: Array, out: Array) -> None:
    """``out`` = a x b; it must be neither of them."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy")
def rotation_of(q: Array, C: Array) -> None:
    """Rotation matrix ``C`` (3, 3) of a unit quaternion x y z w."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    C[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    C[0, 1] = 2.0 * (x * y - z * w)
    C[0, 2] = 2.0 * (x * z + y * w)
    C[1, 0] = 2.0 * (x * y + z * w)
    C[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    C[1, 2] = 2.0 * (y * z - x * w)
    C[2, 0] = 2.0 * (x * z - y * w)
    C[2, 1] = 2.0 * (y * z + x * w)
    C[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True, error_model="numpy")
def rotate(q: Array, turn: Array, in_map: bool) -> None:
    """Turn the orientation ``q`` (in place) by the rotation vector ``turn``: exp(turn x) C where
    it is in map axes, C exp(turn x) where it is in base_link."""
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    half = 0.5 - angle * angle / 48.0 if angle < _SMALL else math.sin(0.5 * angle) / angle
    a, b, c, d = half * turn[0], half * turn[1], half * turn[2], math.cos(0.5 * angle)
    x, y, z, w = q[0], q[1], q[2], q[3]
    sign = -1.0 if in_map else 1.0  # of the vector parts' cross product
    x_new = w * a + x * d + sign * (y * c - z * b)
    y_new = w * b + y * d + sign * (z * a - x * c)
    z_new = w * c + z * d + sign * (x * b - y * a)
    w_new = w * d - x * a - y * b - z * c
    norm = math.sqrt(x_new**2 + y_new**2 + z_new**2 + w_new**2)
    q[0], q[1], q[2], q[3] = x_new / norm, y_new / norm, z_new / norm, w_new / norm


@njit(cache=True, error_model="numpy")
def mechanise(
    nav: Array, increment: Array, dt: float, last: Array, earth: Earth, gained: Array
) -> None:
    """Move ``nav`` (NAV,) over one interval ``dt`` > 0 [s], in place (I1-I5).

    increment : (6,) integrals of angular velocity [rad] and specific force [m/s] as measured
    last : (7,) angle, velocity and length of the interval before, without biases; length 0: none.
        Replaced by this interval's.
    gained : (3,) the velocity the specific force gave, in map [m/s], is added to it
    """
    angle, velocity = np.empty(3), np.empty(3)
    for i in range(3):
        angle[i] = increment[i] - nav[GYRO_BIAS + i] * dt
        velocity[i] = increment[3 + i] - nav[ACCEL_BIAS + i] * dt
    work = np.empty((6, 3))
    turned, twice, coned, two, three = work[0], work[1], work[2], work[3], work[4]
    coriolis = work[5]
    cross(angle, velocity, turned)
    cross(angle, turned, twice)
    cross(last[:3], angle, coned)
    cross(last[:3], velocity, two)
    cross(last[3:6], angle, three)
    cross(earth.rate, nav[VELOCITY:QUATERNION], coriolis)
    span = last[6]
    k = dt * dt / (6.0 * span * (span + dt)) if span > 0.0 else 0.0
    C = np.empty((3, 3))
    rotate(nav[QUATERNION:ACCEL_BIAS], -0.5 * dt * earth.rate, True)
    rotation_of(nav[QUATERNION:ACCEL_BIAS], C)
    for i in range(3):
        sculled = 0.0
        for j in range(3):
            part = velocity[j] + 0.5 * turned[j] + twice[j] / 6.0 + k * (two[j] + three[j])
            sculled += C[i, j] * part
        gained[i] += sculled
        before = nav[VELOCITY + i]
        after = before + sculled - 2.0 * coriolis[i] * dt
        if i == 2:
            after -= earth.gravity_mps2 * dt
        nav[VELOCITY + i] = after
        nav[POSITION + i] += 0.5 * (before + after) * dt
    last[:3], last[3:6], last[6] = angle, velocity, dt
    rotate(nav[QUATERNION:ACCEL_BIAS], angle + k * coned, False)
    rotate(nav[QUATERNION:ACCEL_BIAS], -0.5 * dt * earth.rate, True)


@njit(cache=True, error_model="numpy")
def decay_biases(nav: Array, dt: float, time_s: float) -> None:
    """Let the estimated biases fade as first-order Gauss-Markov processes do."""
    fade = math.exp(-dt / time_s)
    for i in range(ACCEL_BIAS, NAV):
        nav[i] *= fade


@njit(cache=True, error_model="numpy")
def transition(gained: Array, C: Array, dt: float, time_s: float, earth: Earth) -> Array:
    """Phi (ERR, ERR) of the error state over ``dt`` [s] (deng2022:eq.7, integrated to dt^3).

    gained : (3,) velocity given by the specific force in map; C : (3, 3) mean attitude;
    time_s : correlation time of the biases
    """
    Phi = np.eye(ERR)
    fade = math.exp(-dt / time_s)
    for i in range(3):
        Phi[i, VELOCITY + i] = dt
        Phi[ACCEL_BIAS_ERR + i, ACCEL_BIAS_ERR + i] = fade
        Phi[GYRO_BIAS_ERR + i, GYRO_BIAS_ERR + i] = fade
        for j in range(3):
            Phi[VELOCITY + i, ACCEL_BIAS_ERR + j] = -dt * C[i, j]
            Phi[i, ACCEL_BIAS_ERR + j] = -0.5 * dt * dt * C[i, j]
            Phi[ATTITUDE_ERR + i, GYRO_BIAS_ERR + j] = -dt * C[i, j]
    for i in range(3):  # -[gained x]
        j, k = (i + 1) % 3, (i + 2) % 3
        Phi[VELOCITY + i, ATTITUDE_ERR + j] = gained[k]
        Phi[VELOCITY + i, ATTITUDE_ERR + k] = -gained[j]
        Phi[i, ATTITUDE_ERR + j] = 0.5 * dt * gained[k]
        Phi[i, ATTITUDE_ERR + k] = -0.5 * dt * gained[j]
        for m in range(3):  # [gained x] C
            turned = gained[j] * C[k, m] - gained[k] * C[j, m]
            Phi[VELOCITY + i, GYRO_BIAS_ERR + m] = 0.5 * dt * turned
            Phi[i, GYRO_BIAS_ERR + m] = dt * dt * turned / 6.0
        Phi[ATTITUDE_ERR + i, ATTITUDE_ERR + j] += dt * earth.rate[k]  # -[w x] dt
        Phi[ATTITUDE_ERR + i, ATTITUDE_ERR + k] -= dt * earth.rate[j]
        Phi[VELOCITY + i, VELOCITY + j] += 2.0 * dt * earth.rate[k]
        Phi[VELOCITY + i, VELOCITY + k] -= 2.0 * dt * earth.rate[j]
    return Phi


@njit(cache=True, error_model="numpy")
def propagate(cov: Array, Phi: Array, dt: float, noise: InertialNoise) -> None:
    """cov (n, n) = Phi (cov + Q dt / 2) Phi' + Q dt / 2, in place and symmetric; Phi (n, n).
    States beyond the first ERR get no noise."""
    n = cov.shape[0]
    half = np.zeros(n)
    rate = 2.0 / noise.bias_correlation_time_s
    half[VELOCITY:ATTITUDE_ERR] = 0.5 * dt * noise.accel_density_mps2_sqrthz**2
    half[ATTITUDE_ERR:ACCEL_BIAS_ERR] = 0.5 * dt * noise.gyro_density_radps_sqrthz**2
    half[ACCEL_BIAS_ERR:GYRO_BIAS_ERR] = 0.5 * dt * rate * noise.accel_bias_sd_mps2**2
    half[GYRO_BIAS_ERR:ERR] = 0.5 * dt * rate * noise.gyro_bias_sd_radps**2
    moved = np.zeros((n, n))
    for i in range(n):
        cov[i, i] += half[i]
    for i in range(n):
        for k in range(n):
            phi = Phi[i, k]
            if phi != 0.0:
                for j in range(n):
                    moved[i, j] += phi * cov[k, j]
    for i in range(n):
        for j in range(i + 1):
            total = half[i] if i == j else 0.0
            for k in range(n):
                if Phi[j, k] != 0.0:
                    total += moved[i, k] * Phi[j, k]
            cov[i, j] = cov[j, i] = total


@njit(cache=True, error_model="numpy")
def inject(nav: Array, error: Array) -> None:
    """Closed loop: take the estimated ``error`` (n,) into ``nav`` (n + 1,), in place; n >= ERR,
    entries beyond the first ERR are plain sums."""
    for i in range(6):
        nav[i] += error[i]
    rotate(nav[QUATERNION:ACCEL_BIAS], error[ATTITUDE_ERR:ACCEL_BIAS_ERR], True)
    for i in range(ACCEL_BIAS_ERR, error.size):
        nav[i + 1] += error[i]
