"""Compiled parts of the particle filter, all in one file: Numba compiles anew what changed in the
file of a kernel, not what changed in those it calls."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numba import njit

TRIES = 16  # candidates of a guided particle
SWEEPS = 4
_LEAST_STEP = 3.0  # a step is e^-u of a difference of two particles, u uniform up to this


class Kind(IntEnum):
    """What a row measures; ``a`` and ``b`` are its last two entries."""

    STATE = 0  # entry a of the state
    RANGE = 1  # distance from the origin
    LATE_RANGE = 2  # distance, with probability a plus an exponential excess of mean b
    BEARING = 3  # direction from the origin
    TOA = 4  # distance from the origin plus clock offset [m]
    PHASE = 5  # a times the cosine of the bearing against the direction b, modulo one turn
    FRONT = 6  # heard, which needs a place in front (direction a) of the origin


WIDTH = 7  # kind, value, sd, origin x, origin y, a, b


@njit(cache=True)
def _late_log_density(e, sd, share, excess):  # type: ignore[no-untyped-def]
    """Log density of noise of ``sd`` plus, with probability ``share``, an exponential excess,
    over what it never exceeds."""
    clear = math.exp(-0.5 * (e / sd) ** 2) / (sd * math.sqrt(2.0 * math.pi))
    u = (e / sd - sd / excess) / math.sqrt(2.0)
    exponent = 0.5 * (sd / excess) ** 2 - e / excess
    late = math.exp(exponent) * 0.5 * math.erfc(-u) / excess if u > -25.0 else 0.0
    total = (1.0 - share) * clear + share * late
    most = (1.0 - share) / (sd * math.sqrt(2.0 * math.pi)) + share / excess
    return math.log(total / most) if total > 0.0 else -math.inf


@njit(cache=True)
def _wrapped(angle):  # type: ignore[no-untyped-def]
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@njit(cache=True)
def _log_likelihood(row, x, y, vx, vy, offset, variance):  # type: ignore[no-untyped-def]
    """Log likelihood of a row, less a constant that leaves it at most 0, and its innovation."""
    kind, dx, dy = int(row[0]), x - row[3], y - row[4]
    if kind == 0:
        e = row[1] - (x, y, vx, vy)[int(row[5])]
    elif kind == 3:
        e = _wrapped(row[1] - math.atan2(dy, dx))
    elif kind == 5:
        r = max(math.sqrt(dx * dx + dy * dy), 1e-9)
        value = row[5] * (dx * math.cos(row[6]) + dy * math.sin(row[6])) / r
        e = _wrapped(row[1] - value)
    elif kind == 6:
        ahead = dx * math.cos(row[5]) + dy * math.sin(row[5])
        return (0.0 if ahead > 0.0 else -math.inf), 0.0
    else:
        e = row[1] - math.sqrt(dx * dx + dy * dy)
        if kind == 2:
            return _late_log_density(e, row[2], row[5], row[6]), e
        if kind == 4:
            e -= offset
    return -0.5 * e * e / variance, e


@njit(cache=True)
def drift_all(rng, state, dt, turn_probability):  # type: ignore[no-untyped-def]
    for i in range(state.shape[0]):
        if turn_probability > 0.0 and rng.random() < turn_probability:
            side = 1.0 if rng.random() < 0.5 else -1.0
            state[i, 2], state[i, 3] = -side * state[i, 3], side * state[i, 2]
        state[i, 0] += dt * state[i, 2]
        state[i, 1] += dt * state[i, 3]


@njit(cache=True)
def scatter(rng, state, pp, pv, vv):  # type: ignore[no-untyped-def]
    """Add noise with the covariance [[pp, pv], [pv, vv]] of position and velocity per axis."""
    p = math.sqrt(pp)
    g = pv / p if p > 0.0 else 0.0
    v = math.sqrt(max(vv - g * g, 0.0))
    for i in range(state.shape[0]):
        for axis in range(2):
            n = rng.standard_normal()
            state[i, axis] += p * n
            state[i, 2 + axis] += g * n + v * rng.standard_normal()


@njit(cache=True)
def weigh(row, state, clock, weights, variance, gain_offset, gain_drift):  # type: ignore[no-untyped-def]
    """Add the log likelihood of a row to the log weights; a time moves the clocks, too."""
    for i in range(state.shape[0]):
        x, y, vx, vy = state[i, 0], state[i, 1], state[i, 2], state[i, 3]
        gain, e = _log_likelihood(row, x, y, vx, vy, clock[i, 0], variance)
        weights[i] += gain
        if int(row[0]) == 4:
            clock[i, 0] += gain_offset * e
            clock[i, 1] += gain_drift * e


@njit(cache=True)
def _candidate(rng, row, phase):  # type: ignore[no-untyped-def]
    """A position as a range, and a phase where its kind is not negative, would have it: x, y and
    the log of its area over the probability of the draw."""
    r = row[1] + row[2] * rng.standard_normal()
    if int(row[0]) == 2 and rng.random() < row[5]:
        r -= row[6] * rng.standard_exponential()
    if r <= 0.0:
        return 0.0, 0.0, -math.inf
    if phase[0] < 0.0:
        angle = 2.0 * math.pi * rng.random()
        return row[3] + r * math.cos(angle), row[4] + r * math.sin(angle), math.log(r)
    scale, along = phase[5], phase[6]
    noisy = phase[1] + phase[2] * rng.standard_normal()
    reach = math.ceil((scale + 2.0 * math.pi) / (2.0 * math.pi))
    s = (noisy + 2.0 * math.pi * rng.integers(-reach, reach + 1)) / scale
    half = math.sqrt((row[3] - phase[3]) ** 2 + (row[4] - phase[4]) ** 2)
    square = r * r - half * half * (1.0 - s * s)
    if abs(s) >= 1.0 or square <= 0.0:
        return 0.0, 0.0, -math.inf
    across = math.sqrt(1.0 - s * s)
    d = s * half + math.sqrt(square)
    if d <= 0.0:
        return 0.0, 0.0, -math.inf
    c, t = math.cos(along), math.sin(along)
    x, y = d * (s * c - across * t), d * (s * t + across * c)  # in front: left of ``along``
    return phase[3] + x, phase[4] + y, math.log(d * r / (math.sqrt(square) * across))


@njit(cache=True)
def place(rng, state, weights, row, phase, pp, pv, vv):  # type: ignore[no-untyped-def]
    """Draw every particle from its pending noise and a range in one: one of TRIES candidates."""
    g, v = pv / pp, math.sqrt(max(vv - pv * pv / pp, 0.0))
    found, gains = np.empty((TRIES, 2)), np.empty(TRIES)
    for i in range(state.shape[0]):
        top = -math.inf
        for k in range(TRIES):
            x, y, gain = _candidate(rng, row, phase)
            dx, dy = x - state[i, 0], y - state[i, 1]
            found[k, 0], found[k, 1] = dx, dy
            gains[k] = gain - 0.5 * (dx * dx + dy * dy) / pp
            top = max(top, gains[k])
        if top == -math.inf:
            weights[i] = -math.inf
            continue
        total = 0.0
        for k in range(TRIES):
            gains[k] = math.exp(gains[k] - top)
            total += gains[k]
        left, chosen = total * rng.random(), 0
        while chosen < TRIES - 1 and left > gains[chosen]:
            left -= gains[chosen]
            chosen += 1
        for axis in range(2):
            state[i, axis] += found[chosen, axis]
            state[i, 2 + axis] += g * found[chosen, axis] + v * rng.standard_normal()
        weights[i] += top + math.log(total)


@njit(cache=True)
def systematic(shift, probability):  # type: ignore[no-untyped-def]
    """Index of the particle that each of equally many draws takes (systematic resampling)."""
    n = probability.size
    index = np.empty(n, dtype=np.int64)
    total, j = probability[0], 0
    for i in range(n):
        while total < (i + shift) / n and j < n - 1:
            j += 1
            total += probability[j]
        index[i] = j
    return index


@njit(cache=True)
def _of_way(way, rows, told, times, clock, step, least):  # type: ignore[no-untyped-def]
    """Log likelihood of all rows along a way (EPOCHS, 4) whose start is moved by ``step`` (4,);
    ``clock`` (2,) is carried along in place. -inf as soon as it is below ``least``. Beside it, the
    whole log likelihood of the rows that count in part."""
    total, fresh, now = 0.0, 0.0, 0.0
    for j in range(rows.shape[0]):
        k = int(told[j, 0])
        time = times[k]
        clock[0] += (time - now) * clock[1]
        now = time
        x = way[k, 0] + step[0] + time * step[2]
        y = way[k, 1] + step[1] + time * step[3]
        vx, vy = way[k, 2] + step[2], way[k, 3] + step[3]
        gain, e = _log_likelihood(rows[j], x, y, vx, vy, clock[0], told[j, 1])
        if told[j, 4] > 0.0:
            total += told[j, 4] * gain
        if told[j, 4] < 1.0:
            fresh += gain
        if not total >= least:
            return -math.inf, 0.0
        if int(rows[j, 0]) == 4:
            clock[0] += told[j, 2] * e
            clock[1] += told[j, 3] * e
    return total, fresh


@njit(cache=True)
def _log_prior(step, off, precision):  # type: ignore[no-untyped-def]
    """Log density of a start ``off`` + ``step`` (4,) away from its mean."""
    total = 0.0
    for axis in range(2):
        p, v = off[axis] + step[axis], off[2 + axis] + step[2 + axis]
        total += precision[0, 0] * p * p + 2.0 * precision[0, 1] * p * v + precision[1, 1] * v * v
    return -0.5 * total


@njit(cache=True)
def _shift(state, step, time):  # type: ignore[no-untyped-def]
    for axis in range(2):
        state[axis] += step[axis] + time * step[2 + axis]
        state[2 + axis] += step[2 + axis]


@njit(cache=True)
def move_starts(rng, off, ways, first_clock, rows, told, times, precision, state, clock, gains):  # type: ignore[no-untyped-def]
    """SWEEPS Metropolis-Hastings steps of the start of every particle, and what follows of it.

    off (N, 4): start minus its prior mean; ways (N, EPOCHS, 4): states since; rows (m, WIDTH) and
    told (m, 5): epoch, innovation variance, clock gains and share of each that counts; times (k,):
    of the epochs, 0 at the start; state (N, 4), clock (N, 2): at the last of them; gains (N,):
    log likelihood of the rows that count in part. A step moves position, velocity
    or both by a share of the difference of two starts drawn before the sweeps.
    """
    n, others = off.shape[0], ways[:, 0, :].copy()
    step, still, moved = np.zeros(4), np.zeros(4), np.empty(2)
    for i in range(n):
        moved[:] = first_clock[i]
        current, gains[i] = _of_way(ways[i], rows, told, times, moved, still, -math.inf)
        current += _log_prior(still, off[i], precision)
        for _ in range(SWEEPS):
            a, b, part = rng.integers(0, n), rng.integers(0, n), rng.integers(0, 3)
            size = math.exp(-_LEAST_STEP * rng.random())
            for c in range(4):
                used = part == 2 or c // 2 == part
                step[c] = size * (others[a, c] - others[b, c]) if used else 0.0
            moved[:] = first_clock[i]
            there = _log_prior(step, off[i], precision)
            least = current + math.log(1.0 - rng.random())
            rest, fresh = _of_way(ways[i], rows, told, times, moved, step, least - there)
            there += rest
            if there > least:
                current, gains[i] = there, fresh
                for k in range(times.size):
                    _shift(ways[i, k], step, times[k])
                _shift(off[i], step, 0.0)
                _shift(state[i], step, times[-1])
                clock[i] = moved
