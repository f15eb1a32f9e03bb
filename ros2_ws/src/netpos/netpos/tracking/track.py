"""One device: history, excluded RSUs, first fix, update, lost track, report.

The state of the device is behind ``estimator.Estimator``; what is here holds for every kind of
track.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.level.report import level_of
from netpos.estimation.mixture.gaussians import Mixture
from netpos.messages.values import (
    Array,
    InitialPose,
    Odometry,
    RsuErrors,
    RsuMeasurement,
    TrackStatus,
)
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.epoch_rows import (
    EpochRows,
    Source,
    fits,
    mostly_accepted,
    refused_groups,
    velocity_inflation,
)
from netpos.tracking.estimators.estimates import UpdateResult
from netpos.tracking.estimators.estimator import RECENT, Estimator, Past
from netpos.tracking.estimators.imu_buffer import ImuBuffer
from netpos.tracking.estimators.models import gate_thresholds
from netpos.tracking.estimators.planar import PlanarEstimator
from netpos.tracking.health.health import RsuHealth
from netpos.tracking.health.observations import FittedEpoch
from netpos.tracking.ordering.history import History, TrackSnapshot, merge
from netpos.tracking.ordering.sequencer import Epoch, Item
from netpos.tracking.report import (
    EpochResult,
    EstimateStatus,
    TrackOutput,
    total,
    track_status,
    waiting_output,
)
from netpos.tracking.rsus.rsu import Rsu
from netpos.tracking.rsus.shared_errors import SharedErrors
from netpos.tracking.rsus.shares import Shares


class Track:
    """Estimator of one device. Epochs come in stamp order; time is theirs."""

    def __init__(
        self,
        vue_id: str,
        config: TrackerConfig,
        rsus: Mapping[str, Rsu],
        health: RsuHealth | None = None,
        shared: SharedErrors | None = None,
    ) -> None:
        self._vue_id = vue_id
        self._take(config)
        self._rsus = rsus
        self._health = health or RsuHealth()
        self._shared = shared
        self._history: History = History(int(config.history_s * 1e9))
        self.refused: Counter[str] = Counter()
        """Measurements refused at the door, by reason."""
        self._errors: tuple[RsuErrors, ...] = ()
        estimator = _estimator_of(vue_id, config, rsus, shared)
        self._state = TrackSnapshot(estimator, Shares.unknown(config))

    def _take(self, config: TrackerConfig) -> None:
        self._config = config
        self._gate = gate_thresholds(config.gate_probability)
        self._manoeuvre_sd_mps = config.manoeuvre_sd_mps

    def set_config(self, config: TrackerConfig) -> None:
        """Go on with other live parameters. Epochs that are over keep what they were applied with,
        unless a measurement comes late that is older than the change."""
        self._history.mark(self._state)
        self._take(config)
        for state in (self._state, *self._history.states()):
            state.estimator.set_config(config)

    @property
    def imu(self) -> ImuBuffer:
        """Where the samples of the device's IMU go."""
        return self._state.estimator.imu

    @property
    def rejected(self) -> Counter[str]:
        """Measurements refused at the door or rejected by the track, by reason."""
        return Counter(total(self.refused, self._state.rejected))

    @property
    def has_estimate(self) -> bool:
        """Whether there was a first fix."""
        return self._state.estimator.estimate is not None

    @property
    def components(self) -> Mixture | None:
        """The weighted Gaussians of the last epoch's posterior; None without an estimate, or where
        it is one in space."""
        return self._state.estimator.components if self.has_estimate else None

    def status_at(self, stamp_ns: int) -> TrackStatus:
        """Status at a later instant, had nothing been heard until then; nothing changes."""
        return self._ahead(stamp_ns).status

    def waiting(self, stamp_ns: int, missing: str) -> TrackOutput:
        """What is told while there is no estimate, for want of ``missing``."""
        return self._waiting(EpochResult(stamp_ns), missing)

    def _waiting(self, epoch: EpochResult, missing: str) -> TrackOutput:
        state, rejected = self._state, total(self.refused, self._state.rejected)
        return waiting_output(self._config, self._vue_id, epoch, state.accepted, rejected, missing)

    def reset(self) -> None:
        """Forget the estimate and start anew; the counts of accepted and rejected measurements go
        on."""
        self._history.clear()
        self.imu.clear()
        self._forget()

    def _forget(self) -> None:
        old = self._state
        self._state = TrackSnapshot(old.estimator.fresh(), Shares.unknown(self._config))
        self._state.accepted, self._state.rejected = old.accepted, old.rejected
        self._state.segment = old.segment + 1
        self._state.pose_wait.posed = old.pose_wait.posed

    # epochs

    def step(self, epoch: Epoch) -> TrackOutput:
        """Apply one epoch and report; of one without items only report."""
        self._history.remember(epoch, self._state)
        self._errors = ()
        if not epoch.items:
            return self._ahead(epoch.stamp_ns)
        items = self._measurements(epoch)
        applied = EpochResult(epoch.stamp_ns)
        if items:
            self._forget_after_silence(epoch.stamp_ns)
            items, watched = self._sorted_out(epoch.stamp_ns, items)
            if items:
                applied = self._apply(epoch.stamp_ns, items)
            for item in watched:
                self._watch(epoch.stamp_ns, item)
        estimator = self._state.estimator
        estimator.predict(epoch.stamp_ns)
        output = self._report(applied, estimator)
        smoothed = estimator.record(self._state.segment)
        return replace(output, smoothed=smoothed) if smoothed else output

    def revise(self, late: list[tuple[int, Item]]) -> tuple[list[Epoch], TrackOutput]:
        """Go back to the oldest of the late items and apply all epochs since then once more.

        late : stamps within the history and items, oldest first
        Returns the epochs that are new, and the report of the newest epoch.
        """
        epochs, state = self._history.go_back(late[0][0])
        self._state = state or self._state
        made = [merge(epochs, stamp_ns, item) for stamp_ns, item in late]
        first_ns = epochs[0].stamp_ns
        self._state.estimator.go_back(first_ns)
        self._health.rewind(self._vue_id, first_ns)
        if self._shared is not None:
            self._shared.rewind(self._vue_id, first_ns)
        smoothed: list[Odometry] = []
        errors: tuple[RsuErrors, ...] = ()
        for epoch in epochs:
            result = self.step(epoch)
            smoothed += result.smoothed
            errors = result.errors or errors
        new = [epoch for epoch in made if epoch is not None]
        return new, replace(result, revised=True, smoothed=tuple(smoothed), errors=errors)

    def _measurements(self, epoch: Epoch) -> list[Source]:
        """What can be fused of an epoch; an initial pose is taken, what has no row is counted."""
        items: list[Source] = []
        for item in epoch.sorted():
            if isinstance(item, InitialPose):
                self._start_from_pose(epoch.stamp_ns, item)
                continue
            readable = self._state.estimator.readable(item)
            if readable is None:
                self._state.rejected["unsupported_fields"] += 1
            else:
                items.append(readable)
        return items

    def _forget_after_silence(self, stamp_ns: int) -> None:
        estimate = self._state.estimator.estimate
        if estimate is not None:
            gap_s = (stamp_ns - estimate.stamp_ns) * 1e-9
            if gap_s > self._config.max_gap_s:
                self._forget()

    def _apply(self, stamp_ns: int, items: list[Source]) -> EpochResult:
        state = self._state
        inflation = velocity_inflation(
            items, state.velocity_ns, self._config.velocity_correlation_s
        )
        epoch_rows = state.estimator.rows(items, inflation)
        if state.estimator.estimate is None:
            return EpochResult(stamp_ns, sources=self._try_first_fix(stamp_ns, epoch_rows))
        return self._update(stamp_ns, epoch_rows)

    # excluded RSUs and those on probation

    def _sorted_out(
        self, stamp_ns: int, items: list[Source]
    ) -> tuple[list[Source], list[RsuMeasurement]]:
        """What may be fused, and what comes from an excluded RSU and is only looked at."""
        if not self._config.isolate_rsus:
            return items, []
        used, watched = self._health.sort_out(
            stamp_ns, items, lambda item: self._agrees(stamp_ns, item)
        )
        if watched:
            self._state.rejected["isolated_rsu"] += len(watched)
        return used, watched

    def _agrees(self, stamp_ns: int, item: RsuMeasurement) -> bool:
        """Whether a measurement alone agrees with the prediction; without one none does."""
        if not self.has_estimate:
            return False
        self._state.estimator.predict(stamp_ns)
        return fits(self._state.estimator.rows_alone(item)[1], self._gate)

    def _watch(self, stamp_ns: int, item: RsuMeasurement) -> None:
        """Compare what is not fused with the estimate."""
        if self.has_estimate:
            self._state.estimator.predict(stamp_ns)
            rows, innovations = self._state.estimator.rows_alone(item)
            self._hear(stamp_ns, rows, innovations, [fits(innovations, self._gate)])

    def _hear(
        self, stamp_ns: int, rows: EpochRows, innovations: Array, accepted: Sequence[float]
    ) -> None:
        """Tell the health of the RSUs how an epoch fitted."""
        self._health.hear(
            FittedEpoch(stamp_ns, self._vue_id, rows.items, rows.rows, innovations, accepted)
        )

    # first fix

    def _start_from_pose(self, stamp_ns: int, pose: InitialPose) -> None:
        if self._is_excluded(stamp_ns, pose):
            self._state.rejected["initialpose"] += 1
            return
        self._forget()
        self._state.pose_wait.posed = True
        if self._state.estimator.start_from_pose(stamp_ns, pose):
            self._state.last_accepted_ns = stamp_ns

    def _is_excluded(self, stamp_ns: int, pose: InitialPose) -> bool:
        """Whether the newest measurements exclude an initial pose, however sure it is of
        itself."""
        state = self._state
        if self.has_estimate and state.rejected_in_row:
            return False
        recent = state.recent if self.has_estimate else None
        bound = chi_square_bound(2, 1.0 - self._config.gate_probability)
        return state.estimator.pose_cost(stamp_ns, pose, recent) > bound

    def _try_first_fix(self, stamp_ns: int, epoch_rows: EpochRows) -> tuple[str, ...]:
        state = self._state
        if state.pose_wait.awaits(self._config, stamp_ns, tracked=state.accepted > 0):
            state.rejected["no_initial_pose"] += len(epoch_rows.items)
            return ()
        fix = state.estimator.first_fix(stamp_ns, epoch_rows)
        if fix.refused:
            state.rejected[fix.refused] += len(epoch_rows.items)
        if not fix.found:
            for item in epoch_rows.items:  # the fix counts them
                if isinstance(item, RsuMeasurement):
                    state.estimator.biases.accepted(self._rsus[item.rsu_id], item)
            return ()
        state.has_clock = fix.has_clock
        return self._note_accepted(stamp_ns, epoch_rows)

    def _missing(self) -> str:
        """What is missing for a first fix."""
        state = self._state
        return state.pose_wait.missing(self._config, self._vue_id, state.estimator.missing)

    # update

    def _update(self, stamp_ns: int, epoch_rows: EpochRows) -> EpochResult:
        state = self._state
        unheard_s = (stamp_ns - state.last_accepted_ns) * 1e-9
        past = Past(unheard_s, state.rejected_in_row)
        state.shares.expect(epoch_rows)
        result = state.estimator.update(stamp_ns, epoch_rows, past)
        state.shares.learn(epoch_rows, result.outliers)
        self._count(result)
        if not result.sound:
            self._forget()
            return EpochResult(stamp_ns)
        self._note_fit(stamp_ns, epoch_rows, result)
        self._errors = state.estimator.learn(stamp_ns, epoch_rows.rows, result.accepted)
        accepted = result.accepted
        sources: tuple[str, ...] = ()
        if result.dof > 0:
            state.has_clock = state.has_clock or epoch_rows.has_time
            sources = self._note_accepted(stamp_ns, epoch_rows, result)
        fitted = 0.0 not in accepted or mostly_accepted(epoch_rows, accepted)
        if fitted:
            state.recent = (*state.recent[1 - RECENT :], (stamp_ns, epoch_rows))
        self._count_rejected(fitted)
        return EpochResult(stamp_ns, result.nis, result.dof, sources)

    def _count(self, result: UpdateResult) -> None:
        """Count what an update has rejected, and where a smoother cannot reach across."""
        state = self._state
        state.segment += result.breaks
        if not result.sound:
            state.rejected["diverged"] += 1
        elif 0.0 in result.accepted:
            state.rejected["gate"] += result.accepted.count(0.0)

    def _note_fit(self, stamp_ns: int, epoch_rows: EpochRows, result: UpdateResult) -> None:
        """Tell the protection level and the health of the RSUs how an epoch fitted."""
        state, accepted = self._state, result.accepted
        state.undetected_m = result.undetected_m
        if math.isfinite(result.nis):
            of_rsus = any(isinstance(item, RsuMeasurement) for item in epoch_rows.items)
            scale = state.rsus_scale if of_rsus else state.device_scale
            scale.add(result.nis, result.dof, refused_groups(epoch_rows, accepted, self._gate))
        if self._config.isolate_rsus:
            self._hear(stamp_ns, epoch_rows, result.innovations, accepted)

    def _note_accepted(
        self, stamp_ns: int, epoch_rows: EpochRows, result: UpdateResult | None = None
    ) -> tuple[str, ...]:
        """Count what was accepted (without a ``result`` all of it); who sent it."""
        state, sources = self._state, []
        biases = state.estimator.biases
        for i, item in enumerate(epoch_rows.items):
            if result is not None and not result.accepted[i]:
                continue
            if isinstance(item, RsuMeasurement):
                biases.accepted(self._rsus[item.rsu_id], item)
                sources.append(item.rsu_id)
            else:
                sources.append(item.source)
                state.velocity_ns[item.source] = item.stamp_ns
        state.accepted += len(sources)
        state.last_accepted_ns = stamp_ns
        return tuple(sources)

    def _count_rejected(self, fitted: bool) -> None:
        """Count the epochs in a row that did not fit; too many, and the track is lost."""
        state = self._state
        state.rejected_in_row = 0 if fitted else state.rejected_in_row + 1
        if state.rejected_in_row >= self._config.max_rejected_epochs:
            state.rejected["track_lost"] += 1
            self._forget()

    # report

    def record(self) -> None:
        """Keep every posterior from now on, for ``smoothed``."""
        self._state.estimator.keep_posteriors()

    def smoothed(self) -> list[Odometry]:
        """Odometry of every posterior kept, given all measurements."""
        return self._state.estimator.smoothed()

    def _ahead(self, stamp_ns: int) -> TrackOutput:
        """Report of a later instant, had nothing been heard until then; nothing changes."""
        return self._report(EpochResult(stamp_ns), self._state.estimator.ahead(stamp_ns))

    def _report(self, epoch: EpochResult, estimator: Estimator) -> TrackOutput:
        """What is told after an ``epoch``, at which the ``estimator`` is."""
        state, config = self._state, self._config
        if estimator.estimate is None:
            return self._waiting(epoch, self._missing())
        rejected = total(self.refused, state.rejected)
        described = estimator.describe(epoch.stamp_ns)
        known = EstimateStatus(
            heard_ns=state.last_accepted_ns,
            position_sd_m=described.position_sd_m,
            level_m=estimator.radius(self._level(epoch.stamp_ns, described.radius_m)),
            modes=estimator.modes,
            is_at_a_place=estimator.is_at_a_place,
            steps=estimator.step_calibration(),
            refused_in_row=state.rejected_in_row,
        )
        return TrackOutput(
            described.odometry,
            described.clock if state.has_clock else None,
            track_status(config, self._vue_id, epoch, state.accepted, rejected, known),
            network=config.network,
            track=estimator.network_track(state.segment),
            errors=self._errors,
        )

    def _level(self, stamp_ns: int, radius_m: float) -> float:
        """Protection level [m] of the estimate's Gaussian, whose error leaves ``radius_m``."""
        state = self._state
        risk = self._config.integrity_risk
        inflation = max(state.rsus_scale.inflation(risk), state.device_scale.inflation(risk))
        unheard_s = (stamp_ns - state.last_accepted_ns) * 1e-9
        level: float = level_of(
            radius_m, inflation, state.undetected_m, self._manoeuvre_sd_mps, unheard_s
        )
        return level


def _estimator_of(
    vue_id: str, config: TrackerConfig, rsus: Mapping[str, Rsu], shared: SharedErrors | None
) -> Estimator:
    """The estimator of the motion model. The spatial one brings SciPy's rotations: a planar
    tracker does without."""
    if not config.is_strapdown:
        return PlanarEstimator(vue_id, config, rsus, shared)
    from netpos.tracking.estimators.spatial import SpatialEstimator  # noqa: PLC0415

    return SpatialEstimator(vue_id, config, rsus)


def warm_up_strapdown(config: TrackerConfig) -> None:
    """Compile, or load, the kernels of strapdown tracks before the first measurement."""
    from netpos.tracking.estimators.spatial import warm_up  # noqa: PLC0415

    warm_up(config)
