"""The first fix from range and phase of one array."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field

import numpy as np

from netpos.estimation.fixes.phase_fix import TWO_PI, init_hypothesis, phase_scale
from netpos.estimation.measurement import AXES, GROUP, ORIGIN, VALUE, VARIANCE
from netpos.estimation.mixture.sectors import phase_place, sectors_of_fix
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.rows import drop_biases
from netpos.messages.values import Array, Velocity
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators import estimates
from netpos.tracking.estimators.epoch_rows import EpochRows
from netpos.tracking.estimators.estimates import Estimate
from netpos.tracking.estimators.models import (
    by_sectors,
    heading_index,
    options_of,
    pose_state,
    start_state,
)
from netpos.tracking.first_fix.step_heading import choose_sector

_WALKING_MPS = 0.1  # a step velocity below this is none
_LEAST_EPOCHS = 3  # of a step, for a line through its places


@dataclass(slots=True)
class PhaseStart:
    """Turns epochs with range and phase into a first estimate, as ``TrackerConfig.ambiguity``
    says. ``step_heading`` collects the epochs of a step, which lasts as long as the velocity
    reported stays the same, and applies the rule once it is over."""

    config: TrackerConfig
    _velocity: Array | None = None
    _epochs: list[tuple[int, float, float]] = field(default_factory=list)
    _step: tuple[Array, list[tuple[int, float, float]]] | None = None

    def copy(self) -> PhaseStart:
        """An independent copy."""
        twin = copy.copy(self)
        twin._epochs = self._epochs.copy()
        return twin

    def heard(self, epoch_rows: EpochRows) -> bool:
        """Take the step velocities of an epoch; whether a track may start from it this way."""
        for item in epoch_rows.items:
            if isinstance(item, Velocity):
                self.hear(item)
        return (by_sectors(self.config) or self._by_heading) and phase_place(epoch_rows.rows) >= 0

    @property
    def _by_heading(self) -> bool:
        plain = heading_index(self.config) < 0
        return self.config.ambiguity == "step_heading" and plain

    def hear(self, velocity: Velocity) -> None:
        """Take a step velocity, before the epoch it belongs to is added."""
        if self._velocity is not None and np.array_equal(self._velocity, velocity.velocity):
            return
        if self._velocity is not None and math.hypot(*self._velocity) > _WALKING_MPS:
            self._step = self._velocity, self._epochs
        self._velocity, self._epochs = velocity.velocity, []

    def add(self, stamp_ns: int, rows: Array, bias_var: Array) -> Estimate | None:
        """The first estimate; None while there is none.

        bias_var : (m,) variance of the biases in each row
        """
        rows = rows.copy()
        rows[:, VARIANCE] += bias_var
        at = phase_place(rows)
        start = pose_state(self.config, np.zeros(2), np.eye(2))
        if not self._by_heading:
            return self._by_sectors(stamp_ns, rows, at, start)
        turns = self._turns(rows, at)
        self._epochs.append((stamp_ns, float(rows[at - 1, VALUE]), float(rows[at, VALUE])))
        if turns is None:
            return None
        mean, cov = start_state(self.config, *start)
        speed, height = self.config.initial_speed_sd_mps, self.config.device_height_m
        if init_hypothesis(mean, cov, rows[at - 1], rows[at], turns, speed, height) == -math.inf:
            return None
        return Estimate(self.config, stamp_ns, mean, cov)

    def _by_sectors(
        self, stamp_ns: int, rows: Array, at: int, start: tuple[Array, Array]
    ) -> Estimate | None:
        """An estimate with a component in every sector of the phase ``rows[at]``, to which the
        other measurements are applied; None where range and phase have no place."""
        mean, cov = start_state(self.config, *start)
        fix = sectors_of_fix(mean, cov, rows, at, options_of(self.config))
        if not fix.log_weights.size:
            return None
        estimate = estimates.start_from(self.config, stamp_ns, fix)
        rest = rows[rows[:, GROUP] != rows[at, GROUP]].copy()
        if len(rest):
            rest[:, GROUP] = np.unique(rest[:, GROUP], return_inverse=True)[1]
            drop_biases(rest)  # no states yet
            estimate.step(stamp_ns, 0.0, 0, rest, NO_BIAS)
        return estimate

    def _turns(self, rows: Array, at: int) -> int | None:
        """Turns of the phase ``rows[at]`` by the rule on the step that has just ended."""
        step, self._step = self._step, None
        if step is None or len(step[1]) < _LEAST_EPOCHS:
            return None
        velocity, epochs = step
        ranged, phase = rows[at - 1], rows[at]
        along = math.atan2(phase[AXES + 1], phase[AXES])
        baseline_m = 2.0 * float(np.linalg.norm((ranged - phase)[ORIGIN : ORIGIN + 3]))
        stamps, ranges, phases = (np.array(column) for column in zip(*epochs, strict=True))
        choice = choose_sector(
            (stamps - stamps[0]) * 1e-9,
            ranges,
            phases,
            math.atan2(velocity[1], velocity[0]) - along,
            baseline_m,
            TWO_PI * baseline_m / float(phase_scale(phase)),
        )
        if choice is None:
            return None
        continuous = np.unwrap(np.append(phases, phase[VALUE]))
        return choice.chosen + round(float(continuous[-1] - phase[VALUE]) / TWO_PI)
