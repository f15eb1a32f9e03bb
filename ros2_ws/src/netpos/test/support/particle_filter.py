"""A bootstrap particle filter of a device in the plane, with models of its own.

It shares no code with ``netpos.filters``: it is the yardstick for them. A particle is
[x, y, vx, vy] in m and m/s. Velocities do a random walk (white acceleration); a velocity may turn
by 90 degrees to either side at random times. The clock offset [m] and drift [m/s] are linear and
Gaussian given the path of a particle: each particle has a mean of its own, all share one
covariance (Rao-Blackwellised: Doucet, de Freitas, Murphy and Russell 2000).

Noise that was not drawn yet is kept as a covariance until the next measurement. A ``guided``
update then draws positions where that measurement says and weighs them by that covariance: a
range of 0.2 m would leave hardly any of the particles spread over 50 m.

The first measurements after a start, or after a silence, say far more than was known, and what
process noise adds takes seconds to replace the particles they leave. So after each resampling the
start of every particle is moved by Metropolis-Hastings steps that leave the posterior as it is
(resample-move: Gilks and Berzuini 2001; steps by differences of particles: ter Braak 2006).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from netpos.messages.values import Array
from numba import njit
from particle_rows import WIDTH, Kind, log_likelihood

TRIES = 16  # candidates of a guided particle
EPOCHS, ROWS = 64, 96  # starts are moved for so many epochs, and rows
SWEEPS = 4
_LEAST_STEP = 3.0  # a step is e^-u of a difference of two particles, u uniform up to this


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """accel: density of the white acceleration [m/s^2/sqrt(Hz)]; turns_hz: rate of 90 degree
    turns; clock: densities of the offset [m/sqrt(s)] and of the drift [m/s/sqrt(s)]."""

    accel: float
    turns_hz: float = 0.0
    clock: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Gaussian prior: mean (4,), sd of position and velocity per axis, clock mean (2,) and sd
    (2,) in m and m/s."""

    mean: Array
    position_sd: float
    velocity_sd: float
    clock_mean: tuple[float, float] = (0.0, 0.0)
    clock_sd: tuple[float, float] = (0.0, 0.0)


@njit(cache=True)
def _drift(rng, state, dt, turn_probability):  # type: ignore[no-untyped-def]
    for i in range(state.shape[0]):
        if turn_probability > 0.0 and rng.random() < turn_probability:
            side = 1.0 if rng.random() < 0.5 else -1.0
            state[i, 2], state[i, 3] = -side * state[i, 3], side * state[i, 2]
        state[i, 0] += dt * state[i, 2]
        state[i, 1] += dt * state[i, 3]


