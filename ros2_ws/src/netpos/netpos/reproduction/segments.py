"""The track of a whole run: from its start to its loss, then from a first fix on, to the end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation import engine
from netpos.estimation.densities import PARAMETERS
from netpos.estimation.engine import Run
from netpos.estimation.level.report import run_levels
from netpos.estimation.measurement import BIAS
from netpos.estimation.mixture.epoch import run_epochs
from netpos.estimation.mixture.gaussians import Mixture, one_component
from netpos.estimation.state import N_CORE
from netpos.evaluation.metrics import NS
from netpos.messages.values import Array, ImuSample
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators import estimates
from netpos.tracking.estimators.imu_buffer import ImuBuffer
from netpos.tracking.estimators.models import (
    augmented,
    dynamics_of,
    initial_extra_sd,
    motions_of,
    options_of,
    slow_states,
    start_state,
)
from netpos.tracking.first_fix.initialise import Initialiser
from netpos.tracking.rsus.rsu import Rsu, SlowErrors

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class Epochs(NamedTuple):
    """Epochs of a run: stamps_ns (N,), row_start (N + 1,), rows (M, ROW_WIDTH), biases (2, k) in
    the rows, and the RSUs (N, nearest) as indices, -1 where none."""

    stamps_ns: Ints
    row_start: Ints
    rows: Array
    bias: Array
    rsu: Ints

    @property
    def measured(self) -> engine.Epochs:
        """What the engine takes of them."""
        return engine.Epochs(self.stamps_ns, self.row_start, self.rows)

    def since(self, first: int, *, fixed: bool) -> Epochs:
        """The epochs from ``first`` on; without the rows of that one where a first fix has used
        them (``fixed``)."""
        row_start = self.row_start[first:].copy()
        if fixed:
            row_start[0] = row_start[1]
        return Epochs(self.stamps_ns[first:], row_start, self.rows, self.bias, self.rsu[first:])


class Followed(NamedTuple):
    """Result of an estimator for the N epochs of a run.

    means (N, n), covs (N, n, n), level (N,) [m]: NaN while there is no track; nis, dof and groups
    (N,): of the accepted rows, their number and the number of accepted RSUs; motions (1 or N,
    Parameter); tracked (N,); losses: how often the track was lost
    """

    means: Array
    covs: Array
    level: Array
    nis: Array
    dof: Array
    groups: Array
    motions: Array
    tracked: Flags
    losses: int


def _part(run: Run, first: int, end: int | None = None) -> Run:
    return Run(*(array[first:end] for array in run))


class Follower:
    """A tracker for whole runs: it starts from a given state, and after a loss by a first fix as
    ``tracking.track`` does."""

    def __init__(self, config: TrackerConfig, rsus: tuple[Rsu, ...]) -> None:
        self._config = config
        self._rsus = rsus
        self._options = options_of(config)
        self._extra_sd = initial_extra_sd(config)
        self._motions = motions_of(config)

    @property
    def first_bias(self) -> int:
        """Index of the first state with a row in ``Epochs.bias``: the device's own, then those of
        RSUs."""
        return N_CORE + self._extra_sd.size

    @property
    def own_slow(self) -> Array:
        """Standard deviation and time constant (2, k) of the device's own: its height, where that
        is unknown."""
        return slow_states(self._config).arrays()

    def augmented(self, mean: Array, cov: Array, bias: Array) -> tuple[Array, Array]:
        """A start, as ``start_state`` takes it, with the motion model's own states and the biases
        (2, k)."""
        start = start_state(self._config, mean, cov)
        return augmented(*start, np.append(self._extra_sd, bias[0]))

    def follow(
        self, epochs: Epochs, mean: Array, cov: Array, samples: list[ImuSample] | None
    ) -> Followed:
        """Estimates of a run from ``mean`` (6,) and ``cov`` (6, 6) at its first epoch on.

        ``samples`` of the IMU for a motion model that uses one, None for every other.
        """
        count = epochs.stamps_ns.size
        run = engine.empty_run(count, self.first_bias + epochs.bias.shape[1])
        level, tracked = np.full(count, np.nan), np.zeros(count, dtype=np.bool_)
        motions, imu = self._run_motions(count, samples is not None), _buffer(samples)
        varies = len(motions) > 1
        start: tuple[int, Mixture] | None = (0, one_component(mean, cov))
        losses = 0
        while start is not None:
            first, fix = start
            part, part_run = epochs.since(first, fixed=losses > 0), _part(run, first)
            part_motions = motions[first:] if varies else motions
            if imu is None and fix.log_weights.size == 1:
                done = self._compiled(part, fix.means[0], fix.covs[0], part_run)
            else:
                done = self._stepped(part, fix, part_run, imu, part_motions)
            end = first + done
            if any(self._options.learns_density):
                part_motions[:done, list(PARAMETERS)] = part_run.densities[:done]
            whole = _part(part_run, 0, done)
            level[first:end] = run_levels(part.measured, whole, self._options)
            lost = end < count
            tracked[first : end - lost] = True  # nothing is published of the epoch of the loss
            losses += lost
            start = self._first_fix(epochs, end) if lost else None
        for array in (run.means, run.covs, level):
            array[~tracked] = np.nan
        return Followed(
            run.means, run.covs, level, run.nis, run.dof, run.groups, motions, tracked, losses
        )

    def _run_motions(self, count: int, driven: bool) -> Array:
        """(1 or N, Parameter): the N of a run that the IMU drives, or the density of which is
        learned, are filled on the way. Of models that interact, bound and level know one:
        straight on."""
        if driven or any(self._options.learns_density):
            return np.tile(self._motions[0], (count, 1))
        return self._motions[1:2] if self._config.interacts else self._motions

    def _compiled(self, epochs: Epochs, mean: Array, cov: Array, run: Run) -> int:
        """Epochs done: all in one kernel."""
        mean, cov = self.augmented(mean, cov, epochs.bias)
        dynamics = dynamics_of(self._config, epochs.bias)
        done: int = run_epochs(epochs.measured, mean, cov, dynamics, self._options, run)
        return done

    def _stepped(
        self,
        epochs: Epochs,
        fix: Mixture,
        run: Run,
        imu: ImuBuffer | None,
        motions: Array,
    ) -> int:
        """As ``_compiled``, epoch by epoch, from a first fix of several components, or where an
        IMU drives the filter, which fills ``motions`` (N, Parameter). As in a tracker, a slow
        error becomes a state with its first measurement; until then it is in the results only."""
        config, first = self._config, self.first_bias
        sd = np.append(self._extra_sd, epochs.bias[0])
        heard_ns, rejected = int(epochs.stamps_ns[0]), 0
        known = max(first + self.own_slow.shape[1], fix.means.shape[1])
        estimate = estimates.start_from(config, heard_ns, fix)
        for k, stamp in enumerate(epochs.stamps_ns.tolist()):
            rows = epochs.rows[epochs.row_start[k] : epochs.row_start[k + 1]].copy()
            if rows.size:
                known = max(known, int(rows[:, BIAS].max()) + 1)
                estimate.augment(sd[: known - N_CORE])
                if imu is not None:
                    yaw, speed, _ = imu.increments(estimate.stamp_ns, stamp)
                    estimate.set_imu_increment(yaw, speed, config.gyro_noise_density)
                unheard_s, bias = (stamp - heard_ns) / NS, epochs.bias[:, : known - first].copy()
                step = estimate.step(stamp, unheard_s, rejected, rows, bias)
                run.nis[k], run.dof[k], run.undetected_m[k] = step.nis, step.dof, step.undetected_m
                run.groups[k] = sum(step.accepted)
                rejected = 0 if 2 * run.groups[k] >= len(step.accepted) else rejected + 1
                heard_ns = stamp if run.dof[k] else heard_ns
            run.means[k], run.covs[k] = augmented(estimate.mean, estimate.cov, sd)
            run.radius[k] = estimate.radius(0.0)
            run.densities[k] = estimate.motion[list(PARAMETERS)]
            if imu is not None:
                motions[k] = estimate.motion
            if rejected >= config.max_rejected_epochs:
                return k + 1
        return epochs.stamps_ns.size

    def _first_fix(self, epochs: Epochs, first: int) -> tuple[int, Mixture] | None:
        """Epoch and components of a first fix by the rows from ``first`` on; None where they do
        not suffice."""
        initialiser, known = Initialiser(self._config), self.own_slow.shape[1]
        for k in range(first, epochs.stamps_ns.size):
            rows = epochs.rows[epochs.row_start[k] : epochs.row_start[k + 1]]
            known = max(known, int(rows[:, BIAS].max(initial=-1.0)) + 1 - self.first_bias)
            slow = SlowErrors(self.first_bias, epochs.bias[0, :known], np.ones(known, np.bool_))
            heard = tuple(self._rsus[i] for i in epochs.rsu[k] if i >= 0)
            initialiser.add(int(epochs.stamps_ns[k]), rows, heard)
            fix = initialiser.solve(slow)
            if fix is not None:
                return k, fix
        return None


def _buffer(samples: list[ImuSample] | None) -> ImuBuffer | None:
    if samples is None:
        return None
    imu = ImuBuffer()
    for sample in samples:
        imu.add(sample)
    return imu
