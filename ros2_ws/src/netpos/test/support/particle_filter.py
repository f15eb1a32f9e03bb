"""A bootstrap particle filter of a device in the plane, with models of its own.

It shares no code with ``netpos.estimation``: it is the yardstick for them. A particle is
[x, y, vx, vy] in m and m/s. Velocities do a random walk (white acceleration); a velocity may turn
by 90 degrees to either side at random times. The clock offset [m] and drift [m/s] are linear and
Gaussian given the path of a particle: each particle has a mean of its own, all share one
covariance (Rao-Blackwellised: Doucet, de Freitas, Murphy and Russell 2000).

Noise that was not drawn yet is kept as a covariance until the next measurement. A ``guided``
update then draws positions where that measurement says and weighs them by that covariance: a
range of 0.2 m would leave hardly any of the particles spread over 50 m.

After a start or a silence, starts are moved: ``particle_moves``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from netpos.messages.values import Array
from particle_kernels import WIDTH, Kind, drift_all, place, scatter, systematic, weigh
from particle_moves import Starts

_FEW = 0.2  # share of the particles below which measurements count bit by bit


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


def _axis_noise(dt: float, density: float) -> Array:
    """Covariance of value and rate after ``dt`` of a rate doing a random walk."""
    q = density**2
    return q * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])


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
        self._starts: Starts | None = None
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
        drift_all(self._rng, self.state, dt, turns)
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
        gains = np.zeros(len(self.state))
        for k, row in enumerate(rows):
            self._take(row, None if k < placed else gains)
        if not (self._weights + gains).max() > -math.inf:
            raise ValueError("no particle explains the measurements; take more particles")
        self._weigh_in_parts(len(rows) - placed, gains)
        if self._starts is not None and self._starts.full:
            self._starts = None

    def _weigh_in_parts(self, count: int, gains: Array) -> None:
        """Add log likelihoods (N,) of the last ``count`` rows to the weights: at once, or while
        starts are moved, bit by bit, so that never more than half of the particles is lost
        (tempering: Neal 2001)."""
        done = 0.0
        while done < 1.0:
            part = 1.0 - done
            if self._starts is not None and self._effective(part, gains) < _FEW:
                if self._effective(0.0, gains) < 0.5:
                    gains = self._renew(count, done, gains)
                part = self._part(part, gains)
            self._weights += part * gains if part < 1.0 else gains
            done = min(done + part, 1.0) if part < 1.0 - done else 1.0
            share = self._effective(0.0, gains)
            self.least_effective = min(self.least_effective, share * len(gains))
            if share < 0.5:
                gains = self._renew(count, done, gains)

    def _part(self, most: float, gains: Array) -> float:
        """Largest share up to ``most`` by which gains may count and leave half the particles."""
        low, high = 0.0, most
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._effective(middle, gains) > 0.49 else (low, middle)
        return max(low, 1e-6)

    def _effective(self, part: float, gains: Array) -> float:
        """Effective share of the particles were ``part`` of the gains added."""
        total = self._weights + (part * gains if part > 0.0 else 0.0)
        p = np.exp(total - total.max())
        return float(p.sum() ** 2 / (p**2).sum() / len(p))

    def _renew(self, count: int, done: float, gains: Array) -> Array:
        """Resample and move; the gains of the particles there are then."""
        gains = gains[self._resample()]
        if self._starts is None:
            return gains
        part = (count if done < 1.0 else 0), done
        return self._starts.move(self._rng, part, self.state, self.clock)

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
            place(self._rng, self.state, self._weights, rows[0], phase, pp, pv, vv)
        else:
            scatter(self._rng, self.state, pp, pv, vv)
        if (guided or not self._started) and self._motion.turns_hz == 0.0:
            self._starts = Starts(means, noise, self.state, self.clock)
        self._started = True
        self._pending = np.zeros((2, 2))
        return placed

    def _take(self, row: Array, gains: Array | None) -> None:
        """Add the log likelihood of a row to ``gains`` unless it has been taken account of; times
        update the clocks."""
        variance, gain = row[2] ** 2, np.zeros(2)
        if int(row[0]) == Kind.TOA:
            P = self.clock_cov
            variance = P[0, 0] + row[2] ** 2
            gain = P[:, 0] / variance
            A = np.eye(2) - np.outer(gain, [1.0, 0.0])
            self.clock_cov = A @ P @ A.T + np.outer(gain, gain) * row[2] ** 2
        if self._starts is not None:
            self._starts.take(row, variance, gain)
        if gains is not None:
            weigh(row, self.state, self.clock, gains, variance, gain[0], gain[1])

    def _resample(self) -> npt.NDArray[np.int64]:
        """Draw particles of equal weight; the index of each among the old ones."""
        index = systematic(self._rng.random(), self.probability)
        self.state, self.clock = self.state[index], self.clock[index]
        if self._starts is not None:
            self._starts.choose(index)
        self._weights[:] = 0.0
        return index
