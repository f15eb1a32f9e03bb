"""The first fix: the most probable state behind the first measurements, with the covariance it
deserves.

Measurements of a short window are collected until they determine a position; ``window_fit`` says
what they say of it. It takes any mixture of angles, times, ranges and fixes, and it waits while
the measurements leave the position open.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from netpos.estimation.measurement import HEADING
from netpos.estimation.mixture.gaussians import Mixture, mode_of
from netpos.estimation.mixture.mirror import Mirror, mirror_of
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import carries_modes, slow_states
from netpos.tracking.first_fix.problem import Heard
from netpos.tracking.first_fix.window_fit import WindowFit
from netpos.tracking.rsus.rsu import Rsu, SlowErrors

_ATTEMPT_NS = 100_000_000
_RETRY_SHARE = 0.05  # the next attempt comes after so much of the time waited
# Places that cannot be told apart are waited for from this share on, and carried along below it.
_MODE_SHARE = 0.01
_WAITS_SHARE = 0.8  # of the window


def has_modes(mixture: Mixture, share: float) -> bool:
    """Whether more than one mode carries more than ``share``."""
    sums = np.bincount(mode_of(mixture), np.exp(mixture.log_weights))
    return bool((sums > share).sum() > 1)


class Initialiser:
    """Collects rows until they determine a position."""

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._window: deque[Heard] = deque()
        self._own = slow_states(config).slow_errors
        self._next_attempt_ns = 0
        self._since_ns = 0
        self.missing = ""
        """What a first fix lacks, for people; empty before the first attempt."""

    def copy(self) -> Initialiser:
        """An independent copy."""
        twin = Initialiser(self._config)
        twin._window = self._window.copy()
        twin._next_attempt_ns = self._next_attempt_ns
        twin._since_ns = self._since_ns
        twin.missing = self.missing
        return twin

    def add(self, stamp_ns: int, rows: Array, rsus: tuple[Rsu, ...]) -> None:
        """Take the rows (m, ROW_WIDTH) of one epoch, which name their slow errors as a track
        does."""
        rows = rows.copy()
        rows[:, HEADING] = -1
        self._window.append(Heard(stamp_ns, rows, rsus))
        oldest = stamp_ns - int(self._config.initial_window_s * 1e9)
        while self._window[0].stamp_ns < oldest:
            self._window.popleft()
        if len(self._window) == 1:
            self._since_ns = stamp_ns

    def solve(self, slow: SlowErrors | None = None) -> Mixture | None:
        """State (n,) of a track at the newest stamp, with the ``slow`` errors that rows name
        (None: those of the device alone), as ``WindowFit.posterior`` gives it. None while the
        position is open, or for most of the window while there are several modes."""
        newest = self._window[-1].stamp_ns
        if newest < self._next_attempt_ns:
            return None
        waited_ns = newest - self._since_ns
        self._next_attempt_ns = newest + max(_ATTEMPT_NS, round(_RETRY_SHARE * waited_ns))
        fit = WindowFit(self._config, self._window, slow or self._own)
        found = fit.posterior()
        if isinstance(found, str):
            self.missing = found
            return None
        span_s = (newest - self._window[0].stamp_ns) * 1e-9
        is_new = span_s < _WAITS_SHARE * self._config.initial_window_s
        if (is_new or not carries_modes(self._config)) and has_modes(found, _MODE_SHARE):
            self.missing = f"more than one place fits {fit.sources}; waiting for more"
            return None
        return found

    def mirror(self, fix: Mixture) -> Mirror | None:
        """The mirror that the measurements leave the state of a ``fix``, in which position and
        velocity alone have a direction; None where they tell its two sides apart."""
        if any(rsu.cone for one in self._window for rsu in one.rsus):
            return None
        rows = np.vstack([one.rows for one in self._window])
        return mirror_of(rows, fix.means.shape[1], self._config.device_height_m)

    def excess_cost(self, stamp_ns: int, mean: Array, var: Array, slow: SlowErrors) -> float:
        """``WindowFit.excess_cost``; 0 without measurements of the time."""
        age_s = (stamp_ns - self._window[-1].stamp_ns) * 1e-9 if self._window else math.inf
        if age_s > self._config.initial_window_s:
            return 0.0
        return WindowFit(self._config, self._window, slow).excess_cost(age_s, mean, var)
