"""One device in space: the strapdown filter behind the interface of ``track.Track``.

Every range, time and angle is an update of the error-state filter (tight coupling), position
fixes are the loose one. Its states are followed by the device's clock and by the biases RSUs
declare. Between epochs the odometry may be given out at a rate of its own: the estimate moved by
the IMU, which leaves the track as it is.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from netpos.estimation.conditioning import Robust
from netpos.estimation.error_state import MEMORY, Imu, Sensors, advance, correct, doubt_standstill
from netpos.estimation.measurement import GROUP, KIND, VARIANCE, Kind
from netpos.estimation.protection import NisWindow, protection_level
from netpos.estimation.space import place_rows
from netpos.estimation.space_conditioning import reweight_3d
from netpos.estimation.state import ERR_BIASES, ERR_CLOCK_DRIFT, NAV_CLOCK_DRIFT, POSITION
from netpos.inertial.strapdown import ERR, NAV
from netpos.messages.values import Array, InitialPose, Odometry, RsuMeasurement, TrackStatus
from netpos.tracking import output
from netpos.tracking.config import TrackerConfig
from netpos.tracking.epoch_rows import EpochRows, mostly_accepted
from netpos.tracking.fit import fits, observe_excluded, widen, with_refused, without_excluded
from netpos.tracking.health import RsuHealth
from netpos.tracking.history import History, merge
from netpos.tracking.models import gate_thresholds, robust_options_of
from netpos.tracking.nlos_rate import NlosRate
from netpos.tracking.observations import FittedEpoch
from netpos.tracking.pose_wait import PoseWait
from netpos.tracking.report import (
    EpochResult,
    EstimateStatus,
    TrackOutput,
    total,
    track_status,
    waiting_output,
)
from netpos.tracking.rsus import BiasStates, Rsu
from netpos.tracking.sequencer import Epoch, Item
from netpos.tracking.strapdown_engine import compile_kernels
from netpos.tracking.strapdown_models import augmented_3d, sensors_of, with_clock
from netpos.tracking.strapdown_output import odometry_of
from netpos.tracking.strapdown_rows import Source, epoch_rows_3d, innovations_with_sd_3d, usable
from netpos.tracking.strapdown_smoothing import Recorder
from netpos.tracking.strapdown_start import SampleBuffer, StrapdownStart

_POSE_VAR_MIN = 1e-4  # an initial pose may leave the height's variance at 0
_RATE_WINDOW_NS = 50_000_000


@dataclass(slots=True)
class _Estimate:
    stamp_ns: int
    nav: Array
    cov: Array
    memory: Array

    def copy(self) -> _Estimate:
        return _Estimate(self.stamp_ns, self.nav.copy(), self.cov.copy(), self.memory.copy())


@dataclass(slots=True)
class _State:
    """All of a track that changes with an epoch."""

    start: StrapdownStart
    nlos_rate: NlosRate
    biases: BiasStates = field(default_factory=lambda: BiasStates(ERR_BIASES))
    estimate: _Estimate | None = None
    pose_wait: PoseWait = field(default_factory=PoseWait)
    has_clock: bool = False
    nis_window: NisWindow = field(default_factory=NisWindow)
    rejected_in_row: int = 0
    last_accepted_ns: int = 0
    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)

    def copy(self) -> _State:
        twin = copy.copy(self)
        if self.estimate is None:
            twin.start = self.start.copy()
        else:
            twin.estimate = self.estimate.copy()
        twin.biases = self.biases.copy()
        twin.nlos_rate = self.nlos_rate.copy()
        twin.pose_wait = copy.copy(self.pose_wait)
        twin.nis_window = self.nis_window.copy()
        twin.rejected = self.rejected.copy()
        return twin


def warm_up(config: TrackerConfig) -> None:
    """Compile, or load, the kernels before the first measurement."""
    compile_kernels(sensors_of(config))
    nav, cov = with_clock(config, np.zeros(NAV), np.eye(ERR))
    rows = place_rows(np.zeros(3), np.eye(3), (0.0, 0.0, 0.0))
    innovations_with_sd_3d(rows, nav, cov)
    if config.robust != "none" or config.nlos_probability > 0.0:
        reweight_3d(nav, cov, rows, robust_options_of(config))


def track_of(
    vue_id: str,
    config: TrackerConfig,
    rsus: Mapping[str, Rsu],
    health: RsuHealth,
    *,
    record: bool,
) -> StrapdownTrack:
    """A new track; ``record``: for a smoother."""
    track = StrapdownTrack(vue_id, config, rsus, health)
    track.recorder = Recorder() if record else None
    return track


class StrapdownTrack:
    """Estimator of one device in space. Epochs come in stamp order; time is theirs."""

    def __init__(
        self,
        vue_id: str,
        config: TrackerConfig,
        rsus: Mapping[str, Rsu],
        health: RsuHealth | None = None,
    ) -> None:
        self._vue_id = vue_id
        self._config = config
        self._rsus = rsus
        self._health = health or RsuHealth()
        self._sensors = sensors_of(config)
        self._gate = gate_thresholds(config.gate_probability)
        self._gyro = config.gyro_noise_density
        self._robust = robust_options_of(config)
        self._history: History[_State] = History(int(config.history_s * 1e9))
        self.recorder: Recorder | None = None
        """Where what a smoother needs is kept; None: nowhere."""
        self.imu = SampleBuffer()
        self.refused: Counter[str] = Counter()
        """Measurements refused at the door, by reason."""
        self._state = self._fresh()

    def set_config(self, config: TrackerConfig) -> None:
        """Go on with other live parameters."""
        self._config = config

    def _fresh(self) -> _State:
        return _State(StrapdownStart(self._config), NlosRate.of(self._config))

    @property
    def rejected(self) -> Counter[str]:
        """Measurements refused at the door or rejected by the track, by reason."""
        return Counter(total(self.refused, self._state.rejected))

    @property
    def has_estimate(self) -> bool:
        """Whether there was a first fix."""
        return self._state.estimate is not None

    def status_at(self, stamp_ns: int) -> TrackStatus:
        """Status at a later instant, had nothing been heard until then; nothing changes."""
        return self._between(stamp_ns).status

    def waiting(self, stamp_ns: int, missing: str) -> TrackOutput:
        """What is told while there is no estimate, for want of ``missing``."""
        return waiting_output(
            self._config, self._vue_id, stamp_ns, self._state.accepted, self.rejected, missing
        )

    def reset(self) -> None:
        """Forget the estimate and start anew; the counts go on."""
        self._history.clear()
        self.imu = SampleBuffer()
        self._forget()

    def _forget(self) -> None:
        old = self._state
        self._state = self._fresh()
        self._state.accepted, self._state.rejected = old.accepted, old.rejected
        self._state.pose_wait.posed = old.pose_wait.posed

    def step(self, epoch: Epoch) -> TrackOutput:
        """Apply one epoch and report; one without items is only reported of."""
        self._history.remember(epoch, self._state)
        if not epoch.items:
            return self._between(epoch.stamp_ns)
        items: list[Source] = []
        for item in epoch.sorted():
            if isinstance(item, InitialPose):
                self._start_from_pose(epoch.stamp_ns, item)
            elif usable(item):
                items.append(item)  # type: ignore[arg-type]
            else:
                self._state.rejected["unsupported_fields"] += 1
        estimate = self._state.estimate
        if estimate is not None:
            silent_s = (epoch.stamp_ns - self._state.last_accepted_ns) * 1e-9
            if silent_s > self._config.max_gap_s:
                self._forget()
        applied = self._apply(epoch.stamp_ns, items)
        self._record()
        return self._report(self._state.estimate, applied)

    def _between(self, stamp_ns: int) -> TrackOutput:
        """Report of an instant between epochs; nothing changes."""
        estimate = self._state.estimate
        if estimate is not None:
            estimate = estimate.copy()
            self._advance(estimate, stamp_ns, None)
        return self._report(estimate, EpochResult(stamp_ns))

    def revise(self, late: list[tuple[int, Item]]) -> tuple[list[Epoch], TrackOutput]:
        """Go back to the oldest of the late items and apply all epochs since then once more; the
        epochs that are new, and the report of the newest."""
        epochs, state = self._history.go_back(late[0][0])
        self._state = state or self._state
        if self.recorder is not None:
            estimate = self._state.estimate
            self.recorder.go_back(estimate.stamp_ns if estimate else epochs[0].stamp_ns - 1)
        made = [merge(epochs, stamp_ns, item) for stamp_ns, item in late]
        self._health.rewind(self._vue_id, epochs[0].stamp_ns)
        results = [self.step(epoch) for epoch in epochs]
        return [epoch for epoch in made if epoch is not None], replace(results[-1], revised=True)

    # measurements

    def _apply(self, stamp_ns: int, items: list[Source]) -> EpochResult:
        watched: list[RsuMeasurement] = []
        if self._config.isolate_rsus:
            items, watched = without_excluded(
                self._health, stamp_ns, items, lambda item: self._agrees(stamp_ns, item)
            )
            self._state.rejected.update(["isolated_rsu"] * len(watched))
        epoch_rows = epoch_rows_3d(items, self._rsus, self._state.biases) if items else None
        estimate = self._state.estimate
        if estimate is None:
            return EpochResult(
                stamp_ns, sources=self._try_start(stamp_ns, epoch_rows) if epoch_rows else ()
            )
        self._grow(estimate)
        self._advance(estimate, stamp_ns, self.recorder)
        for item in watched:
            rows, innovations = self._fit_alone(estimate, item)
            observe_excluded(self._health, self._vue_id, stamp_ns, rows, innovations, self._gate)
        return (
            self._update(stamp_ns, estimate, epoch_rows) if epoch_rows else EpochResult(stamp_ns)
        )

    def _fit_alone(self, estimate: _Estimate, item: RsuMeasurement) -> tuple[EpochRows, Array]:
        """Rows of one measurement without bias states, and its innovations at ``estimate`` with
        their sd (m, 2)."""
        rows = epoch_rows_3d([item], self._rsus, None)
        innovations = innovations_with_sd_3d(rows.rows, estimate.nav, estimate.cov)
        widen(innovations, rows.rows, self._rsus[item.rsu_id])
        return rows, innovations

    def _agrees(self, stamp_ns: int, item: RsuMeasurement) -> bool:
        """Whether a measurement alone agrees with the prediction; without one none does."""
        if self._state.estimate is None:
            return False
        predicted = self._state.estimate.copy()
        self._grow(predicted)
        self._advance(predicted, stamp_ns, None)
        return fits(self._fit_alone(predicted, item)[1], self._gate)

    def _update(self, stamp_ns: int, estimate: _Estimate, epoch_rows: EpochRows) -> EpochResult:
        state, nav, cov = self._state, estimate.nav, estimate.cov
        state.nlos_rate.expect(epoch_rows)
        self._reweight(epoch_rows, nav, cov)
        state.nlos_rate.learn(epoch_rows)
        innovations = innovations_with_sd_3d(epoch_rows.rows, nav, cov)
        accepted = np.zeros(len(epoch_rows.items))
        nis, dof = correct(nav, cov, epoch_rows.rows, self._gate, accepted)
        taken = accepted.tolist()
        refused = taken.count(0.0)
        if refused:
            state.rejected["gate"] += refused
        state.nis_window.add(*with_refused(epoch_rows, taken, self._gate, nis, dof))
        if self._config.isolate_rsus:
            epoch = FittedEpoch(
                stamp_ns, self._vue_id, epoch_rows.items, epoch_rows.rows, innovations, taken
            )
            self._health.hear(epoch)
        sources: tuple[str, ...] = ()
        if dof > 0:
            sources = self._note_accepted(stamp_ns, epoch_rows, accepted)
            state.has_clock = state.has_clock or epoch_rows.has_time
        else:
            doubt_standstill(estimate.memory)
        applied = EpochResult(stamp_ns, nis, dof, sources)
        if mostly_accepted(epoch_rows, taken):
            state.rejected_in_row = 0
            return applied
        state.rejected_in_row += 1
        if state.rejected_in_row >= self._config.max_rejected_epochs:
            state.rejected["track_lost"] += 1
            self._forget()
        return applied

    def _reweight(self, epoch_rows: EpochRows, nav: Array, cov: Array) -> None:
        """Re-weight the rows of an epoch as the robust options say."""
        if self._robust.kind != Robust.NONE or self._robust.nlos_probability > 0.0:
            reweight_3d(nav, cov, epoch_rows.rows, self._robust)

    def _note_accepted(
        self, stamp_ns: int, epoch_rows: EpochRows, accepted: Array
    ) -> tuple[str, ...]:
        state, sources = self._state, []
        for item, taken in zip(epoch_rows.items, accepted, strict=True):
            if not taken:
                continue
            if isinstance(item, RsuMeasurement):
                state.biases.accepted(self._rsus[item.rsu_id], item)
            sources.append(item.rsu_id if isinstance(item, RsuMeasurement) else item.source)
        state.accepted += len(sources)
        state.last_accepted_ns = stamp_ns
        return tuple(sources)

    # start and motion

    def _start_from_pose(self, stamp_ns: int, pose: InitialPose) -> None:
        self._forget()
        self._state.pose_wait.posed = True
        cov = pose.cov + np.diag([0.0, 0.0, _POSE_VAR_MIN if pose.cov[2, 2] == 0.0 else 0.0])
        self._state.start.add_fix(stamp_ns, pose.position.copy(), cov, np.zeros(3))

    def _try_start(self, stamp_ns: int, epoch_rows: EpochRows) -> tuple[str, ...]:
        state = self._state
        if state.pose_wait.at(self._config, stamp_ns, tracked=state.accepted > 0):
            state.rejected["no_initial_pose"] += len(epoch_rows.items)
            return ()
        rsus = [item for item in epoch_rows.items if isinstance(item, RsuMeasurement)]
        if not rsus:
            return ()
        rows = epoch_rows.rows[epoch_rows.rows[:, KIND] != Kind.BODY_VELOCITY]
        rows[:, VARIANCE] += replace(epoch_rows, rows=rows).slow_variance(state.biases)
        state.start.add_rows(stamp_ns, rows, np.array(rsus[0].lever_arm))
        found = state.start.solve(self.imu)
        if found is None or found[0] != stamp_ns:
            return ()
        nav, cov = with_clock(self._config, *found[1:])
        state.estimate = _Estimate(stamp_ns, nav, cov, np.zeros(MEMORY))
        self._grow(state.estimate)
        self._set_clock(state.estimate, rows)
        if self.recorder is not None:
            self.recorder.begin(stamp_ns, state.estimate.nav, state.estimate.cov)
        return self._note_accepted(stamp_ns, epoch_rows, np.ones(len(epoch_rows.items)))

    def _missing(self) -> str:
        """What is missing for a start."""
        state = self._state
        return state.pose_wait.missing(self._config, self._vue_id, state.start.missing)

    def _set_clock(self, estimate: _Estimate, rows: Array) -> None:
        """Read the clock's offset off one time of arrival: the place is in the start already."""
        times = rows[rows[:, KIND] == Kind.TOA][:1].copy()
        if len(times):
            self._state.has_clock = True
            times[:, GROUP] = 0
            if self._config.nlos_probability > 0.0:
                times[:, VARIANCE] += self._config.nlos_mean_excess_m**2
            correct(estimate.nav, estimate.cov, times, np.full(2, np.inf), np.zeros(1))

    def _grow(self, estimate: _Estimate) -> None:
        sd = np.array(self._state.biases.sd)
        estimate.nav, estimate.cov = augmented_3d(estimate.nav, estimate.cov, sd)

    def _advance(self, estimate: _Estimate, stamp_ns: int, recorder: Recorder | None) -> None:
        """Move ``estimate`` to ``stamp_ns``; it has states for all biases heard of."""
        if stamp_ns <= estimate.stamp_ns:
            return
        imu = Imu(*self.imu.between(estimate.stamp_ns, stamp_ns))
        move = advance if recorder is None else recorder.advance
        nav, cov, memory = estimate.nav, estimate.cov, estimate.memory
        move(nav, cov, memory, estimate.stamp_ns, stamp_ns, imu, self._sensors_now())
        estimate.stamp_ns = stamp_ns

    def _sensors_now(self) -> Sensors:
        slow = self._sensors.slow._replace(biases=self._state.biases.arrays())
        return self._sensors._replace(slow=slow)

    # output

    def _record(self) -> None:
        estimate = self._state.estimate
        if self.recorder is not None and estimate is not None:
            rate, sd = self._rate(estimate.stamp_ns), np.array(self._state.biases.sd)
            self.recorder.note(estimate.nav, estimate.cov, rate, sd)

    def _rate(self, stamp_ns: int) -> Array | None:
        """(3,) angular velocity as the newest sample has it."""
        _, rates = self.imu.between(stamp_ns - _RATE_WINDOW_NS, stamp_ns)
        return np.asarray(rates[-1, :3]) if len(rates) else None

    def smoothed(self) -> list[Odometry]:
        """Odometry of all epochs recorded, given all measurements."""
        if self.recorder is None:
            return []
        return [
            odometry_of(i.stamp_ns, self._vue_id, i.nav, i.cov, i.rate, self._gyro)
            for i in self.recorder.smoothed()
        ]

    def _report(self, estimate: _Estimate | None, epoch: EpochResult) -> TrackOutput:
        state, stamp_ns = self._state, epoch.stamp_ns
        position_sd, level, heard_ns = 0.0, -1.0, None
        odometry, clock = None, None
        if estimate is not None:
            heard_ns = state.last_accepted_ns
            position_sd = output.largest_sd(estimate.cov)
            risk, inflation = self._config.integrity_risk, state.nis_window.inflation()
            level = protection_level(estimate.cov[POSITION, POSITION], risk, inflation)
            odometry = odometry_of(
                stamp_ns,
                self._vue_id,
                estimate.nav,
                estimate.cov,
                self._rate(stamp_ns),
                self._gyro,
            )
            if state.has_clock:
                mean = estimate.nav[NAV_CLOCK_DRIFT]
                cov = estimate.cov[ERR_CLOCK_DRIFT, ERR_CLOCK_DRIFT]
                clock = output.clock_state(stamp_ns, self._vue_id, mean, cov)
        status = track_status(
            self._config,
            self._vue_id,
            epoch,
            state.accepted,
            total(self.refused, state.rejected),
            EstimateStatus(
                heard_ns=heard_ns,
                missing=self._missing(),
                position_sd_m=position_sd,
                level_m=level,
                refused_in_row=state.rejected_in_row,
            ),
        )
        return TrackOutput(odometry, clock, status)
