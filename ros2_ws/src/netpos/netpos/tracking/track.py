"""One device: predict, gate, update, recover, report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from netpos.filters import ekf
from netpos.filters.measurement import BIAS, COMMON, KIND, Kind, linear_rows, rsu_rows, speed_row
from netpos.filters.motion import SPEED_OF_LIGHT_MPS, ProcessNoise, process_noise, transition
from netpos.messages.values import (
    Array,
    ClockState,
    GroundSpeed,
    InitialPose,
    Odometry,
    RsuMeasurement,
    TrackState,
    TrackStatus,
    Velocity,
)
from netpos.tracking import output
from netpos.tracking.config import FILTER_ITERATIONS, TrackerConfig
from netpos.tracking.initialise import Initialiser
from netpos.tracking.rsus import BiasStates, Rsu
from netpos.tracking.sequencer import Epoch

_MAX_DOF = 12
_VELOCITY_H = np.eye(2, 6, k=2)


@dataclass(frozen=True, slots=True)
class TrackOutput:
    """What a track says at one epoch; odometry is None until the first fix, clock until the first
    TOA."""

    odometry: Odometry | None
    clock: ClockState | None
    status: TrackStatus


@dataclass(slots=True)
class _Estimate:
    stamp_ns: int
    mean: Array
    cov: Array


@dataclass(frozen=True, slots=True)
class _Batch:
    """Rows of one epoch and, per group, the item they come from."""

    rows: Array
    items: tuple[RsuMeasurement | Velocity | GroundSpeed, ...]


def gate_thresholds(probability: float) -> Array:
    """Largest accepted squared Mahalanobis distance for 0, 1, ... degrees of freedom (chi-square
    quantiles)."""
    thresholds: Array = np.append(0.0, chi2.ppf(probability, np.arange(1, _MAX_DOF + 1)))
    return thresholds


class Track:
    """Estimator of one device. Epochs come in stamp order; time is theirs."""

    def __init__(self, vue_id: str, config: TrackerConfig, rsus: Mapping[str, Rsu]) -> None:
        self._vue_id = vue_id
        self._config = config
        self._rsus = rsus
        self._gate = gate_thresholds(config.gate_probability)
        self._noise_kind = int(ProcessNoise[config.process_noise.upper()])
        self.rejected: Counter[str] = Counter()
        self._accepted = 0
        self.reset()

    def reset(self) -> None:
        """Forget the estimate and start anew; the counts of accepted and rejected measurements go
        on."""
        self._estimate: _Estimate | None = None
        self._biases = BiasStates()
        self._initialiser = Initialiser(self._config)
        self._yaw = 0.0
        self._has_clock = False
        self._rejected_in_row = 0
        self._last_accepted_ns = 0

    def step(self, epoch: Epoch) -> TrackOutput:
        """Apply one epoch and report."""
        items = []
        for item in epoch.sorted():
            if isinstance(item, InitialPose):
                self._start_from_pose(epoch.stamp_ns, item)
            else:
                items.append(item)
        batch = self._batch(items)
        nis, dof = 0.0, 0
        sources: tuple[str, ...] = ()
        if batch is not None:
            if self._estimate is not None and self._gap_s(epoch.stamp_ns) > self._config.max_gap_s:
                self.reset()
                batch = self._batch(items)
                assert batch is not None
            if self._estimate is None:
                sources = self._try_first_fix(epoch.stamp_ns, batch)
            else:
                nis, dof, sources = self._update(epoch.stamp_ns, batch)
        return self._report(epoch.stamp_ns, nis, dof, sources)

    def _gap_s(self, stamp_ns: int) -> float:
        assert self._estimate is not None
        return (stamp_ns - self._estimate.stamp_ns) * 1e-9

    def _batch(self, items: list[RsuMeasurement | Velocity | GroundSpeed]) -> _Batch | None:
        blocks = []
        for group, item in enumerate(items):
            if isinstance(item, RsuMeasurement):
                rsu = self._rsus[item.rsu_id]
                coupling = self._biases.coupling(rsu, item)
                blocks.append(rsu_rows(item, rsu.info, rsu.axes, group, coupling))
            elif isinstance(item, Velocity):
                blocks.append(linear_rows(item.velocity, item.cov, _VELOCITY_H, group))
            else:
                blocks.append(speed_row(item.speed_mps, item.speed_var, group))
        return _Batch(np.vstack(blocks), tuple(items)) if blocks else None

    def _start_from_pose(self, stamp_ns: int, pose: InitialPose) -> None:
        """Initial state and covariance: fokin2020:eq.32, 33."""
        self.reset()
        cfg, c = self._config, SPEED_OF_LIGHT_MPS
        mean = np.zeros(6)
        mean[:2] = pose.position[:2]
        mean[5] = c * cfg.clock_drift_mean
        sd = [1.0, 1.0, *([cfg.initial_speed_sd_mps] * 2)]
        cov = np.diag(np.array([*sd, c * cfg.clock_offset_sd_s, c * cfg.clock_drift_sd]) ** 2)
        cov[:2, :2] = pose.cov[:2, :2]
        self._estimate = _Estimate(stamp_ns, mean, cov)
        self._last_accepted_ns = stamp_ns

    def _try_first_fix(self, stamp_ns: int, batch: _Batch) -> tuple[str, ...]:
        if self._config.require_initial_pose and not self._accepted:
            self.rejected["no_initial_pose"] += len(batch.items)
            return ()
        heard = tuple(self._rsus[i.rsu_id] for i in batch.items if isinstance(i, RsuMeasurement))
        bias_var = np.zeros(len(batch.rows))
        for column in (BIAS, COMMON):
            for i, index in enumerate(batch.rows[:, column].astype(int)):
                bias_var[i] += self._biases.sd[index - 6] ** 2 if index >= 0 else 0.0
        self._initialiser.add(stamp_ns, batch.rows, bias_var, heard)
        solution = self._initialiser.solve()
        if solution is None:
            return ()
        self._estimate = _Estimate(stamp_ns, *solution)
        self._has_clock = bool((batch.rows[:, KIND] == Kind.TOA).any())
        return self._note_accepted(stamp_ns, batch, np.ones(len(batch.items)))

    def _update(self, stamp_ns: int, batch: _Batch) -> tuple[float, int, tuple[str, ...]]:
        estimate = self._predict(stamp_ns)
        if self._rejected_in_row >= self._config.inflate_after_epochs:
            estimate = self._opened(estimate, self._config.initial_speed_sd_mps)
        result = self._gated_update(estimate, batch)
        if not result[2].all() and self._config.manoeuvre_speed_sd_mps > 0.0:
            opened = self._opened(estimate, self._config.manoeuvre_speed_sd_mps)
            after_manoeuvre = self._gated_update(opened, batch)
            if after_manoeuvre[2].sum() > result[2].sum():
                result = after_manoeuvre
        mean, cov, accepted, nis, dof = result
        if not accepted.any():
            cov = self._predict(stamp_ns).cov
        self._estimate = _Estimate(stamp_ns, mean, cov)
        refused = int(len(batch.items) - accepted.sum())
        if refused:
            self.rejected["gate"] += refused
        if not accepted.any():
            self._rejected_in_row += 1
            if self._rejected_in_row >= self._config.max_rejected_epochs:
                self.rejected["track_lost"] += 1
                self.reset()
            return nis, dof, ()
        self._rejected_in_row = 0
        self._has_clock |= bool((batch.rows[:, KIND] == Kind.TOA).any())
        return nis, dof, self._note_accepted(stamp_ns, batch, accepted)

    def _gated_update(
        self, estimate: _Estimate, batch: _Batch
    ) -> tuple[Array, Array, Array, float, int]:
        return ekf.update(  # type: ignore[no-any-return]
            estimate.mean,
            estimate.cov,
            batch.rows,
            self._config.device_height_m,
            self._gate,
            FILTER_ITERATIONS[self._config.filter],
        )

    def _opened(self, estimate: _Estimate, sd: float) -> _Estimate:
        """The estimate as if the velocity had changed by ``sd`` [m/s] since the last update."""
        elapsed = (estimate.stamp_ns - self._last_accepted_ns) * 1e-9
        cov = estimate.cov.copy()
        for p in range(2):
            cov[p, p] += (sd * elapsed) ** 2
            cov[p, p + 2] += sd * sd * elapsed
            cov[p + 2, p] += sd * sd * elapsed
            cov[p + 2, p + 2] += sd * sd
        return _Estimate(estimate.stamp_ns, estimate.mean, cov)

    def _note_accepted(self, stamp_ns: int, batch: _Batch, accepted: Array) -> tuple[str, ...]:
        sources = []
        for item, taken in zip(batch.items, accepted, strict=True):
            if taken:
                self._accepted += 1
                if isinstance(item, RsuMeasurement):
                    self._biases.accepted(self._rsus[item.rsu_id], item)
                    sources.append(item.rsu_id)
                else:
                    sources.append(item.source)
        self._last_accepted_ns = stamp_ns
        return tuple(sources)

    def _predict(self, stamp_ns: int) -> _Estimate:
        """Estimate at ``stamp_ns``, with the biases heard of since the last epoch appended."""
        assert self._estimate is not None
        cfg, c = self._config, SPEED_OF_LIGHT_MPS
        mean, cov = self._estimate.mean, self._estimate.cov
        sd, tau = np.array(self._biases.sd), np.array(self._biases.tau_s)
        new = sd[mean.size - 6 :]
        if new.size:
            mean = np.append(mean, np.zeros(new.size))
            grown = np.zeros((mean.size, mean.size))
            grown[: len(cov), : len(cov)] = cov
            grown[len(cov) :, len(cov) :] = np.diag(new**2)
            cov = grown
        dt = self._gap_s(stamp_ns)
        if dt <= 0.0:
            return _Estimate(stamp_ns, mean, cov)
        white = cfg.process_noise == "white_acceleration"
        Q = process_noise(
            self._noise_kind,
            dt,
            cfg.accel_sd_mps2 if white else cfg.accel_density_mps2_sqrthz,
            cfg.velocity_step_sd_mps,
            c * cfg.clock_white_density,
            c * cfg.clock_walk_density,
            c * cfg.drift_step_sd,
            sd,
            tau,
        )
        return _Estimate(stamp_ns, *ekf.predict(mean, cov, transition(mean.size, dt, tau), Q))

    def _report(
        self, stamp_ns: int, nis: float, dof: int, sources: tuple[str, ...]
    ) -> TrackOutput:
        position_sd = 0.0
        if self._estimate is not None:
            self._estimate = self._predict(stamp_ns)
            cov = self._estimate.cov
            position_sd = math.sqrt(max(float(np.linalg.eigvalsh(cov[:2, :2])[-1]), 0.0))
        status = TrackStatus(
            stamp_ns=stamp_ns,
            vue_id=self._vue_id,
            state=self._state(stamp_ns, position_sd),
            nis=nis,
            nis_dof=dof,
            used=len(sources),
            accepted=self._accepted,
            rejected=dict(self.rejected),
            sources=sources,
            position_sd_m=position_sd,
        )
        if self._estimate is None:
            return TrackOutput(None, None, status)
        mean, cov = self._estimate.mean, self._estimate.cov
        self._yaw, yaw_var = output.heading(mean, cov, self._yaw)
        height = self._config.device_height_m
        odometry = output.odometry(stamp_ns, self._vue_id, mean, cov, height, self._yaw, yaw_var)
        clock = None
        if self._has_clock:
            clock = output.clock_state(stamp_ns, self._vue_id, mean, cov)
        return TrackOutput(odometry, clock, status)

    def _state(self, stamp_ns: int, position_sd: float) -> TrackState:
        if self._estimate is None:
            return TrackState.WAITING
        if stamp_ns - self._last_accepted_ns > self._config.coast_after_s * 1e9:
            return TrackState.COASTING
        if position_sd > self._config.initial_position_sd_max_m:
            return TrackState.INITIALISING
        return TrackState.TRACKING
