"""Closed-loop error-state filter of a strapdown system, 15 states (deng2022:eq.7, 8).

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

from netpos.filters.compile import kernel
from netpos.filters.gate import gate_groups, select_rows
from netpos.filters.measurement import (
    GATE_VARIANCE,
    GROUP,
    KIND,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
)
from netpos.filters.space import SpaceKind, bend_variance, innovation_at
from netpos.inertial.strapdown import (
    ACCEL_BIAS,
    ERR,
    GYRO_BIAS,
    QUATERNION,
    VELOCITY,
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
_BODY_VELOCITY, _BODY_RATE = int(SpaceKind.BODY_VELOCITY), int(SpaceKind.BODY_RATE)


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


@kernel
def correct(
    nav: Array, cov: Array, rows: Array, gate_nis: Array, accepted: Array
) -> tuple[float, int]:
    """Fuse ``rows`` (m, ROW_WIDTH) into ``nav`` (NAV,) and ``cov`` (ERR, ERR), in place.

    gate_nis : as of ``gate.gate_groups``; accepted : (groups,) filled with 1 or 0
    Returns the NIS of the accepted rows together and their number.
    """
    m = rows.shape[0]
    C, H, innovation, variance = np.empty((3, 3)), np.empty((m, ERR)), np.empty(m), np.empty(m)
    S = np.empty((m, m))
    rotation_of(nav[QUATERNION:ACCEL_BIAS], C)
    for i in range(m):
        innovation[i] = innovation_at(rows[i], nav, C, H[i])
    for i in range(m):
        bend = bend_variance(rows[i], nav, cov)
        variance[i] = rows[i, VARIANCE] + bend
        projected = _times(cov, H[i])
        for j in range(m):
            S[i, j] = _dot(H[j], projected)
        S[i, i] += rows[i, GATE_VARIANCE] + bend
    gate_groups(rows, innovation, S, gate_nis, accepted)
    index, nis = select_rows(rows, innovation, S, gate_nis, accepted)
    if index.size == 0:
        return 0.0, 0
    prior, error = nav.copy(), np.zeros(ERR)
    posterior = cov
    for _ in range(ITERATIONS):
        step, posterior = _sequential(cov, rows, index, variance, H, innovation, error)
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
            innovation[i] = innovation_at(rows[i], nav, C, H[i])
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
    out = np.zeros(ERR)
    for k in range(ERR):
        if h[k] != 0.0:
            for i in range(ERR):
                out[i] += P[i, k] * h[k]
    return out


@kernel
def _sequential(
    cov: Array,
    rows: Array,
    index: Stamps,
    variance: Array,
    H: Array,
    innovation: Array,
    error: Array,
) -> tuple[Array, Array]:
    """Error and covariance after the rows ``index`` one by one, linearised about ``error``."""
    P, step = cov.copy(), np.zeros(ERR)
    for i in index:
        h = H[i]
        gain = _times(P, h)
        s = _dot(h, gain) + variance[i]
        residual = innovation[i] + _dot(h, error) - _dot(h, step)
        for a in range(ERR):
            step[a] += gain[a] / s * residual
            for b in range(ERR):
                P[a, b] -= gain[a] * gain[b] / s
    return step, P


@kernel
def doubt_standstill(memory: Array) -> None:
    """Note that an epoch was refused: a vehicle held at rest may have left."""
    memory[QUIET] = -float(_DOUBT_CHUNKS)


@kernel
def _hold(
    nav: Array,
    cov: Array,
    memory: Array,
    constraints: Constraints,
    noise: InertialNoise,
    chunk: Array,
    dt: float,
) -> None:
    """Apply the constraints after a chunk of length ``dt``; chunk (6,): its mean rate and specific
    force as measured."""
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
    speed = math.sqrt(nav[VELOCITY] ** 2 + nav[VELOCITY + 1] ** 2 + nav[VELOCITY + 2] ** 2)
    standing = (
        constraints.standstill_sd_mps > 0.0
        and memory[QUIET] >= _QUIET_CHUNKS
        and speed < _CREEP_MPS
    )
    still_sd = constraints.standstill_sd_mps if standing else 0.0
    sds = (still_sd, constraints.sideways_sd_mps, constraints.upwards_sd_mps)
    rows = np.zeros((6, ROW_WIDTH))
    m = 0
    for i in range(3):
        sd = still_sd if standing else sds[i]
        if sd > 0.0:
            row = rows[m]
            row[KIND], row[GROUP] = _BODY_VELOCITY, m
            row[VARIANCE] = row[GATE_VARIANCE] = sd * sd
            row[ORIGIN + i] = 1.0
            m += 1
    if standing:
        for i in range(3):
            row = rows[m]
            row[KIND], row[GROUP] = _BODY_RATE, m
            row[VALUE] = chunk[i]
            row[VARIANCE] = row[GATE_VARIANCE] = noise.gyro_density_radps_sqrthz**2 / dt
            row[ORIGIN + i] = 1.0
            m += 1
    if m > 0:
        correct(nav, cov, rows[:m], _CONSTRAINT_GATE, np.empty(m))


@kernel
def advance(
    nav: Array,
    cov: Array,
    memory: Array,
    from_ns: int,
    to_ns: int,
    stamps_ns: Stamps,
    rates: Array,
    noise: InertialNoise,
    earth: Earth,
    constraints: Constraints,
) -> float:
    """Move ``nav``, ``cov`` and ``memory`` (MEMORY,) from ``from_ns`` to ``to_ns``, in place.

    stamps_ns : (n,) increasing, rates : (n, 6) angular velocity and specific force; a sample holds
        from the stamp before it to its own
    Returns the time [s] without samples, in which the last one is held and trusted as ``BLIND``.
    """
    dark = InertialNoise(
        BLIND[0],
        BLIND[1],
        noise.accel_bias_sd_mps2,
        noise.gyro_bias_sd_radps,
        noise.bias_correlation_time_s,
    )
    n, now, blind_s = stamps_ns.size, from_ns, 0.0
    k = int(np.searchsorted(stamps_ns, from_ns, side="right"))
    before, after = np.empty((3, 3)), np.empty((3, 3))
    increment, gained, chunk = np.empty(6), np.zeros(3), np.zeros(6)
    span, blind = 0.0, False
    rotation_of(nav[QUATERNION:ACCEL_BIAS], before)
    while now < to_ns:
        end = to_ns
        hole = n == 0 or k >= n or (k > 0 and (stamps_ns[k] - stamps_ns[k - 1]) * 1e-9 > HOLE_S)
        hole = hole or (k == 0 and (stamps_ns[0] - now) * 1e-9 > HOLE_S)
        if k < n:
            end = min(end, stamps_ns[k])
        if hole:
            end = min(end, now + _CHUNK_NS)
        dt = (end - now) * 1e-9
        if n == 0:
            increment[:3] = nav[GYRO_BIAS:] * dt
            for i in range(3):
                level = nav[ACCEL_BIAS + i] + before[2, i] * earth.gravity_mps2
                increment[3 + i] = level * dt
        else:
            increment[:] = rates[k if k < n else n - 1] * dt
        chunk += increment
        mechanise(nav, increment, dt, memory[:LAST], earth, gained)
        if hole:
            memory[:LAST] = 0.0
            blind_s += dt
            blind = True
        span += dt
        now = end
        if k < n and now >= stamps_ns[k]:
            k += 1
        if span >= CHUNK_S - 1e-9 or now >= to_ns:
            rotation_of(nav[QUATERNION:ACCEL_BIAS], after)
            mean = 0.5 * (before + after)
            Phi = transition(gained, mean, span, noise.bias_correlation_time_s, earth)
            propagate(cov, Phi, span, dark if blind else noise)
            decay_biases(nav, span, noise.bias_correlation_time_s)
            if not blind:
                _hold(nav, cov, memory, constraints, noise, chunk / span, span)
            rotation_of(nav[QUATERNION:ACCEL_BIAS], before)
            gained[:] = 0.0
            chunk[:] = 0.0
            span, blind = 0.0, False
    return blind_s
