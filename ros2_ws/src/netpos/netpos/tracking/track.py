"""One device: order, first fix, estimate, recovery, report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.measurement import VARIANCE
from netpos.estimation.protection import FusedEpoch
from netpos.estimation.state import N_CORE, POSITION, VELOCITY
from netpos.messages.values import (
    Array,
    InitialPose,
    Odometry,
    RsuErrors,
    RsuMeasurement,
    TrackStatus,
    Velocity,
)
from netpos.tracking import estimates, output
from netpos.tracking.adaptive_process_noise import AdaptiveProcessNoise
from netpos.tracking.config import TrackerConfig
from netpos.tracking.epoch_rows import (
    EpochRows,
    Source,
    epoch_rows_of,
    mostly_accepted,
    velocity_inflation,
)
from netpos.tracking.estimates import Estimate, KalmanEstimate
from netpos.tracking.fit import (
    fits,
    innovations_and_level,
    innovations_with_sd,
    observe_excluded,
    widen,
    with_refused,
    without_excluded,
)
from netpos.tracking.health import RsuHealth
from netpos.tracking.history import History, merge
from netpos.tracking.imu_buffer import ImuBuffer
from netpos.tracking.initialise import Initialiser, with_heading
from netpos.tracking.learning import LearnedErrors
from netpos.tracking.models import heading_index, initial_extra_sd, options_of, pose_state
from netpos.tracking.networks.secondary import Secondary
from netpos.tracking.nlos_rate import NlosRate
from netpos.tracking.observations import FittedEpoch
from netpos.tracking.phase_start import PhaseStart, corrections, with_sectors
from netpos.tracking.report import (
    LEVEL_MAX_M,
    EpochResult,
    EstimateStatus,
    TrackOutput,
    total,
    track_status,
    waiting_output,
)
from netpos.tracking.rsus import BiasStates, Rsu
from netpos.tracking.sequencer import Epoch, Item
from netpos.tracking.shared_errors import SharedErrors
from netpos.tracking.smoothing import FixedLag, Posterior, Smoother
from netpos.tracking.snapshot import TrackSnapshot
from netpos.tracking.unnoticed import level_of_epochs

_IMU_HOLE_S = 0.05
_RECENT = 5  # epochs
_POSE_SD_MIN_M = 1.0  # an initial pose is no surer than this when it is weighed
_BLIND_GYRO = 1.0  # rad/s/sqrt(Hz): what the heading does while the IMU is silent


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
        self._config = config
        self._rsus = rsus
        self._health = health or RsuHealth()
        self._shared, self._lives = shared, 0
        self._options = options_of(config)
        self._gate = self._options.gate_nis
        self._extra_sd = initial_extra_sd(config)
        self._heading = heading_index(config)
        self._use_imu, self._calibrates_steps = config.use_imu, config.calibrates_steps
        self._secondary = Secondary(vue_id, config) if config.network else None
        self._history: History[TrackSnapshot] = History(int(config.history_s * 1e9))
        self._fixed_lag = FixedLag(vue_id, config) if config.fixed_lag_s > 0.0 else None
        self.posteriors: list[Posterior] | None = None
        """Where every epoch's posterior is kept, for a smoother; None: nowhere."""
        self.imu = ImuBuffer()
        self.refused: Counter[str] = Counter()
        """Measurements refused at the door, by reason."""
        self._errors: tuple[RsuErrors, ...] = ()
        self._state = self._fresh()

    @property
    def is_by_sectors(self) -> bool:
        """Whether the estimate is a bank of filters, one for each sector of a phase."""
        estimate = self._state.estimate
        return estimate is not None and not isinstance(estimate, KalmanEstimate)

    def set_config(self, config: TrackerConfig) -> None:
        """Go on with other live parameters. Epochs that are over keep what they were applied with,
        unless a measurement comes late that is older than the change."""
        self._history.mark(self._state)
        self._config = config
        self._options = options_of(config)
        self._gate = self._options.gate_nis
        for state in (self._state, *self._history.states()):
            state.set_config(config)

    def _fresh(self) -> TrackSnapshot:
        self._lives += 1
        return TrackSnapshot(
            BiasStates(
                N_CORE + self._extra_sd.size,
                self._config.step_errors,
                LearnedErrors(self._shared, (self._vue_id, self._lives))
                if self._config.learn_errors
                else None,
            ),
            Initialiser(self._config),
            NlosRate.of(self._config),
            PhaseStart(self._config),
            AdaptiveProcessNoise(self._config),
        )

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
        kept = self._state
        self._state = kept.copy()
        try:
            return self._report(EpochResult(stamp_ns)).status
        finally:
            self._state = kept

    def waiting(self, stamp_ns: int, missing: str) -> TrackOutput:
        """What is told while there is no estimate, for want of ``missing``."""
        return waiting_output(
            self._config, self._vue_id, stamp_ns, self._state.accepted, self.rejected, missing
        )

    def reset(self) -> None:
        """Forget the estimate and start anew; the counts of accepted and rejected measurements go
        on."""
        self._history.clear()
        self.imu = ImuBuffer()
        self._forget()

    def _forget(self) -> None:
        old = self._state
        self._state = self._fresh()
        self._state.accepted, self._state.rejected = old.accepted, old.rejected
        self._state.segment = old.segment + 1
        self._state.pose_wait.posed = old.pose_wait.posed

    def step(self, epoch: Epoch) -> TrackOutput:
        """Apply one epoch and report."""
        self._history.remember(epoch, self._state)
        self._errors = ()
        items: list[Source] = []
        for item in epoch.sorted():
            if isinstance(item, InitialPose):
                self._start_from_pose(epoch.stamp_ns, item)
            else:
                items.append(item)
        applied = EpochResult(epoch.stamp_ns)
        if items:
            estimate = self._state.estimate
            if estimate is not None:
                gap_s = (epoch.stamp_ns - estimate.stamp_ns) * 1e-9
                if gap_s > self._config.max_gap_s:
                    self._forget()
            items, watched = self._sorted_out(epoch.stamp_ns, items)
            if items:
                applied = self._apply(epoch.stamp_ns, items)
            if watched:
                self._watch(epoch.stamp_ns, watched)
        return self._smooth(self._report(applied))

    def _smooth(self, result: TrackOutput) -> TrackOutput:
        """Keep the posterior and add what the smoother makes of it."""
        state, estimate = self._state, self._state.estimate
        unkept = self._fixed_lag is None and self.posteriors is None
        if estimate is None or unkept or estimate.modes:
            return result
        posterior = Posterior.of(estimate, state.segment, state.bias)
        if self.posteriors is not None:
            self.posteriors.append(posterior)
        if self._fixed_lag is None:
            return result
        return replace(result, smoothed=tuple(self._fixed_lag.add(posterior)))

    def smoothed(self) -> list[Odometry]:
        """Odometry of every posterior kept, given all measurements."""
        return Smoother(self._vue_id, self._config).interval(self.posteriors or [])

    def revise(self, late: list[tuple[int, Item]]) -> tuple[list[Epoch], TrackOutput]:
        """Go back to the oldest of the late items and apply all epochs since then once more.

        late : stamps within the history and items, oldest first
        Returns the epochs that are new, and the report of the newest epoch.
        """
        epochs, state = self._history.go_back(late[0][0])
        self._state = state or self._state
        made = [merge(epochs, stamp_ns, item) for stamp_ns, item in late]
        self._health.rewind(self._vue_id, epochs[0].stamp_ns)
        if self._shared is not None:
            self._shared.rewind(self._vue_id, epochs[0].stamp_ns)
        smoothed: list[Odometry] = []
        errors: tuple[RsuErrors, ...] = ()
        for epoch in epochs:
            result = self.step(epoch)
            smoothed += result.smoothed
            errors = result.errors or errors
        new = [epoch for epoch in made if epoch is not None]
        return new, replace(result, revised=True, smoothed=tuple(smoothed), errors=errors)

    def _apply(self, stamp_ns: int, items: list[Source]) -> EpochResult:
        epoch_rows = self._epoch_rows(items)
        if self._state.estimate is None:
            return EpochResult(stamp_ns, sources=self._try_first_fix(stamp_ns, epoch_rows))
        return self._update(stamp_ns, epoch_rows)

    def _sorted_out(
        self, stamp_ns: int, items: list[Source]
    ) -> tuple[list[Source], list[RsuMeasurement]]:
        """What may be fused, and what comes from an excluded RSU and is only looked at."""
        if not self._config.isolate_rsus:
            return items, []
        used, watched = without_excluded(
            self._health, stamp_ns, items, lambda item: self._agrees(stamp_ns, item)
        )
        if watched:
            self._state.rejected["isolated_rsu"] += len(watched)
        return used, watched

    def _epoch_rows(self, items: list[Source]) -> EpochRows:
        biases = self._state.biases
        inflation = velocity_inflation(
            items, self._state.velocity_ns, self._config.velocity_correlation_s
        )
        version = biases.version
        epoch_rows = epoch_rows_of(items, self._rsus, biases, self._heading, inflation)
        if biases.version != version:
            self._state.bias = biases.arrays()
        return epoch_rows

    def _is_excluded(self, stamp_ns: int, mean: Array, cov: Array) -> bool:
        """Whether the newest measurements exclude an initial pose (6,), (6, 6), however sure it
        is of itself."""
        state = self._state
        window = state.initialiser
        if state.estimate is not None:
            if state.rejected_in_row:
                return False
            window = Initialiser(self._config)
            for then_ns, rows in state.recent:
                bias_var = rows.slow_variance(state.biases)
                window.add(then_ns, rows.rows, bias_var, self._heard(rows))
        var = np.diag(cov).copy()
        var[POSITION] = np.maximum(var[POSITION], _POSE_SD_MIN_M**2)
        bound = chi_square_bound(2, 1.0 - self._config.gate_probability)
        return window.excess_cost(stamp_ns, mean, var) > bound

    def _heard(self, epoch_rows: EpochRows) -> tuple[Rsu, ...]:
        """The RSUs of an epoch."""
        return tuple(
            self._rsus[i.rsu_id] for i in epoch_rows.items if isinstance(i, RsuMeasurement)
        )

    def _start_from_pose(self, stamp_ns: int, pose: InitialPose) -> None:
        mean, cov = pose_state(self._config, pose.position[:2], pose.cov[:2, :2])
        if self._is_excluded(stamp_ns, mean, cov):
            self._state.rejected["initialpose"] += 1
            return
        self._forget()
        self._state.pose_wait.posed = True
        if self._heading >= 0:
            self._state.pose = stamp_ns, mean, cov  # the first antennas tell the heading
            return
        self._state.estimate = estimates.start(self._config, stamp_ns, mean, cov)
        self._state.last_accepted_ns = stamp_ns

    def _try_first_fix(self, stamp_ns: int, epoch_rows: EpochRows) -> tuple[str, ...]:
        state = self._state
        if state.pose_wait.at(self._config, stamp_ns, tracked=state.accepted > 0):
            state.rejected["no_initial_pose"] += len(epoch_rows.items)
            return ()
        heard = self._heard(epoch_rows)
        bias_var = epoch_rows.slow_variance(state.biases)
        if state.phase_start.heard(epoch_rows):
            state.estimate = state.phase_start.add(stamp_ns, epoch_rows.rows, bias_var)
            return self._note_accepted(stamp_ns, epoch_rows) if state.estimate is not None else ()
        solution = self._pose_at(stamp_ns)
        if solution is None:
            state.initialiser.add(stamp_ns, epoch_rows.rows, bias_var, heard)
            solution = state.initialiser.solve()
        if solution is None:
            return ()
        if self._heading >= 0:
            rows = epoch_rows.rows.copy()
            rows[:, VARIANCE] += bias_var
            solution = with_heading(*solution, rows, self._config.device_height_m)
            if solution is None:
                state.rejected["heading_open"] += len(epoch_rows.items)
                state.initialiser.missing = (
                    "the heading of the body is open: measure two of its antennas, apart by their"
                    " lever arms"
                )
                return ()
        state.estimate = estimates.start(self._config, stamp_ns, *solution)
        state.has_clock = epoch_rows.has_time
        return self._note_accepted(stamp_ns, epoch_rows)

    def _pose_at(self, stamp_ns: int) -> tuple[Array, Array] | None:
        """The initial pose that waits for its heading, for a device that has moved since; None
        where it is older than the longest gap."""
        if self._state.pose is None:
            return None
        given_ns, mean, cov = self._state.pose
        age_s = (stamp_ns - given_ns) * 1e-9
        if age_s > self._config.max_gap_s:
            return None
        moved = cov.copy()
        moved[POSITION, POSITION] += age_s**2 * cov[VELOCITY, VELOCITY]
        return mean, moved

    def _missing(self) -> str:
        """What is missing for a first fix."""
        state = self._state
        return state.pose_wait.missing(self._config, self._vue_id, state.initialiser.missing)

    def _update(self, stamp_ns: int, epoch_rows: EpochRows) -> EpochResult:
        state = self._state
        state.estimate = with_sectors(self._config, state.estimate, epoch_rows.rows)
        estimate = self._prepare(stamp_ns, epoch_rows.items)
        was_ambiguous = bool(estimate.modes)
        unheard_s = (stamp_ns - state.last_accepted_ns) * 1e-9
        blocked = self._config.nlos_probability > 0.0
        if blocked:
            state.nlos_rate.expect(epoch_rows)
        nis, dof, flags = estimate.step(
            stamp_ns, unheard_s, state.rejected_in_row, epoch_rows.rows, state.bias
        )
        accepted = flags.tolist()
        if blocked:
            state.nlos_rate.learn(epoch_rows)
        if self._secondary is not None:
            state.own = self._secondary.after(
                state.own, stamp_ns, estimate, epoch_rows.rows, state.bias
            )
        state.segment += corrections(estimate, state.rejected)
        # a smoother does not reach across: what it keeps is one Gaussian
        state.segment += bool(estimate.modes) != was_ambiguous
        state.has_clock = state.has_clock or (dof > 0 and epoch_rows.has_time)
        if not self._note_fit(stamp_ns, epoch_rows, flags, accepted, nis, dof):
            state.rejected["diverged"] += 1
            self._forget()
            return EpochResult(stamp_ns)
        self._learn(stamp_ns, epoch_rows.rows, flags)
        refused = accepted.count(0.0)
        if refused:
            state.rejected["gate"] += refused
        sources = self._note_accepted(stamp_ns, epoch_rows, accepted) if dof > 0 else ()
        fitted = not refused or mostly_accepted(epoch_rows, accepted)
        if fitted:
            state.recent = (*state.recent[1 - _RECENT :], (stamp_ns, epoch_rows))
        self._count_rejected(fitted)
        return EpochResult(stamp_ns, nis, dof, sources)

    def _learn(self, stamp_ns: int, rows: Array, accepted: Array) -> None:
        """Learn the errors of the RSUs from an epoch."""
        state = self._state
        estimate = state.estimate
        if state.biases.learned is None or estimate is None or estimate.modes:
            return
        height_m = self._config.device_height_m
        posterior = (estimate.mean, estimate.cov)
        concluded, changes = state.biases.learn(stamp_ns, (rows, accepted), posterior, height_m)
        for change in changes:
            estimate.change_prior(*change)
        state.bias = state.biases.arrays()
        if concluded:
            self._errors = state.biases.errors(
                concluded, estimate.mean, estimate.cov, stamp_ns, self._vue_id
            )

    def _count_rejected(self, accepted: bool) -> None:
        """Count the epochs in a row that did not fit; too many, and the track is lost."""
        state = self._state
        state.rejected_in_row = 0 if accepted else state.rejected_in_row + 1
        if state.rejected_in_row >= self._config.max_rejected_epochs:
            state.rejected["track_lost"] += 1
            self._forget()

    def _prepare(self, stamp_ns: int, items: tuple[Source, ...] = ()) -> Estimate:
        """The estimate with the biases heard of, the IMU up to ``stamp_ns`` and what velocities
        say of its motion, not yet moved."""
        estimate = self._state.estimate
        assert estimate is not None
        if estimate.mean.size < self._state.biases.first + len(self._state.biases.sd):
            estimate.augment(np.append(self._extra_sd, self._state.bias[0]))
        if self._use_imu:
            yaw, speed, uncovered_s = self.imu.increments(estimate.stamp_ns, stamp_ns)
            blind = uncovered_s > _IMU_HOLE_S
            estimate.set_imu_increment(
                yaw, speed, _BLIND_GYRO if blind else self._config.gyro_noise_density
            )
        if self._config.steady_accel_density_mps2_sqrthz > 0.0:
            velocities = (item for item in items if isinstance(item, Velocity))
            density = self._state.process_noise.density(stamp_ns, velocities)
            if density is not None:
                estimate.set_process_noise(density)
        return estimate

    def _note_fit(
        self,
        stamp_ns: int,
        epoch_rows: EpochRows,
        flags: Array,
        accepted: Sequence[float],
        nis: float,
        dof: int,
    ) -> bool:
        """Tell the protection level and the health of the RSUs how the epoch fitted, unless the
        estimate is not sound; ``flags`` (groups,) and ``accepted`` are the same."""
        state, innovations = self._state, np.empty((len(epoch_rows.rows), 2))
        assert state.estimate is not None
        estimate, (prior_mean, prior_cov) = state.estimate, state.estimate.prior
        unheard_s = (stamp_ns - state.last_accepted_ns) * 1e-9
        fused = FusedEpoch(prior_mean, prior_cov, epoch_rows.rows, flags, unheard_s, estimate.mean)
        undetected_m: float = innovations_and_level(
            fused, estimate.cov, self._options, innovations
        )
        if math.isnan(undetected_m):
            return False
        if math.isinf(undetected_m):
            heard = [(then_ns, rows.rows) for then_ns, rows in state.recent]
            undetected_m = level_of_epochs(
                [*heard, (stamp_ns, epoch_rows.rows)],
                stamp_ns,
                (prior_mean, prior_cov),
                estimate.cov,
                self._options,
            )
        state.undetected_m = undetected_m
        nis, dof = with_refused(epoch_rows, accepted, self._gate, nis, dof)
        if math.isfinite(nis):
            state.nis_window.add(nis, dof)
        if self._config.isolate_rsus:
            epoch = FittedEpoch(
                stamp_ns, self._vue_id, epoch_rows.items, epoch_rows.rows, innovations, accepted
            )
            self._health.hear(epoch)
        return True

    def _fit_alone(self, stamp_ns: int, item: RsuMeasurement) -> tuple[EpochRows, Array]:
        """Rows of one measurement without bias states, and its innovations with their sd at the
        prediction (m, 2); there is an estimate."""
        self._predict(stamp_ns)
        estimate = self._state.estimate
        assert estimate is not None
        rows = epoch_rows_of([item], self._rsus, None, self._heading)
        innovations = innovations_with_sd(
            estimate.mean, estimate.cov, rows.rows, self._config.device_height_m
        )
        widen(innovations, rows.rows, self._rsus[item.rsu_id])
        return rows, innovations

    def _agrees(self, stamp_ns: int, item: RsuMeasurement) -> bool:
        """Whether a measurement alone agrees with the prediction; without one none does."""
        if self._state.estimate is None:
            return False
        return fits(self._fit_alone(stamp_ns, item)[1], self._gate)

    def _watch(self, stamp_ns: int, watched: list[RsuMeasurement]) -> None:
        """Compare what is not fused with the estimate."""
        if self._state.estimate is None:
            return
        for item in watched:
            rows, innovations = self._fit_alone(stamp_ns, item)
            observe_excluded(self._health, self._vue_id, stamp_ns, rows, innovations, self._gate)

    def _note_accepted(
        self, stamp_ns: int, epoch_rows: EpochRows, accepted: Sequence[float] | None = None
    ) -> tuple[str, ...]:
        """Count what was ``accepted`` (None: all of it); who sent it."""
        state = self._state
        sources = []
        for i, item in enumerate(epoch_rows.items):
            if accepted is not None and not accepted[i]:
                continue
            if isinstance(item, RsuMeasurement):
                state.biases.accepted(self._rsus[item.rsu_id], item)
                sources.append(item.rsu_id)
            else:
                sources.append(item.source)
                state.velocity_ns[item.source] = item.stamp_ns
        state.accepted += len(sources)
        state.last_accepted_ns = stamp_ns
        return tuple(sources)

    def _predict(self, stamp_ns: int) -> None:
        estimate = self._state.estimate
        if estimate is not None and stamp_ns > estimate.stamp_ns:
            self._prepare(stamp_ns).predict(stamp_ns, self._state.bias)

    def _report(self, epoch: EpochResult) -> TrackOutput:
        self._predict(epoch.stamp_ns)
        state, config = self._state, self._config
        estimate, rejected = state.estimate, total(self.refused, state.rejected)
        if estimate is None:
            open_ = EstimateStatus(missing=self._missing())
            status = track_status(config, self._vue_id, epoch, state.accepted, rejected, open_)
            return TrackOutput(None, None, status, network=config.network)
        mean, cov = estimate.mean, estimate.cov
        odometry, clock, state.yaw, sd_m, radius_m = output.describe(
            epoch.stamp_ns,
            self._vue_id,
            mean,
            cov,
            config.device_height_m,
            state.yaw,
            self._heading,
            config.integrity_risk,
        )
        known = EstimateStatus(
            heard_ns=state.last_accepted_ns,
            position_sd_m=sd_m,
            level_m=self._level(epoch.stamp_ns, estimate, radius_m),
            modes=estimate.modes,
            steps=state.biases.step_calibration(mean, cov) if self._calibrates_steps else None,
            refused_in_row=state.rejected_in_row,
        )
        status = track_status(config, self._vue_id, epoch, state.accepted, rejected, known)
        track = None
        if self._secondary is not None:
            track = self._secondary.track(state.own, state.segment, estimate, state.bias)
        return TrackOutput(
            odometry,
            clock if state.has_clock else None,
            status,
            network=config.network,
            track=track,
            errors=self._errors,
        )

    def _level(self, stamp_ns: int, estimate: Estimate, radius_m: float) -> float:
        """Protection level [m]; ``radius_m``: that of the estimate's Gaussian."""
        state, config = self._state, self._config
        level = state.nis_window.inflation() * radius_m
        unheard_s = (stamp_ns - state.last_accepted_ns) * 1e-9
        moved = state.undetected_m + config.manoeuvre_sd_mps * unheard_s
        level = max(level, min(moved, LEVEL_MAX_M))
        return estimate.radius(level)
