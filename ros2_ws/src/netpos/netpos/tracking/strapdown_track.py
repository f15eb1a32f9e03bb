"""One device in space: the strapdown filter behind the interface of ``track.Track``.

Every range and angle is an update of the error-state filter (tight coupling), position fixes are
the loose one. There is no clock state: a TOA is refused, a two-way range is not.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.filters.error_state import MEMORY, advance, correct, doubt_standstill
from netpos.filters.measurement import GATE_VARIANCE, KIND, VARIANCE, Kind, rsu_rows
from netpos.filters.space import SpaceKind, direction_rows, place_rows
from netpos.messages.values import (
    Array,
    Field,
    GroundSpeed,
    InitialPose,
    Odometry,
    RsuMeasurement,
    TrackStatus,
)
from netpos.tracking import output
from netpos.tracking.config import TrackerConfig
from netpos.tracking.history import History, merge
from netpos.tracking.models import gate_thresholds
from netpos.tracking.protection import NisWindow, protection_level
from netpos.tracking.rsus import Rsu
from netpos.tracking.sequencer import Epoch, Item
from netpos.tracking.smoothing import Posterior
from netpos.tracking.strapdown_engine import compile_kernels
from netpos.tracking.strapdown_models import sensors_of
from netpos.tracking.strapdown_start import SampleBuffer, StrapdownStart
from netpos.tracking.track import TrackOutput

_SCALARS = Field.AZIMUTH | Field.ELEVATION | Field.RANGE
_POSE_VAR_MIN = 1e-4  # an initial pose may leave the height's variance at 0
_RATE_WINDOW_NS = 50_000_000
_GYRO_MEAN_S = 0.01  # of one sample of a usual IMU
_SPEED = int(SpaceKind.BODY_VELOCITY)


@dataclass(slots=True)
class _Estimate:
    stamp_ns: int
    nav: Array
    cov: Array
    memory: Array


@dataclass(slots=True)
class _State:
    """All of a track that changes with an epoch."""

    start: StrapdownStart
    estimate: _Estimate | None = None
    posed: bool = False
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
            e = self.estimate
            twin.estimate = _Estimate(e.stamp_ns, e.nav.copy(), e.cov.copy(), e.memory.copy())
        twin.nis_window = self.nis_window.copy()
        twin.rejected = self.rejected.copy()
        return twin


@dataclass(frozen=True, slots=True)
class _Block:
    """Rows of one item; ``lever`` (3,) of its antenna, ``source`` who sent it."""

    rows: Array
    lever: Array
    source: str


def warm_up(config: TrackerConfig) -> None:
    """Compile, or load, the kernels before the first measurement."""
    compile_kernels(sensors_of(config))


class StrapdownTrack:
    """Estimator of one device in space. Epochs come in stamp order; time is theirs."""

    def __init__(self, vue_id: str, config: TrackerConfig, rsus: Mapping[str, Rsu]) -> None:
        self._vue_id = vue_id
        self._config = config
        self._rsus = rsus
        self._sensors = sensors_of(config)
        self._gate = gate_thresholds(config.gate_probability)
        self._history: History[_State] = History(int(config.history_s * 1e9))
        self.posteriors: list[Posterior] | None = None
        """Always None: there is no smoother."""
        self.imu = SampleBuffer()
        self.refused: Counter[str] = Counter()
        """Measurements refused at the door, by reason."""
        self._state = _State(StrapdownStart(config))

    @property
    def rejected(self) -> Counter[str]:
        """Measurements refused at the door or rejected by the track, by reason."""
        return self.refused + self._state.rejected

    def reset(self) -> None:
        """Forget the estimate and start anew; the counts go on."""
        self._history.clear()
        self.imu = SampleBuffer()
        self._forget()

    def _forget(self) -> None:
        old = self._state
        self._state = _State(StrapdownStart(self._config))
        self._state.accepted, self._state.rejected = old.accepted, old.rejected

    def step(self, epoch: Epoch) -> TrackOutput:
        """Apply one epoch and report."""
        self._history.remember(epoch, self._state)
        blocks: list[_Block] = []
        for item in epoch.sorted():
            if isinstance(item, InitialPose):
                self._start_from_pose(epoch.stamp_ns, item)
            else:
                block = self._block(item, len(blocks))
                if block is not None:
                    blocks.append(block)
        estimate = self._state.estimate
        if estimate is not None:
            silent_s = (epoch.stamp_ns - self._state.last_accepted_ns) * 1e-9
            if silent_s > self._config.max_gap_s:
                self._forget()
        nis, dof = 0.0, 0
        sources: tuple[str, ...] = ()
        if self._state.estimate is None:
            sources = self._try_start(epoch.stamp_ns, blocks)
        else:
            self._advance(epoch.stamp_ns)
            if blocks:
                nis, dof, sources = self._update(epoch.stamp_ns, blocks)
        return self._report(epoch.stamp_ns, nis, dof, sources)

    def revise(self, late: list[tuple[int, Item]]) -> tuple[list[Epoch], TrackOutput]:
        """Go back to the oldest of the late items and apply all epochs since then once more; the
        epochs that are new, and the report of the newest."""
        epochs, state = self._history.go_back(late[0][0])
        self._state = state or self._state
        made = [merge(epochs, stamp_ns, item) for stamp_ns, item in late]
        results = [self.step(epoch) for epoch in epochs]
        return [epoch for epoch in made if epoch is not None], replace(results[-1], revised=True)

    # measurements

    def _block(self, item: Item, group: int) -> _Block | None:
        if isinstance(item, GroundSpeed):
            ahead, value = np.array([[1.0, 0.0, 0.0]]), np.array([item.speed_mps])
            variance = np.array([item.speed_var])
            rows = direction_rows(SpaceKind.BODY_VELOCITY, ahead, value, variance, group)
            return _Block(rows, np.zeros(3), item.source)
        if not isinstance(item, RsuMeasurement):
            self._state.rejected["unsupported_fields"] += 1
            return None
        blocks = []
        if item.fields & _SCALARS:
            rsu = self._rsus[item.rsu_id]
            scalars = replace(item, fields=item.fields & _SCALARS)
            rows = rsu_rows(scalars, rsu.info, rsu.axes, group)
            if not rsu.plain:
                _widen(rows, rsu)
            blocks.append(rows)
        if item.fields & Field.POSITION:
            blocks.append(place_rows(item.position, item.position_cov, item.lever_arm, group))
        if not blocks:
            self._state.rejected["toa_without_clock"] += 1
            return None
        return _Block(np.vstack(blocks), np.array(item.lever_arm), item.rsu_id)

    def _update(self, stamp_ns: int, blocks: list[_Block]) -> tuple[float, int, tuple[str, ...]]:
        state = self._state
        assert state.estimate is not None
        rows = np.vstack([block.rows for block in blocks])
        accepted = np.zeros(len(blocks))
        nis, dof = correct(state.estimate.nav, state.estimate.cov, rows, self._gate, accepted)
        refused = int(len(blocks) - accepted.sum())
        if refused:
            state.rejected["gate"] += refused
        self._note_fit(nis, dof, blocks, accepted)
        if dof > 0:
            state.last_accepted_ns = stamp_ns
        else:
            doubt_standstill(state.estimate.memory)
        sources = tuple(b.source for b, taken in zip(blocks, accepted, strict=True) if taken)
        state.accepted += len(sources)
        if 2 * len(sources) >= len(blocks):
            state.rejected_in_row = 0
            return nis, dof, sources
        state.rejected_in_row += 1
        if state.rejected_in_row >= self._config.max_rejected_epochs:
            state.rejected["track_lost"] += 1
            self._forget()
        return nis, dof, sources

    def _note_fit(self, nis: float, dof: int, blocks: list[_Block], accepted: Array) -> None:
        """Tell the protection level how the epoch fitted, what was refused as at its gate."""
        for block, taken in zip(blocks, accepted, strict=True):
            if not taken:
                size = len(block.rows)
                nis += float(self._gate[min(size, self._gate.size - 1)])
                dof += size
        self._state.nis_window.add(nis, dof)

    # start and motion

    def _start_from_pose(self, stamp_ns: int, pose: InitialPose) -> None:
        self._forget()
        self._state.posed = True
        cov = pose.cov + np.diag([0.0, 0.0, _POSE_VAR_MIN if pose.cov[2, 2] == 0.0 else 0.0])
        self._state.start.add_fix(stamp_ns, pose.position.copy(), cov, np.zeros(3))

    def _try_start(self, stamp_ns: int, blocks: list[_Block]) -> tuple[str, ...]:
        state = self._state
        if self._config.require_initial_pose and not state.posed and not state.accepted:
            state.rejected["no_initial_pose"] += len(blocks)
            return ()
        ranged = [block for block in blocks if (block.rows[:, KIND] != _SPEED).all()]
        if not ranged:
            return ()
        rows = np.vstack([block.rows for block in ranged])
        state.start.add_rows(stamp_ns, rows, ranged[0].lever)
        found = state.start.solve(self.imu)
        if found is None or found[0] != stamp_ns:
            return ()
        state.estimate = _Estimate(*found, np.zeros(MEMORY))
        state.last_accepted_ns = stamp_ns
        state.accepted += len(ranged)
        return tuple(block.source for block in ranged)

    def _advance(self, stamp_ns: int) -> None:
        estimate = self._state.estimate
        if estimate is None or stamp_ns <= estimate.stamp_ns:
            return
        stamps, rates = self.imu.between(estimate.stamp_ns, stamp_ns)
        advance(
            estimate.nav,
            estimate.cov,
            estimate.memory,
            estimate.stamp_ns,
            stamp_ns,
            stamps,
            rates,
            self._sensors.noise,
            self._sensors.earth,
            self._sensors.constraints,
        )
        estimate.stamp_ns = stamp_ns

    # output

    def _report(
        self, stamp_ns: int, nis: float, dof: int, sources: tuple[str, ...]
    ) -> TrackOutput:
        state, estimate = self._state, self._state.estimate
        position_sd, level, heard_ns = 0.0, -1.0, None
        if estimate is not None:
            heard_ns = state.last_accepted_ns
            position_sd = output.largest_sd(estimate.cov)
            risk, inflation = self._config.integrity_risk, state.nis_window.inflation()
            level = protection_level(estimate.cov[:2, :2], risk, inflation)
        status = TrackStatus(
            stamp_ns=stamp_ns,
            vue_id=self._vue_id,
            state=output.track_state(self._config, stamp_ns, heard_ns, position_sd),
            nis=nis,
            nis_dof=dof,
            used=len(sources),
            accepted=state.accepted,
            rejected=dict(self.rejected),
            sources=sources,
            position_sd_m=position_sd,
            protection_level_m=level,
        )
        odometry = None if estimate is None else self._odometry(estimate)
        return TrackOutput(odometry, None, status)

    def _odometry(self, estimate: _Estimate) -> Odometry:
        stamp = estimate.stamp_ns
        _, rates = self.imu.between(stamp - _RATE_WINDOW_NS, stamp)
        rate = rates[-1, :3] - estimate.nav[13:] if len(rates) else np.zeros(3)
        return odometry_of(stamp, self._vue_id, estimate.nav, estimate.cov, rate,
                           self._config.gyro_noise_density)  # fmt: skip


def _widen(rows: Array, rsu: Rsu) -> None:
    """Slow errors an RSU declares count as noise here: there are no states for them."""
    for row in rows:
        kind = Kind(int(row[KIND]))
        common = rsu.info.common_range_bias_sd_m if kind is Kind.RANGE else 0.0
        extra = rsu.bias_sd(kind) ** 2 + common**2
        row[VARIANCE] += extra
        row[GATE_VARIANCE] += extra


def odometry_of(
    stamp_ns: int, vue_id: str, nav: Array, cov: Array, rate: Array, gyro_density: float
) -> Odometry:
    """Odometry of a navigation state (NAV,): pose in map, twist in base_link.

    cov : (ERR, ERR); rate : (3,) angular velocity in base_link [rad/s], gyro_density : its noise
    """
    C = Rotation.from_quat(nav[6:10]).as_matrix()
    v = nav[3:6]
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    pose = np.r_[0:3, 6:9]
    J = np.hstack([C.T, C.T @ cross])  # of C' v for errors of velocity and attitude
    twist_cov = np.zeros((6, 6))
    twist_cov[:3, :3] = J @ cov[3:9, 3:9] @ J.T
    twist_cov[3:, 3:] = cov[12:, 12:] + gyro_density**2 / _GYRO_MEAN_S * np.eye(3)
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        position=nav[:3].copy(),
        quaternion=nav[6:10].copy(),
        linear_velocity=C.T @ v,
        angular_velocity=rate,
        pose_cov=cov[np.ix_(pose, pose)],
        twist_cov=(twist_cov + twist_cov.T) / 2.0,
    )
