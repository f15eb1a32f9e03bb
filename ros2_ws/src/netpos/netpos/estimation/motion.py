"""Process models f, F and Q: the motion of a device, its two-state clock, slow sensor biases.

Entries of the state beyond the core (``state.X``) belong to the motion model first
(``extra_states``), then to the biases, first-order Gauss-Markov processes.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from netpos.estimation.compile import inlined, leaf
from netpos.estimation.state import N_CORE, X
from netpos.messages.values import Array

SPEED_OF_LIGHT_MPS = 299_792_458.0


class Model(IntEnum):
    """How a device moves."""

    CONSTANT_VELOCITY = 0
    CONSTANT_TURN = 1  # extra state: turn rate [rad/s]
    CONSTANT_ACCELERATION = 2  # extra states: acceleration x, y [m/s^2]
    STATIONARY = 3  # at rest; the stop model of an interacting set
    INERTIAL = 4  # driven by yaw rate and forward acceleration; extra states: their biases
    RIGID_BODY = 5  # constant velocity and a heading of its own; extra states: yaw, yaw rate


class ProcessNoise(IntEnum):
    """How Q of motion and clock follows from the elapsed time."""

    CONTINUOUS = 0  # continuous white acceleration and white + random-walk frequency noise
    WERNER = 1  # per step diag(0, 0, sv^2, sv^2, 0, seta^2), fokin2020:eq.4
    WHITE_ACCELERATION = 2  # per step G G' ss^2, fokin2020:eq.36; clock as WERNER


class Parameter(IntEnum):
    """Entries of the vector ``motion`` that the kernels take."""

    MODEL = 0
    NOISE = 1
    EXTRAS = 2  # state entries of the motion model
    ACCEL = 3  # CONTINUOUS, INERTIAL: density [m/s^2/sqrt(Hz)]; WHITE_ACCELERATION: sd [m/s^2]
    VELOCITY_STEP = 4  # WERNER: sd per step [m/s]
    OFFSET_DENSITY = 5  # CONTINUOUS: clock white frequency noise [m/sqrt(s)]
    DRIFT_DENSITY = 6  # CONTINUOUS: clock random-walk frequency noise [m/s/sqrt(s)]
    DRIFT_STEP = 7  # WERNER, WHITE_ACCELERATION: sd per step [m/s]
    TURN_RATE = 8  # CONSTANT_TURN, RIGID_BODY: walk of the turn or yaw rate [rad/s/sqrt(s)]
    JERK = 9  # CONSTANT_ACCELERATION: density [m/s^3/sqrt(Hz)]
    REST_SPEED = 10  # STATIONARY: speed sd [m/s]
    GYRO = 11  # INERTIAL: angle random walk [rad/sqrt(s)]
    GYRO_BIAS = 12  # INERTIAL: random walk of the yaw-rate bias [rad/s/sqrt(s)]
    ACCEL_BIAS = 13  # INERTIAL: random walk of the acceleration bias [m/s^2/sqrt(s)]
    YAW_INCREMENT = 14  # INERTIAL, input: integrated yaw rate over the step [rad]
    SPEED_INCREMENT = 15  # INERTIAL, input: integrated forward acceleration over the step [m/s]
    VELOCITY_STEP_SD = 16  # [m/s] of a velocity step that the filter allowed for; 0: none
    VELOCITY_STEP_AGE = 17  # how long ago it happened [s]
    VELOCITY_STEP_POSITION_SD = 18  # [m] of the position it led to: its time is not known


_EXTRAS = {
    Model.CONSTANT_TURN: 1,
    Model.CONSTANT_ACCELERATION: 2,
    Model.INERTIAL: 2,
    Model.RIGID_BODY: 2,
}
NO_BIAS = np.zeros((2, 0))
# Below this speed [m/s] a forward acceleration says nothing about a direction.
_CREEP_MPS = 0.2


def extra_states(model: Model) -> int:
    """Number of state entries a motion model adds to the core."""
    return _EXTRAS.get(model, 0)


def motion_parameters(
    model: Model = Model.CONSTANT_VELOCITY,
    noise: ProcessNoise = ProcessNoise.CONTINUOUS,
    extras: int | None = None,
    **values: float,
) -> Array:
    """Vector of ``Parameter``; ``values`` are named as its entries in lower case, 0 where absent.

    ``extras`` larger than the model's own number makes models share one state (interacting
    models). Raises ``KeyError`` for an unknown name.
    """
    motion = np.zeros(len(Parameter))
    motion[Parameter.MODEL] = model
    motion[Parameter.NOISE] = noise
    motion[Parameter.EXTRAS] = extra_states(model) if extras is None else extras
    for name, value in values.items():
        motion[Parameter[name.upper()]] = value
    return motion


@leaf
def _turn(rate: float, dt: float) -> tuple[float, float, float, float]:
    """sin(rate dt)/rate, (1 - cos(rate dt))/rate and their derivatives with respect to rate."""
    angle = rate * dt
    if abs(angle) < 1e-4:
        along = dt * (1.0 - angle * angle / 6.0)
        across = dt * angle / 2.0
        return along, across, -dt * dt * angle / 3.0, dt * dt * (0.5 - angle * angle / 8.0)
    s, c = math.sin(angle), math.cos(angle)
    along, across = s / rate, (1.0 - c) / rate
    return along, across, (dt * c - along) / rate, (dt * s - across) / rate


@leaf
def _inertial_velocity(mean: Array, dt: float, motion: Array) -> tuple[float, float, float]:
    """Rotated velocity w and speed increment a of the INERTIAL model, biases removed."""
    theta = motion[Parameter.YAW_INCREMENT] - mean[X.GYRO_BIAS] * dt
    c, s = math.cos(theta), math.sin(theta)
    wx = c * mean[X.VX] - s * mean[X.VY]
    wy = s * mean[X.VX] + c * mean[X.VY]
    return wx, wy, motion[Parameter.SPEED_INCREMENT] - mean[X.ACCEL_BIAS] * dt


@inlined
def propagate(mean: Array, dt: float, motion: Array, bias: Array) -> None:
    """f: move ``mean`` (n,) by ``dt`` seconds in place; bias (2, k): stationary sd and time
    constant of each bias."""
    model = int(motion[Parameter.MODEL])
    extras = int(motion[Parameter.EXTRAS])
    vx, vy = mean[X.VX], mean[X.VY]
    if model == Model.CONSTANT_TURN:
        along, across, _, _ = _turn(mean[X.TURN_RATE], dt)
        angle = mean[X.TURN_RATE] * dt
        c, s = math.cos(angle), math.sin(angle)
        mean[X.PX] += along * vx - across * vy
        mean[X.PY] += across * vx + along * vy
        mean[X.VX] = c * vx - s * vy
        mean[X.VY] = s * vx + c * vy
    elif model == Model.STATIONARY:
        mean[X.VX] = mean[X.VY] = 0.0
    elif model == Model.INERTIAL:
        wx, wy, gain = _inertial_velocity(mean, dt, motion)
        size = math.sqrt(wx * wx + wy * wy + _CREEP_MPS * _CREEP_MPS)
        mean[X.VX] = wx * (1.0 + gain / size)
        mean[X.VY] = wy * (1.0 + gain / size)
        mean[X.PX] += dt * (vx + mean[X.VX]) / 2.0
        mean[X.PY] += dt * (vy + mean[X.VY]) / 2.0
    else:
        mean[X.PX] += dt * vx
        mean[X.PY] += dt * vy
        if model == Model.CONSTANT_ACCELERATION:
            for axis in range(2):
                mean[X.PX + axis] += dt * dt / 2.0 * mean[X.AX + axis]
                mean[X.VX + axis] += dt * mean[X.AX + axis]
        elif model == Model.RIGID_BODY:
            mean[X.YAW] += dt * mean[X.YAW_RATE]
    if model == Model.CONSTANT_VELOCITY or model == Model.STATIONARY:
        for i in range(N_CORE, N_CORE + extras):
            mean[i] = 0.0
    mean[X.CLOCK] += dt * mean[X.DRIFT]
    for i in range(bias.shape[1]):
        mean[N_CORE + extras + i] *= math.exp(-dt / bias[1, i])


@leaf
def transition(mean: Array, dt: float, motion: Array, bias: Array, F: Array) -> None:
    """Jacobian of ``propagate`` at ``mean`` (n,), written to F (n, n); fokin2020:eq.35 for
    constant velocity."""
    model = int(motion[Parameter.MODEL])
    extras = int(motion[Parameter.EXTRAS])
    F[:] = 0.0
    for i in range(mean.size):
        F[i, i] = 1.0
    F[X.CLOCK, X.DRIFT] = dt
    if model == Model.CONSTANT_TURN:
        _turn_jacobian(mean, dt, F)
    elif model == Model.STATIONARY:
        F[X.VX, X.VX] = F[X.VY, X.VY] = 0.0
    elif model == Model.INERTIAL:
        _inertial_jacobian(mean, dt, motion, F)
    else:
        F[X.PX, X.VX] = F[X.PY, X.VY] = dt
        if model == Model.CONSTANT_ACCELERATION:
            for axis in range(2):
                F[X.PX + axis, X.AX + axis] = dt * dt / 2.0
                F[X.VX + axis, X.AX + axis] = dt
        elif model == Model.RIGID_BODY:
            F[X.YAW, X.YAW_RATE] = dt
    if model == Model.CONSTANT_VELOCITY or model == Model.STATIONARY:
        for i in range(N_CORE, N_CORE + extras):
            F[i, i] = 0.0
    for i in range(bias.shape[1]):
        k = N_CORE + extras + i
        F[k, k] = math.exp(-dt / bias[1, i])


@leaf
def _turn_jacobian(mean: Array, dt: float, F: Array) -> None:
    vx, vy, rate = mean[X.VX], mean[X.VY], mean[X.TURN_RATE]
    along, across, d_along, d_across = _turn(rate, dt)
    c, s = math.cos(rate * dt), math.sin(rate * dt)
    F[X.PX, X.VX], F[X.PX, X.VY], F[X.PX, X.TURN_RATE] = (
        along,
        -across,
        d_along * vx - d_across * vy,
    )
    F[X.PY, X.VX], F[X.PY, X.VY], F[X.PY, X.TURN_RATE] = (
        across,
        along,
        d_across * vx + d_along * vy,
    )
    F[X.VX, X.VX], F[X.VX, X.VY], F[X.VX, X.TURN_RATE] = c, -s, dt * (-s * vx - c * vy)
    F[X.VY, X.VX], F[X.VY, X.VY], F[X.VY, X.TURN_RATE] = s, c, dt * (c * vx - s * vy)


@leaf
def _inertial_jacobian(mean: Array, dt: float, motion: Array, F: Array) -> None:
    theta = motion[Parameter.YAW_INCREMENT] - mean[X.GYRO_BIAS] * dt
    c, s = math.cos(theta), math.sin(theta)
    wx, wy, gain = _inertial_velocity(mean, dt, motion)
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


@inlined
def add_noise(mean: Array, dt: float, motion: Array, bias: Array, cov: Array) -> None:
    """Add the process noise covariance over ``dt`` > 0 seconds to ``cov`` (n, n) in place.

    ``mean`` (n,) is the state after the step: the INERTIAL model's heading noise acts across it.
    """
    model = int(motion[Parameter.MODEL])
    extras = int(motion[Parameter.EXTRAS])
    if model == Model.STATIONARY:
        rest = motion[Parameter.REST_SPEED] ** 2
        for p in range(2):
            v = X.VX + p
            cov[p, p] += rest * dt * dt / 4.0
            cov[p, v] += rest * dt / 2.0
            cov[v, p] += rest * dt / 2.0
            cov[v, v] += rest
    elif model == Model.CONSTANT_ACCELERATION:
        _add_jerk(dt, motion[Parameter.JERK] ** 2, cov)
    else:
        _add_acceleration(dt, motion, cov)
    _add_clock(dt, motion, cov)
    age_s, position_sd = (
        motion[Parameter.VELOCITY_STEP_AGE],
        motion[Parameter.VELOCITY_STEP_POSITION_SD],
    )
    add_velocity_step(motion[Parameter.VELOCITY_STEP_SD], age_s, position_sd, cov)
    if model == Model.CONSTANT_TURN:
        cov[X.TURN_RATE, X.TURN_RATE] += motion[Parameter.TURN_RATE] ** 2 * dt
    elif model == Model.RIGID_BODY:
        add_walk(X.YAW, X.YAW_RATE, dt, motion[Parameter.TURN_RATE] ** 2, cov)
    elif model == Model.INERTIAL:
        _add_inertial(mean, dt, motion, cov)
    elif model == Model.CONSTANT_VELOCITY or model == Model.STATIONARY:
        for i in range(N_CORE, N_CORE + extras):
            cov[i, i] += motion[Parameter.TURN_RATE] ** 2 * dt
    for i in range(bias.shape[1]):
        k = N_CORE + extras + i
        cov[k, k] += bias[0, i] ** 2 * (1.0 - math.exp(-2.0 * dt / bias[1, i]))


@inlined
def add_velocity_step(sd: float, time_s: float, position_sd: float, cov: Array) -> None:
    """Add, in place, a velocity step of ``sd`` [m/s] per axis ``time_s`` ago, and the position it
    leads to, known but for ``position_sd`` (sd). Nothing happens for sd 0."""
    if sd == 0.0:
        return
    for p in range(2):
        v = X.VX + p
        cov[p, p] += (sd * time_s) ** 2 + position_sd**2
        cov[p, v] += sd * sd * time_s
        cov[v, p] += sd * sd * time_s
        cov[v, v] += sd * sd


@inlined
def _add_acceleration(dt: float, motion: Array, cov: Array) -> None:
    kind = int(motion[Parameter.NOISE])
    continuous = kind == ProcessNoise.CONTINUOUS
    if int(motion[Parameter.MODEL]) == Model.INERTIAL:
        continuous = True
    elif kind == ProcessNoise.WERNER:
        step = motion[Parameter.VELOCITY_STEP] ** 2
        cov[X.VX, X.VX] += step
        cov[X.VY, X.VY] += step
        return
    q = motion[Parameter.ACCEL] ** 2
    if continuous:
        pp, pv, vv = q * dt**3 / 3.0, q * dt**2 / 2.0, q * dt
    else:
        pp, pv, vv = q * dt**4 / 4.0, q * dt**3 / 2.0, q * dt**2
    for p in range(2):
        v = X.VX + p
        cov[p, p] += pp
        cov[p, v] += pv
        cov[v, p] += pv
        cov[v, v] += vv


@leaf
def _add_jerk(dt: float, q: float, cov: Array) -> None:
    for p in range(2):
        v, a = X.VX + p, X.AX + p
        cov[p, p] += q * dt**5 / 20.0
        cov[v, v] += q * dt**3 / 3.0
        cov[a, a] += q * dt
        for i, j, value in (
            (p, v, q * dt**4 / 8.0),
            (p, a, q * dt**3 / 6.0),
            (v, a, q * dt**2 / 2.0),
        ):
            cov[i, j] += value
            cov[j, i] += value


@inlined
def _add_clock(dt: float, motion: Array, cov: Array) -> None:
    if int(motion[Parameter.NOISE]) != ProcessNoise.CONTINUOUS:
        cov[X.DRIFT, X.DRIFT] += motion[Parameter.DRIFT_STEP] ** 2
        return
    cov[X.CLOCK, X.CLOCK] += motion[Parameter.OFFSET_DENSITY] ** 2 * dt
    add_walk(X.CLOCK, X.DRIFT, dt, motion[Parameter.DRIFT_DENSITY] ** 2, cov)


@inlined
def add_walk(value: int, rate: int, dt: float, q: float, cov: Array) -> None:
    """Noise of a value whose rate does a random walk of density ``q``."""
    cov[value, value] += q * dt**3 / 3.0
    cov[value, rate] += q * dt**2 / 2.0
    cov[rate, value] += q * dt**2 / 2.0
    cov[rate, rate] += q * dt


@leaf
def _add_inertial(mean: Array, dt: float, motion: Array, cov: Array) -> None:
    angle = motion[Parameter.GYRO] ** 2 * dt
    across = (-mean[X.VY] * dt / 2.0, mean[X.VX] * dt / 2.0, -mean[X.VY], mean[X.VX])
    for i in range(4):
        for j in range(4):
            cov[i, j] += angle * across[i] * across[j]
    cov[X.GYRO_BIAS, X.GYRO_BIAS] += motion[Parameter.GYRO_BIAS] ** 2 * dt
    cov[X.ACCEL_BIAS, X.ACCEL_BIAS] += motion[Parameter.ACCEL_BIAS] ** 2 * dt


@leaf
def noise(mean: Array, dt: float, motion: Array, bias: Array, Q: Array) -> None:
    """Process noise covariance over ``dt`` seconds, written to Q (n, n); 0 for dt <= 0."""
    Q[:] = 0.0
    if dt > 0.0:
        add_noise(mean, dt, motion, bias, Q)
