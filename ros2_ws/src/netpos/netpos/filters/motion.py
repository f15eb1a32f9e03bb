"""Process models: nearly constant velocity, a two-state clock, first-order Gauss-Markov biases."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numba import njit

from netpos.messages.values import Array

SPEED_OF_LIGHT_MPS = 299_792_458.0


class StateIndex(IntEnum):
    """Order of the state; biases follow ``N_CORE`` entries."""

    X = 0
    Y = 1
    VX = 2
    VY = 3
    CLOCK = 4
    DRIFT = 5


N_CORE = len(StateIndex)


class ProcessNoise(IntEnum):
    """How Q follows from the elapsed time."""

    CONTINUOUS = 0  # continuous white acceleration and white + random-walk frequency noise
    WERNER = 1  # per step diag(0, 0, sv^2, sv^2, 0, seta^2), fokin2020:eq.4
    WHITE_ACCELERATION = 2  # per step G G' ss^2, fokin2020:eq.36; clock as WERNER


@njit(cache=True)
def transition(n: int, dt: float, bias_tau_s: Array) -> Array:
    """Transition matrix F (n, n) over ``dt`` seconds (fokin2020:eq.35); biases decay with their
    time constants (n - 6,)."""
    F = np.eye(n)
    F[0, 2] = dt
    F[1, 3] = dt
    F[4, 5] = dt
    for i in range(bias_tau_s.size):
        F[6 + i, 6 + i] = math.exp(-dt / bias_tau_s[i])
    return F


@njit(cache=True)
def process_noise(
    kind: int,
    dt: float,
    accel: float,
    velocity_step: float,
    offset_density: float,
    drift_density: float,
    drift_step: float,
    bias_sd: Array,
    bias_tau_s: Array,
) -> Array:
    """Process noise covariance Q (n, n) over ``dt`` seconds.

    accel : CONTINUOUS: acceleration density [m/s^2/sqrt(Hz)]; WHITE_ACCELERATION: acceleration sd
        [m/s^2]
    velocity_step : WERNER: velocity sd per step [m/s]
    offset_density, drift_density : CONTINUOUS: clock white and random-walk frequency noise
        [m/sqrt(s)], [m/s/sqrt(s)]
    drift_step : WERNER, WHITE_ACCELERATION: drift sd per step [m/s]
    bias_sd, bias_tau_s : (k,) stationary sd and correlation time of each bias
    """
    n = 6 + bias_sd.size
    Q = np.zeros((n, n))
    if dt <= 0.0:
        return Q
    if kind == 0:
        q = accel * accel
        for p in range(2):
            v = p + 2
            Q[p, p] = q * dt**3 / 3.0
            Q[p, v] = Q[v, p] = q * dt**2 / 2.0
            Q[v, v] = q * dt
        q1 = offset_density * offset_density
        q2 = drift_density * drift_density
        Q[4, 4] = q1 * dt + q2 * dt**3 / 3.0
        Q[4, 5] = Q[5, 4] = q2 * dt**2 / 2.0
        Q[5, 5] = q2 * dt
    else:
        if kind == 1:
            Q[2, 2] = Q[3, 3] = velocity_step * velocity_step
        else:
            q = accel * accel
            for p in range(2):
                v = p + 2
                Q[p, p] = q * dt**4 / 4.0
                Q[p, v] = Q[v, p] = q * dt**3 / 2.0
                Q[v, v] = q * dt**2
        Q[5, 5] = drift_step * drift_step
    for i in range(bias_sd.size):
        Q[6 + i, 6 + i] = bias_sd[i] ** 2 * (1.0 - math.exp(-2.0 * dt / bias_tau_s[i]))
    return Q