@njit(cache=True)
def _scatter(rng, state, pp, pv, vv):  # type: ignore[no-untyped-def]
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
def _weigh(row, state, clock, weights, variance, gain_offset, gain_drift):  # type: ignore[no-untyped-def]
    """Add the log likelihood of a row to the log weights; a time moves the clocks, too."""
    for i in range(state.shape[0]):
        x, y, vx, vy = state[i, 0], state[i, 1], state[i, 2], state[i, 3]
        gain, e = log_likelihood(row, x, y, vx, vy, clock[i, 0], variance)
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
def _place(rng, state, weights, row, phase, pp, pv, vv):  # type: ignore[no-untyped-def]
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
def _systematic(shift, probability):  # type: ignore[no-untyped-def]
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
    ``clock`` (2,) is carried along in place. -inf as soon as it is below ``least``."""
    total, now = 0.0, 0.0
    for j in range(rows.shape[0]):
        k = int(told[j, 0])
        time = times[k]
        clock[0] += (time - now) * clock[1]
        now = time
        x = way[k, 0] + step[0] + time * step[2]
        y = way[k, 1] + step[1] + time * step[3]
        vx, vy = way[k, 2] + step[2], way[k, 3] + step[3]
        gain, e = log_likelihood(rows[j], x, y, vx, vy, clock[0], told[j, 1])
        total += gain
        if total < least:
            return -math.inf
        if int(rows[j, 0]) == 4:
            clock[0] += told[j, 2] * e
            clock[1] += told[j, 3] * e
    return total


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
def _move_starts(rng, off, ways, first_clock, rows, told, times, precision, state, clock):  # type: ignore[no-untyped-def]
    """SWEEPS Metropolis-Hastings steps of the start of every particle, and what follows of it.

    off (N, 4): start minus its prior mean; ways (N, EPOCHS, 4): states since; rows (m, WIDTH) and
    told (m, 4): epoch, innovation variance and clock gains of each; times (k,): of the epochs, 0
    at the start; state (N, 4), clock (N, 2): at the last of them. A step moves position, velocity
    or both by a share of the difference of two starts drawn before the sweeps.
    """
    n, others = off.shape[0], ways[:, 0, :].copy()
    step, still, moved = np.zeros(4), np.zeros(4), np.empty(2)
    for i in range(n):
        moved[:] = first_clock[i]
        current = _of_way(ways[i], rows, told, times, moved, still, -math.inf)
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
            there += _of_way(ways[i], rows, told, times, moved, step, least - there)
            if there > least:
                current = there
                for k in range(times.size):
                    _shift(ways[i, k], step, times[k])
                _shift(off[i], step, 0.0)
                _shift(state[i], step, times[-1])
                clock[i] = moved


def _axis_noise(dt: float, density: float) -> Array:
    """Covariance of value and rate after ``dt`` of a rate doing a random walk."""
    q = density**2
    return q * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])


class _Starts:
    """Where the particles started, by which ways they came, and all they were told since."""

    def __init__(self, means: Array, cov: Array, state: Array, clock: Array) -> None:
        self._off, self._clock = state - means, clock.copy()
        self._ways = np.zeros((len(state), EPOCHS, 4), dtype=np.float32)
        self._precision, self._now = np.linalg.inv(cov), 0.0
        self._rows: list[Array] = []
        self._told: list[list[float]] = []
        self._times: list[float] = []

    @property
    def full(self) -> bool:
        return len(self._times) == EPOCHS or len(self._rows) >= ROWS

    def wait(self, dt: float) -> None:
        self._now += dt

    def begin_epoch(self, state: Array) -> None:
        self._ways[:, len(self._times)] = state
        self._times.append(self._now)

    def take(self, row: Array, variance: float, gain: Array) -> None:
        self._rows.append(row)
        self._told.append([len(self._times) - 1.0, variance, *gain])

    def choose(self, index: npt.NDArray[np.int64]) -> None:
        self._off, self._clock = self._off[index], self._clock[index]
        self._ways = self._ways[index]

    def move(self, rng: np.random.Generator, state: Array, clock: Array) -> None:
        told = np.array(self._rows), np.array(self._told), np.array(self._times)
        ways = self._off, self._ways, self._clock
        _move_starts(rng, *ways, *told, self._precision, state, clock)


class ParticleFilter:
    """Posterior of one device; ``predict`` and ``update`` in turn."""

    def __init__(self, start: Start, motion: Motion, particles: int, seed: int) -> None:
        self._motion = motion
        self._rng = np.random.default_rng([seed, 0x0FAC])
        self.state = np.tile(np.asarray(start.mean, dtype=float), (particles, 1))
        self._weights = np.zeros(particles)
        self._pending = np.diag([start.position_sd**2, start.velocity_sd**2])
        self.clock = np.tile(np.array(start.clock_mean), (particles, 1))
        self.clock_cov = np.diag(np.square(start.clock_sd))
        self.least_effective = float(particles)
        """Smallest effective number of particles after any update."""
        self._starts: _Starts | None = None
        self._started = False

    @property
    def probability(self) -> Array:
        """Weight of each particle (N,); they sum to one."""
        p: Array = np.exp(self._weights - self._weights.max())
        return p / p.sum()

    def predict(self, dt: float) -> None:
        """Move by ``dt`` seconds; the noise is drawn by the next update."""
        if dt <= 0.0:
            return
        turns = -math.expm1(-self._motion.turns_hz * dt)
        _drift(self._rng, self.state, dt, turns)
        if self._starts is not None:
            self._starts.wait(dt)
        F = np.array([[1.0, dt], [0.0, 1.0]])
        self._pending = F @ self._pending @ F.T + _axis_noise(dt, self._motion.accel)
        self.clock[:, 0] += dt * self.clock[:, 1]
        offset, drift = self._motion.clock
        walk = _axis_noise(dt, drift) + np.diag([offset**2 * dt, 0.0])
        self.clock_cov = F @ self.clock_cov @ F.T + walk

    def update(self, rows: Array, *, guided: bool = False) -> None:
        """Weigh the particles by rows (m, WIDTH). ``guided``: place them by the range in the
        first row, and the phase of the same array in the second if there is one.

        Raises ``ValueError`` where no particle explains the rows.
        """
        placed = self._draw(rows, guided)
        if self._starts is not None:
            self._starts.begin_epoch(self.state)
        for k, row in enumerate(rows):
            self._take(row, already=k < placed)
        if not self._weights.max() > -math.inf:
            raise ValueError("no particle explains the measurements; take more particles")
        effective = 1.0 / float((self.probability**2).sum())
        self.least_effective = min(self.least_effective, effective)
        if effective < 0.5 * len(self.state):
            self._resample()
            if self._starts is not None:
                self._starts.move(self._rng, self.state, self.clock)
        if self._starts is not None and self._starts.full:
            self._starts = None

    def _draw(self, rows: Array, guided: bool) -> int:
        """Draw the pending noise; how many of the rows that has taken account of."""
        if guided:
            self._resample()
        placed, noise, means = 0, self._pending, self.state.copy()
        pp, pv, vv = noise[0, 0], noise[0, 1], noise[1, 1]
        if guided:
            phase, placed = np.full(WIDTH, -1.0), 1
            if len(rows) > 1 and int(rows[1, 0]) == Kind.PHASE:
                phase, placed = rows[1], 2
            _place(self._rng, self.state, self._weights, rows[0], phase, pp, pv, vv)
        else:
            _scatter(self._rng, self.state, pp, pv, vv)
        if (guided or not self._started) and self._motion.turns_hz == 0.0:
            self._starts = _Starts(means, noise, self.state, self.clock)
        self._started = True
        self._pending = np.zeros((2, 2))
        return placed

    def _take(self, row: Array, *, already: bool) -> None:
        """Weigh by a row, unless ``already`` done; times update the clocks."""
        variance, gain = row[2] ** 2, np.zeros(2)
        if int(row[0]) == Kind.TOA:
            P = self.clock_cov
            variance = P[0, 0] + row[2] ** 2
            gain = P[:, 0] / variance
            A = np.eye(2) - np.outer(gain, [1.0, 0.0])
            self.clock_cov = A @ P @ A.T + np.outer(gain, gain) * row[2] ** 2
        if self._starts is not None:
            self._starts.take(row, variance, gain)
        if not already:
            _weigh(row, self.state, self.clock, self._weights, variance, gain[0], gain[1])

    def _resample(self) -> None:
        """Draw particles of equal weight."""
        if np.ptp(self._weights) > 0.0:
            index = _systematic(self._rng.random(), self.probability)
            self.state, self.clock = self.state[index], self.clock[index]
            if self._starts is not None:
                self._starts.choose(index)
        self._weights[:] = 0.0
