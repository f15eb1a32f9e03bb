"""Troubles on the rectangle beyond the paper's noise: reflections, people in the way, an
anchor heard too seldom to follow the phase, poor headings, a tracker that believes the wrong
sector."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.estimation.measurement import VALUE, VARIANCE
from netpos.messages.values import Array
from netpos.reproduction.petukhov.steps import StepErrors

Bools = npt.NDArray[np.bool_]

_EXCESS_M, _NOISIER = 0.3, 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Trouble:
    """Nothing by default; the tracker knows only the sd of the heading.

    phase_outliers : share of epochs whose phase is any, each as probable (multipath)
    blocked_s : (from, to) a second person is in the line of sight: the range is longer by
        0.3 m in the mean (exponential), the phase five times as noisy
    heard_every : the anchor is heard in one of so many epochs
    heading_sd_rad : of a step
    wrong_s : when the tracker is put into the next sector, sure of it
    """

    phase_outliers: float = 0.0
    blocked_s: tuple[float, float] | None = None
    heard_every: int = 1
    heading_sd_rad: float = StepErrors().heading_sd_rad
    wrong_s: float | None = None

    @property
    def errors(self) -> StepErrors:
        """Errors of the steps."""
        return StepErrors(heading_sd_rad=self.heading_sd_rad)

    def spoil(self, times_s: Array, radio: Array, rng: np.random.Generator) -> None:
        """Spoil range and phase rows (n, 2, ROW_WIDTH) in place."""
        n = len(times_s)
        if self.phase_outliers > 0.0:
            spoilt = rng.random(n) < self.phase_outliers
            radio[spoilt, 1, VALUE] = rng.uniform(-math.pi, math.pi, int(spoilt.sum()))
        if self.blocked_s is not None:
            blocked = within(times_s, self.blocked_s)
            count = int(blocked.sum())
            radio[blocked, 0, VALUE] += rng.exponential(_EXCESS_M, count)
            noise = math.sqrt(_NOISIER**2 - 1.0) * rng.standard_normal(count)
            phase = radio[blocked, 1, VALUE] + np.sqrt(radio[blocked, 1, VARIANCE]) * noise
            radio[blocked, 1, VALUE] = (phase + math.pi) % (2.0 * math.pi) - math.pi

    def heard(self, times_s: Array) -> Bools:
        """Which epochs (n,) the anchor is heard in."""
        heard: Bools = np.arange(len(times_s)) % self.heard_every == 0
        return heard


NO_TROUBLE = Trouble()


def within(times_s: Array, span_s: tuple[float, float]) -> Bools:
    """Which of times (n,) lie in a half-open span."""
    return np.asarray((times_s >= span_s[0]) & (times_s < span_s[1]))
