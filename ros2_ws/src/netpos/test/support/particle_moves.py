"""Moves of the start of every particle, which leave the posterior as it is.

The first measurements after a start, or after a silence, say far more than was known, and what
process noise adds takes seconds to replace the particles they leave. So after each resampling the
start of every particle is moved by Metropolis-Hastings steps that leave the posterior as it is
(resample-move: Gilks and Berzuini 2001; steps by differences of particles: ter Braak 2006).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from netpos.messages.values import Array
from particle_kernels import move_starts

EPOCHS, ROWS = 72, 144  # starts are moved for so many epochs, and rows


class Starts:
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
        """Whether starts are moved no longer."""
        return len(self._times) == EPOCHS or len(self._rows) >= ROWS

    def wait(self, dt: float) -> None:
        """Time goes on by ``dt`` seconds."""
        self._now += dt

    def begin_epoch(self, state: Array) -> None:
        """Keep the particles (N, 4) as an epoch finds them."""
        self._ways[:, len(self._times)] = state
        self._times.append(self._now)

    def take(self, row: Array, variance: float, gain: Array) -> None:
        """Keep a row, its innovation variance and clock gains (2,)."""
        self._rows.append(row)
        self._told.append([len(self._times) - 1.0, variance, *gain, 1.0])

    def choose(self, index: npt.NDArray[np.int64]) -> None:
        """Particles were resampled."""
        self._off, self._clock = self._off[index], self._clock[index]
        self._ways = self._ways[index]

    def move(
        self, rng: np.random.Generator, part: tuple[int, float], state: Array, clock: Array
    ) -> Array:
        """Move the starts. ``part``: how many of the last rows count by which share; returns their
        log likelihood (N,), of no meaning once they count in full."""
        told, gains = np.array(self._told), np.zeros(len(state))
        if part[0] > 0:
            told[-part[0] :, 4] = part[1]
        epochs = np.array(self._rows), told, np.array(self._times)
        ways = self._off, self._ways, self._clock
        move_starts(rng, *ways, *epochs, self._precision, state, clock, gains)
        return gains
