"""How much the velocity of someone who walks may change, by what dead reckoning reports.

A run of equal steps keeps its speed, as surely as the velocity is known. Where the velocity
reported changes by more than its errors explain, the walker has started, stopped or turned at some
time since the last report, each time as probable: white acceleration over that interval, with the
square of the change as its variance.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator

import numpy as np

from netpos.messages.values import Velocity
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import gate_thresholds

_LASTS_S = 1.0  # a report holds for so long, and its error may build up within that time


class AdaptiveProcessNoise:
    """Turns reported velocities into the density of the white acceleration up to their stamp."""

    def __init__(self, config: TrackerConfig) -> None:
        self._last: dict[str, Velocity] = {}  # by source
        self.set_config(config)

    def set_config(self, config: TrackerConfig) -> None:
        """Go on with other parameters and what was heard."""
        self._config = config
        self._explained = float(gate_thresholds(config.gate_probability)[2])

    def copy(self) -> AdaptiveProcessNoise:
        """An independent copy."""
        twin = copy.copy(self)
        twin._last = self._last.copy()
        return twin

    def density(
        self, stamp_ns: int, free_density: float, velocities: Iterable[Velocity] = ()
    ) -> float:
        """Density [m/s^2/sqrt(Hz)] for the prediction to ``stamp_ns``, where ``velocities`` are
        reported; ``free_density``: of a device of which they say nothing."""
        config = self._config
        opened = max((self._change(velocity) for velocity in velocities), default=0.0)
        if config.steady_accel_density_mps2_sqrthz == 0.0 or config.use_imu:
            return free_density
        known = [float(np.trace(last.cov)) / 2.0 for last in self._lately(stamp_ns)]
        free = free_density**2
        steady = config.steady_accel_density_mps2_sqrthz**2 + min(known, default=free) / _LASTS_S
        return math.sqrt(min(steady, free) + opened)

    def hears(self, stamp_ns: int) -> bool:
        """Whether a velocity reported before still holds at ``stamp_ns``."""
        return any(True for _ in self._lately(stamp_ns))

    def _lately(self, stamp_ns: int) -> Iterator[Velocity]:
        return (v for v in self._last.values() if stamp_ns - v.stamp_ns <= _LASTS_S * 1e9)

    def _change(self, velocity: Velocity) -> float:
        """Spectral density of the acceleration [m^2/s^3] that the change since the last report of
        a source stands for; 0 where their errors explain it."""
        last = self._last.get(velocity.source)
        self._last[velocity.source] = velocity
        if last is None or velocity.stamp_ns <= last.stamp_ns:
            return 0.0
        change = velocity.velocity - last.velocity
        distance2 = float(change @ np.linalg.solve(velocity.cov + last.cov, change))
        if distance2 <= self._explained:
            return 0.0
        return float(change @ change) / 2.0 / ((velocity.stamp_ns - last.stamp_ns) * 1e-9)
