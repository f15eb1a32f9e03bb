"""Closed-loop error-state filter of a strapdown system, 15 states (deng2022:eq.7, 8) and more.

The states of ``inertial.strapdown`` may be followed by those of slow errors: offset and drift of
the device's clock [m, m/s], then biases of the RSUs, first-order Gauss-Markov. With n states in
all ``cov`` is (n, n) and ``nav`` (n + 1,): the entry i of the error state, i >= ERR, is the entry
i + 1 of ``nav``. n is ERR where there are none.

``advance`` moves the navigation state by the IMU and its covariance with it, ``correct`` fuses the
rows of one epoch: sequential scalar updates, linearised again at their own result (an iterated
extended Kalman filter), each group of rows gated. The estimated error goes straight into the
navigation state, so that it is always zero between updates.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import (
    GATE_VARIANCE,
    GROUP,
    KIND,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.estimation.motion import add_walk
from netpos.estimation.spatial.space import bend_mean, innovation_at, linearise_in_space
from netpos.estimation.state import ERR_BIASES, Err, Nav
from netpos.estimation.update.fusion import W_GAIN, fuse
from netpos.estimation.update.gate import gate_groups, select_rows
from netpos.inertial.strapdown import (
    ACCEL_BIAS,
    ERR,
    GYRO_BIAS,
    NAV,
    QUATERNION,
    Earth,
    InertialNoise,
    decay_biases,
    inject,
    mechanise,
    propagate,
    rotation_of,
    transition,
)
from netpos.messages.values import Array

Stamps = NDArray[np.int64]

ITERATIONS = 6
_SETTLED_M = 1e-4
CHUNK_S = 0.1
"""The covariance moves, and constraints hold, once per so much time."""
_CHUNK_NS = round(CHUNK_S * 1e9)
HOLE_S = 0.05
"""A longer silence of the IMU is a hole."""
BLIND = (1.0, 0.3)
"""Densities of force [m/s^2/sqrt(Hz)] and rate [rad/s/sqrt(Hz)] in a hole of the IMU."""

# Of MEMORY: the last increments, how many chunks were quiet, their mean specific force (3,)
LAST, QUIET, REST_FORCE = 7, 7, 8
MEMORY = 11
_QUIET_CHUNKS = 20
_CREEP_MPS = 1.0
_DOUBT_CHUNKS = 100
"""What contradicts the state ends a standstill, and no other begins for so long."""
_CONSTRAINT_GATE = np.array([0.0, 15.14])  # chi-square, 1 dof, 0.9999
_BODY_VELOCITY, _BODY_RATE = int(Kind.BODY_VELOCITY), int(Kind.BODY_RATE)


class Constraints(NamedTuple):
    """What a road vehicle does not do; an sd of 0 leaves it out.

    sideways, upwards: velocity in base_link across the way. standstill: any velocity (and the
    gyro shows its bias) after two seconds in which the specific force, taken over 0.1 s, stays
    within ``still_force_mps2`` of its mean and the rate below ``still_rate_radps``: a vehicle that
    sets off shows its acceleration first.
    """

    sideways_sd_mps: float
    upwards_sd_mps: float
    standstill_sd_mps: float
    still_force_mps2: float
    still_rate_radps: float


UNCONSTRAINED = Constraints(0.0, 0.0, 0.0, 0.0, 0.0)


class SlowErrors(NamedTuple):
    """How what follows the states of the strapdown system moves: white and random-walk frequency
    noise of the clock [m/sqrt(s), m/s/sqrt(s)], biases (2, k) stationary sd and time constant."""

    clock_white: float
    clock_walk: float
    biases: Array


NO_SLOW_ERRORS = SlowErrors(0.0, 0.0, np.zeros((2, 0)))


class Sensors(NamedTuple):
    """What the filter takes to be true of IMU, earth, vehicle, clock and RSUs."""

    noise: InertialNoise
    earth: Earth
    constraints: Constraints
    slow: SlowErrors = NO_SLOW_ERRORS


class Imu(NamedTuple):
    """Samples in base_link: stamps_ns (n,) increasing, rates (n, 6) angular velocity and specific
    force; a sample holds from the stamp before it to its own."""

    stamps_ns: Stamps
    rates: Array


@kernel
def correct(
    nav: Array, cov: Array, rows: Array, gate_nis: Array, accepted: Array
) -> tuple[float, int]:
    """Fuse ``rows`` (m, ROW_WIDTH) into ``nav`` (n + 1,) and ``cov`` (n, n), in place.

    gate_nis : as of ``gate.gate_groups``; accepted : (groups,) filled with 1 or 0
    Returns the NIS of the accepted rows together and their number.
    """
    m, n = rows.shape[0], cov.shape[0]
    C, variance, S = np.empty((3, 3)), np.empty(m), np.empty((m, m))
    innovation, H, bends = linearise_in_space(rows, nav, cov)
    for i in range(m):
        bend = bends[i]
        variance[i] = rows[i, VARIANCE] + bend
        projected = _times(cov, H[i])
        for j in range(m):
            S[i, j] = _dot(H[j], projected)
        S[i, i] += rows[i, GATE_VARIANCE] + bend
    gate_groups(rows, innovation, S, gate_nis, accepted)
    index, nis = select_rows(rows, innovation, S, gate_nis, accepted)
    if index.size == 0:
        return 0.0, 0
    prior, error, use, work = nav.copy(), np.zeros(n), np.zeros(m), np.empty((W_GAIN + 1, n))
    use[index] = 1.0
    posterior = cov
    for _ in range(ITERATIONS):
        step, posterior = np.zeros(n), cov.copy()
        about = innovation + H @ error  # linearised about the last error
        fuse(step, posterior, about, H, variance, use, work)
        change = 0.0
        for i in range(3):
            change = max(change, abs(step[i] - error[i]))
        error = step
        nav[:] = prior
        inject(nav, error)
        if change < _SETTLED_M:
            break
        rotation_of(nav[QUATERNION:ACCEL_BIAS], C)
        for i in index:
            at_mean = innovation_at(rows[i], nav, C, H[i])
            innovation[i] = at_mean - bend_mean(rows[i], nav, posterior)
    cov[:] = posterior
    return nis, index.size


@kernel
def _dot(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@kernel
def _times(P: Array, h: Array) -> Array:
    """P h, h mostly zeros."""
    n = h.size
    out = np.zeros(n)
    for k in range(n):
        if h[k] != 0.0:
            for i in range(n):
                out[i] += P[i, k] * h[k]
    return out


@kernel
def doubt_standstill(memory: Array) -> None:
    """Note that an epoch was refused: a vehicle held at rest may have left."""
    memory[QUIET] = -float(_DOUBT_CHUNKS)


@kernel
def _stands(nav: Array, memory: Array, constraints: Constraints, chunk: Array) -> bool:
    """Whether the vehicle stands after a chunk (6,) of mean rate and specific force; ``memory``
    is brought up to date."""
    turning, pushed = 0.0, 0.0
    for i in range(3):
        turning += (chunk[i] - nav[GYRO_BIAS + i]) ** 2
        pushed += (chunk[3 + i] - memory[REST_FORCE + i]) ** 2
    still = turning < constraints.still_rate_radps**2
    if memory[QUIET] > 0.0:
        still = still and pushed < constraints.still_force_mps2**2
    if not still and memory[QUIET] >= 0.0:
        memory[QUIET] = 0.0
    else:
        memory[QUIET] += 1.0
    weight = 1.0 / max(memory[QUIET], 1.0)
    for i in range(3):
        memory[REST_FORCE + i] += weight * (chunk[3 + i] - memory[REST_FORCE + i])
    speed = math.sqrt(nav[Nav.VX] ** 2 + nav[Nav.VY] ** 2 + nav[Nav.VZ] ** 2)
    quiet = memory[QUIET] >= _QUIET_CHUNKS and speed < _CREEP_MPS
    return bool(constraints.standstill_sd_mps > 0.0 and quiet)


@kernel
def apply_constraints(
    nav: Array, cov: Array, memory: Array, sensors: Sensors, chunk: Array
) -> None:
    """Apply the constraints after a ``chunk`` (7,), the mean of ``Chunk``, in place."""
    constraints = sensors.constraints
    standing = _stands(nav, memory, constraints, chunk)
    still_sd = constraints.standstill_sd_mps if standing else 0.0
    sds = (still_sd, constraints.sideways_sd_mps, constraints.upwards_sd_mps)
    rate_var = sensors.noise.gyro_density_radps_sqrthz**2 / chunk[6]
    rows = np.zeros((6, ROW_WIDTH))
    m = 0
    for i in range(6 if standing else 3):
        speed_sd = still_sd if standing else sds[i % 3]
        variance = speed_sd * speed_sd if i < 3 else rate_var
        if i < 3 and speed_sd == 0.0:
            continue
        row = rows[m]
        row[KIND], row[GROUP] = _BODY_VELOCITY if i < 3 else _BODY_RATE, m
        row[VALUE] = 0.0 if i < 3 else chunk[i - 3]
        row[VARIANCE] = row[GATE_VARIANCE] = variance
        row[ORIGIN + i % 3] = 1.0
        m += 1
    if m > 0:
        correct(nav, cov, rows[:m], _CONSTRAINT_GATE, np.empty(m))


@kernel
def _integrate(
    nav: Array,
    memory: Array,
    from_ns: int,
    to_ns: int,
    imu: Imu,
    earth: Earth,
    gained: Array,
    chunk: Array,
) -> tuple[int, float]:
    """Mechanise to the first sample ``CHUNK_S`` after ``from_ns``, or to ``to_ns``: where that is,
    and the time [s] without samples. gained (3,) and chunk (7,) begin with 0."""
    stamps_ns, rates = imu
    n, now, span, blind_s = stamps_ns.size, from_ns, 0.0, 0.0
    k = int(np.searchsorted(stamps_ns, from_ns, side="right"))
    increment, up = np.empty(6), np.empty((3, 3))
    rotation_of(nav[QUATERNION:ACCEL_BIAS], up)
    while now < to_ns and span < CHUNK_S - 1e-9:
        end = to_ns
        hole = n == 0 or k >= n or (k > 0 and (stamps_ns[k] - stamps_ns[k - 1]) * 1e-9 > HOLE_S)
        hole = hole or (k == 0 and (stamps_ns[0] - now) * 1e-9 > HOLE_S)
        if k < n:
            end = min(end, stamps_ns[k])
        if hole:
            end = min(end, now + _CHUNK_NS)
        dt = (end - now) * 1e-9
        if n == 0:
            increment[:3] = nav[GYRO_BIAS : GYRO_BIAS + 3] * dt
            for i in range(3):
                level = nav[ACCEL_BIAS + i] + up[2, i] * earth.gravity_mps2
                increment[3 + i] = level * dt
        else:
            increment[:] = rates[k if k < n else n - 1] * dt
        chunk[:6] += increment
        mechanise(nav, increment, dt, memory[:LAST], earth, gained)
        if hole:
            memory[:LAST] = 0.0
            blind_s += dt
        span += dt
        now = end
        if k < n and now >= stamps_ns[k]:
            k += 1
    chunk[:6] /= span
    chunk[6] = span
    return now, blind_s


@kernel
def _slow_transition(nav: Array, dt: float, slow: SlowErrors, Phi: Array) -> None:
    """Move the slow errors of ``nav`` over ``dt`` [s] and fill in their part of ``Phi``."""
    if nav.size <= NAV:
        return
    Phi[Err.CLOCK, Err.DRIFT] = dt
    nav[Nav.CLOCK] += dt * nav[Nav.DRIFT]
    for i in range(slow.biases.shape[1]):
        fade = math.exp(-dt / slow.biases[1, i])
        k = ERR_BIASES + i
        Phi[k, k] = fade
        nav[k + 1] *= fade


@kernel
def _add_slow_noise(cov: Array, dt: float, slow: SlowErrors) -> None:
    """Add the noise of the slow errors over ``dt`` [s] to ``cov`` (n, n), in place."""
    if cov.shape[0] <= ERR:
        return
    cov[Err.CLOCK, Err.CLOCK] += slow.clock_white**2 * dt
    add_walk(Err.CLOCK, Err.DRIFT, dt, slow.clock_walk**2, cov)
    for i in range(slow.biases.shape[1]):
        k = ERR_BIASES + i
        cov[k, k] += slow.biases[0, i] ** 2 * (1.0 - math.exp(-2.0 * dt / slow.biases[1, i]))


class Chunk(NamedTuple):
    """What happened in a chunk: mean (7,) rate and specific force as measured, and the length [s];
    transition (n, n) of the error state."""

    mean: Array
    transition: Array


@kernel
def predict_chunk(
    nav: Array,
    cov: Array,
    memory: Array,
    from_ns: int,
    to_ns: int,
    imu: Imu,
    sensors: Sensors,
    chunk: Chunk,
) -> tuple[int, float]:
    """Move ``nav``, ``cov`` and ``memory`` (MEMORY,) on by one chunk, at most to ``to_ns`` >
    ``from_ns``, in place, without constraints.

    chunk : filled
    Returns its end and the time [s] in it without samples, in which the last one is held and
    trusted as ``BLIND``.
    """
    noise, earth, Phi = sensors.noise, sensors.earth, chunk.transition
    before, after, gained = np.empty((3, 3)), np.empty((3, 3)), np.zeros(3)
    rotation_of(nav[QUATERNION:ACCEL_BIAS], before)
    chunk.mean[:] = 0.0
    now, blind_s = _integrate(nav, memory, from_ns, to_ns, imu, earth, gained, chunk.mean)
    rotation_of(nav[QUATERNION:ACCEL_BIAS], after)
    span, tau = chunk.mean[6], noise.bias_correlation_time_s
    Phi[:] = np.eye(cov.shape[0])
    Phi[:ERR, :ERR] = transition(gained, 0.5 * (before + after), span, tau, earth)
    _slow_transition(nav, span, sensors.slow, Phi)
    taken = noise
    if blind_s > 0.0:
        taken = InertialNoise(
            BLIND[0], BLIND[1], noise.accel_bias_sd_mps2, noise.gyro_bias_sd_radps, tau
        )
    propagate(cov, Phi, span, taken)
    _add_slow_noise(cov, span, sensors.slow)
    decay_biases(nav, span, tau)
    return now, blind_s


@kernel
def advance(
    nav: Array, cov: Array, memory: Array, from_ns: int, to_ns: int, imu: Imu, sensors: Sensors
) -> float:
    """Move ``nav``, ``cov`` and ``memory`` (MEMORY,) from ``from_ns`` to ``to_ns``, in place.

    Returns the time [s] without samples.
    """
    n, now, blind_s = cov.shape[0], from_ns, 0.0
    chunk = Chunk(np.empty(7), np.empty((n, n)))
    while now < to_ns:
        now, dark_s = predict_chunk(nav, cov, memory, now, to_ns, imu, sensors, chunk)
        blind_s += dark_s
        if dark_s == 0.0:
            apply_constraints(nav, cov, memory, sensors, chunk.mean)
    return blind_s
