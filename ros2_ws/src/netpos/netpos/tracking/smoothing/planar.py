"""Smoothing of tracks: every epoch given the measurements after it, of a whole recording or of the
next seconds."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from netpos.estimation import smooth
from netpos.messages.values import Array, Odometry
from netpos.tracking import output
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.estimates import Estimate
from netpos.tracking.estimators.models import (
    augmented,
    heading_index,
    height_state,
    initial_extra_sd,
)


@dataclass(frozen=True, slots=True)
class Posterior:
    """What a track knew after one epoch, and the motion that led to it.

    mean (n,), cov (n, n); motion (Parameter,) of the step before, bias (2, k); a smoother does not
    reach across different ``segment`` numbers, between which the track started anew.
    """

    stamp_ns: int
    segment: int
    mean: Array
    cov: Array
    motion: Array
    bias: Array

    @classmethod
    def of(cls, estimate: Estimate, segment: int, bias: Array) -> Posterior:
        """That of an estimate, which goes on."""
        mean, cov, motion = estimate.mean.copy(), estimate.cov.copy(), estimate.motion.copy()
        return cls(estimate.stamp_ns, segment, mean, cov, motion, bias)


def check_smoothable(config: TrackerConfig) -> None:
    """Raises ``ValueError`` for a tracker whose estimates cannot be smoothed."""
    if config.interacts:
        raise ValueError(
            f"motion_model {config.motion_model} cannot be smoothed; use another motion model"
        )


def _stacked(
    posteriors: Sequence[Posterior], extra_sd: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Arguments of ``smooth.rts``; a bias not yet heard of has its stationary variance."""
    bias = posteriors[-1].bias
    sd = np.append(extra_sd, bias[0])
    pairs = [augmented(p.mean, p.cov, sd) for p in posteriors]
    stamps = np.array([p.stamp_ns for p in posteriors])
    motions = np.array([p.motion for p in posteriors[1:]]).reshape(-1, posteriors[0].motion.size)
    means, covs = np.array([m for m, _ in pairs]), np.array([c for _, c in pairs])
    return np.diff(stamps) * 1e-9, means, covs, motions, bias


class Smoother:
    """Turns posteriors of one device into smoothed odometry."""

    def __init__(self, vue_id: str, config: TrackerConfig) -> None:
        """Raises ``ValueError`` as ``check_smoothable``."""
        check_smoothable(config)
        self._vue_id = vue_id
        self._height_m = config.device_height_m
        self._extra_sd = initial_extra_sd(config)
        self._heading, self._height = heading_index(config), height_state(config)
        self._yaw = 0.0

    def interval(self, posteriors: Sequence[Posterior]) -> list[Odometry]:
        """Odometry of every posterior, in the order of stamps, given all of its segment."""
        result: list[Odometry] = []
        last = {p.stamp_ns: p for p in posteriors}  # of one stamp the last counts
        ordered = [last[stamp] for stamp in sorted(last)]
        start = 0
        for stop in range(1, len(ordered) + 1):
            if stop == len(ordered) or ordered[stop].segment != ordered[start].segment:
                segment = ordered[start:stop]
                means, covs = smooth.rts(*_stacked(segment, self._extra_sd))
                result += [
                    self._odometry(p.stamp_ns, m, c)
                    for p, m, c in zip(segment, means, covs, strict=True)
                ]
                start = stop
        return result

    def first(self, window: Sequence[Posterior]) -> Odometry:
        """Odometry of the first posterior given all of ``window``, which is of one segment."""
        means, covs = smooth.rts(*_stacked(window, self._extra_sd))
        return self._odometry(window[0].stamp_ns, means[0], covs[0])

    def _odometry(self, stamp_ns: int, mean: Array, cov: Array) -> Odometry:
        self._yaw, yaw_var = output.heading(mean, cov, self._yaw, self._heading)
        odometry = output.odometry(
            stamp_ns, self._vue_id, mean, cov, self._height_m, self._yaw, yaw_var
        )
        if self._heading >= 0:
            odometry = output.with_yaw_rate(odometry, mean, cov, self._heading)
        if self._height.entry:
            odometry = output.with_height(odometry, mean, cov, self._height)
        return odometry


class PosteriorRecorder:
    """Keeps the posteriors of one device, for smoothing online, afterwards, or both."""

    def __init__(self, vue_id: str, config: TrackerConfig, *, keep: bool = False) -> None:
        """``keep``: all, for ``smoothed``. Raises ``ValueError`` as ``check_smoothable``."""
        self.posteriors: list[Posterior] = []
        self._keep = keep
        self._smoother = Smoother(vue_id, config)
        self._lag_ns = int(config.fixed_lag_s * 1e9)
        self._window: deque[Posterior] = deque()

    def note(self, posterior: Posterior) -> tuple[Odometry, ...]:
        """Take a posterior, one that corrects an earlier one of its stamp included; with a fixed
        lag, gives the odometry of the epochs that are now older or the last of their segment."""
        if self._keep:
            self.posteriors.append(posterior)
        if self._lag_ns == 0:
            return ()
        window, done = self._window, []
        while window and window[-1].stamp_ns >= posterior.stamp_ns:
            window.pop()
        if window and window[-1].segment != posterior.segment:
            done = self._smoother.interval(list(window))
            window.clear()
        window.append(posterior)
        while len(window) > 1 and window[0].stamp_ns <= posterior.stamp_ns - self._lag_ns:
            done.append(self._smoother.first(list(window)))
            window.popleft()
        return tuple(done)

    def go_back(self, stamp_ns: int) -> None:
        """Forget the posteriors from ``stamp_ns`` on; the fixed lag replaces its own."""
        while self.posteriors and self.posteriors[-1].stamp_ns >= stamp_ns:
            self.posteriors.pop()

    def smoothed(self) -> list[Odometry]:
        """Odometry of every posterior kept, given all measurements."""
        return self._smoother.interval(self.posteriors)
