"""The spatial estimator: position, velocity and attitude by the strapdown filter.

Every range, time and angle is an update of the error-state filter (tight coupling), position
fixes are the loose one. The states of the strapdown system are followed by the device's clock and
by the biases of RSUs. The IMU moves the estimate between epochs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.estimation.engine import is_sound
from netpos.estimation.fixes.position_fix import fix_position, start_of
from netpos.estimation.level.protection import protection_level
from netpos.estimation.measurement import (
    GATE_VARIANCE,
    GROUP,
    HEADING,
    KIND,
    ORIGIN,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.estimation.rows import put_measurement
from netpos.estimation.sensors.table import readings
from netpos.estimation.spatial.error_state import (
    MEMORY,
    Imu,
    Sensors,
    advance,
    correct,
    doubt_standstill,
)
from netpos.estimation.spatial.space import (
    direction_rows,
    linearise_in_space,
    place_rows,
    reweight_3d,
)
from netpos.estimation.state import (
    ERR_ATTITUDE,
    ERR_BIASES,
    ERR_CLOCK_DRIFT,
    ERR_GYRO_BIAS,
    ERR_POSITION,
    NAV_CLOCK_DRIFT,
    NAV_GYRO_BIAS,
    NAV_POSITION,
    NAV_QUATERNION,
    NAV_VELOCITY,
    POSITION,
    Err,
    Nav,
)
from netpos.estimation.update.conditioning import Robust
from netpos.inertial.strapdown import ERR
from netpos.messages.values import (
    Array,
    Field,
    InitialPose,
    Odometry,
    RsuMeasurement,
    Velocity,
)
from netpos.tracking import output
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.epoch_rows import EpochRows, RowForm, Sites, Source
from netpos.tracking.estimators.estimates import UpdateResult
from netpos.tracking.estimators.estimator import (
    RECENT,
    Description,
    Estimator,
    FirstFix,
    Past,
    Recent,
)
from netpos.tracking.estimators.models import augmented, gate_thresholds, robust_options_of
from netpos.tracking.estimators.strapdown_models import nav_of, sensors_of, with_clock
from netpos.tracking.first_fix.initialise import Initialiser
from netpos.tracking.first_fix.strapdown_start import StrapdownStart
from netpos.tracking.rsus.rsu import BiasStates, Rsu
from netpos.tracking.smoothing.strapdown import Recorder

_POSE_VAR_MIN = 1e-4  # an initial pose may leave the height's variance at 0
_RATE_WINDOW_NS = 50_000_000
_GYRO_MEAN_S = 0.01  # of one sample of a usual IMU
_IN_PLANE = [Nav.PX, Nav.PY, Nav.VX, Nav.VY]  # of nav and of its error alike
_HEIGHT_MAX_M = 1e4  # as ``TrackerConfig.device_height_m``
_AHEAD = np.array([[1.0, 0.0, 0.0]])
_FIX = int(Field.POSITION)
_READABLE = int(Field.POSITION)
for _sensor, _reading in readings():
    if _sensor.in_strapdown:
        _READABLE |= int(_reading.field)


def warm_up(config: TrackerConfig) -> None:
    """Compile, or load, the kernels before the first measurement."""
    nav, cov = with_clock(config, nav_of(np.zeros(3), np.zeros(3), np.eye(4)[3]), np.eye(ERR))
    memory, sensors = np.zeros(MEMORY), sensors_of(config)
    imu = Imu(np.array([10_000_000], dtype=np.int64), np.zeros((1, 6)))
    advance(nav, cov, memory, 0, 10_000_000, imu, sensors)
    rows = place_rows(np.zeros(3), np.eye(3), (0.0, 0.0, 0.0))
    innovations_with_sd_3d(rows, nav, cov)
    if config.robust != "none" or config.nlos_probability > 0.0:
        reweight_3d(nav, cov, rows, robust_options_of(config))
    correct(nav, cov, rows, np.full(4, np.inf), np.zeros(1))
    doubt_standstill(memory)
    fix_position(rows, start_of(rows, 0.0))


# rows


def _put_in_3d(rows: Array, at: int, m: RsuMeasurement, sites: Sites, group: int) -> int:
    """``put_measurement`` in space: a position fix becomes three decorrelated PLACE rows."""
    if not int(m.fields) & _FIX:
        return put_measurement(rows, at, m, sites, group, -1)
    scalars = replace(m, fields=m.fields & ~Field.POSITION)
    end = put_measurement(rows, at, scalars, sites, group, -1)
    rows[end : end + 3] = place_rows(m.position, m.position_cov, m.lever_arm, group)
    return end + 3


def _speed_row_3d(speed_mps: float, variance: float, group: int) -> Array:
    """Row (1, ROW_WIDTH) of the speed along the x axis of base_link."""
    value = np.array([speed_mps]), np.array([variance])
    return direction_rows(Kind.BODY_VELOCITY, _AHEAD, *value, group)


ROWS_3D = RowForm(_put_in_3d, _speed_row_3d)


def innovations_with_sd_3d(rows: Array, nav: Array, cov: Array) -> Array:
    """Innovation of each row (m, ROW_WIDTH) at nav (n + 1,) and its standard deviation under cov
    (n, n): (m, 2)."""
    innovation, H, bend = linearise_in_space(rows, nav, cov)
    variance = np.einsum("ij,jk,ik->i", H, cov, H) + rows[:, GATE_VARIANCE] + bend
    return np.column_stack([innovation, np.sqrt(variance)])


def planar_rows(rows: Array, height_m: float) -> Array:
    """``rows`` (m, ROW_WIDTH) of a spatial epoch as those of a device at ``height_m``: a direction
    of a position fix as a LINEAR row, speeds in base_link left out."""
    planar: Array = rows[rows[:, KIND] != Kind.BODY_VELOCITY]
    fixes = planar[:, KIND] == Kind.PLACE
    planar[fixes, VALUE] -= planar[fixes, ORIGIN + 2] * height_m
    planar[fixes, ORIGIN + 2 : HEADING] = 0.0
    planar[fixes, KIND] = Kind.LINEAR
    return planar


# the estimator


def odometry_of(
    stamp_ns: int, vue_id: str, nav: Array, cov: Array, measured: Array | None, gyro_density: float
) -> Odometry:
    """Odometry of a navigation state (n + 1,): pose in map, twist in base_link.

    cov : (n, n); measured : (3,) angular velocity in base_link [rad/s], biased, None where
    there is none; gyro_density : its noise
    """
    C = Rotation.from_quat(nav[NAV_QUATERNION]).as_matrix()
    v = nav[NAV_VELOCITY]
    rate = np.zeros(3) if measured is None else measured - nav[NAV_GYRO_BIAS]
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    pose = np.r_[ERR_POSITION, ERR_ATTITUDE]
    J = np.hstack([C.T, C.T @ cross])  # of C' v for errors of velocity and attitude
    twist_cov = np.zeros((6, 6))
    moving = slice(Err.VX, Err.ACCEL_BIAS)  # velocity and attitude
    twist_cov[:3, :3] = J @ cov[moving, moving] @ J.T
    twist_cov[3:, 3:] = cov[
        ERR_GYRO_BIAS, ERR_GYRO_BIAS
    ] + gyro_density**2 / _GYRO_MEAN_S * np.eye(3)
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        position=nav[NAV_POSITION].copy(),
        quaternion=nav[NAV_QUATERNION].copy(),
        linear_velocity=C.T @ v,
        angular_velocity=rate,
        pose_cov=cov[np.ix_(pose, pose)],
        twist_cov=(twist_cov + twist_cov.T) / 2.0,
    )


@dataclass(slots=True)
class StrapdownEstimate:
    """nav (n + 1,), cov (n, n) of its error and the memory (MEMORY,) of ``error_state.advance``
    at ``stamp_ns``."""

    stamp_ns: int
    nav: Array
    cov: Array
    memory: Array

    def copy(self) -> StrapdownEstimate:
        """An independent copy."""
        return StrapdownEstimate(
            self.stamp_ns, self.nav.copy(), self.cov.copy(), self.memory.copy()
        )


class SpatialEstimator(Estimator):
    """Estimator of a device that moves in space and has an IMU."""

    estimate: StrapdownEstimate | None
    recorder: Recorder | None = None

    def __init__(self, vue_id: str, config: TrackerConfig, rsus: Mapping[str, Rsu]) -> None:
        super().__init__(vue_id, config, rsus, ROWS_3D)
        self._sensors, self._gyro = sensors_of(config), config.gyro_noise_density
        self._gate = gate_thresholds(config.gate_probability)
        self._robust = robust_options_of(config)
        self._forget()

    def _forget(self) -> None:
        self.estimate = None
        self.biases, self.bias = BiasStates(ERR_BIASES), np.zeros((2, 0))
        self._start = StrapdownStart(self._config)
        self._heard: Recent = ()  # epochs without an estimate

    def copy(self) -> Self:
        twin = super().copy()
        if self.estimate is None:
            twin._start = self._start.copy()
        else:
            twin.estimate = self.estimate.copy()
        return twin

    @property
    def missing(self) -> str:
        return self._start.missing

    def _there(self) -> StrapdownEstimate:
        assert self.estimate is not None
        return self.estimate

    # measurements

    def readable(self, item: Source) -> Source | None:
        """All but velocities in map and phase differences."""
        if not isinstance(item, RsuMeasurement):
            return None if isinstance(item, Velocity) else item
        fields = int(item.fields) & _READABLE
        if fields == int(item.fields):
            return item
        return replace(item, fields=Field(fields)) if fields else None

    def innovations(self, rows: Array) -> Array:
        return innovations_with_sd_3d(rows, self._there().nav, self._there().cov)

    # first fix

    def pose_cost(self, stamp_ns: int, pose: InitialPose, recent: Recent | None) -> float:
        """The rows are those of a planar device at the height of the estimate, or at
        ``device_height_m`` before there is one."""
        estimate, height_m = self.estimate, self._config.device_height_m
        if estimate is not None:
            height_m = float(np.clip(estimate.nav[Nav.PZ], -_HEIGHT_MAX_M, _HEIGHT_MAX_M))
        window = Initialiser(replace(self._config, device_height_m=height_m))
        for then_ns, epoch_rows in self._heard if recent is None else recent:
            flat = replace(epoch_rows, rows=planar_rows(epoch_rows.rows, height_m))
            self._collect(window, then_ns, flat)
        return self._excess_cost(window, stamp_ns, pose)

    def start_from_pose(self, stamp_ns: int, pose: InitialPose) -> bool:
        """One position of the three that a start needs."""
        cov = pose.cov + np.diag([0.0, 0.0, _POSE_VAR_MIN if pose.cov[2, 2] == 0.0 else 0.0])
        self._start.add_fix(stamp_ns, pose.position.copy(), cov, np.zeros(3))
        return False

    def first_fix(self, stamp_ns: int, epoch_rows: EpochRows) -> FirstFix:
        rsus = [item for item in epoch_rows.items if isinstance(item, RsuMeasurement)]
        if not rsus:
            return FirstFix(False)
        self._heard = (*self._heard[1 - RECENT :], (stamp_ns, epoch_rows))
        rows = epoch_rows.rows[epoch_rows.rows[:, KIND] != Kind.BODY_VELOCITY]
        rows[:, VARIANCE] += replace(epoch_rows, rows=rows).slow_variance(self.biases)
        self._start.add_rows(stamp_ns, rows, np.array(rsus[0].lever_arm))
        start = self._start.solve(self.imu)
        if start is None or start[0] != stamp_ns:
            return FirstFix(False)
        nav, cov = with_clock(self._config, *start[1:])
        self.estimate = StrapdownEstimate(stamp_ns, nav, cov, np.zeros(MEMORY))
        self._grow()
        has_clock = self._set_clock(rows)
        if self.recorder is not None:
            self.recorder.begin(stamp_ns, self.estimate.nav, self.estimate.cov)
        return FirstFix(True, has_clock)

    def _set_clock(self, rows: Array) -> bool:
        """Read the clock's offset off one time of arrival, where there is one: the position is in
        the start already."""
        estimate, times = self._there(), rows[rows[:, KIND] == Kind.TOA][:1].copy()
        if not len(times):
            return False
        times[:, GROUP] = 0
        if self._config.nlos_probability > 0.0:
            times[:, VARIANCE] += self._config.nlos_mean_excess_m**2
        correct(estimate.nav, estimate.cov, times, np.full(2, np.inf), np.zeros(1))
        return True

    # estimate

    def predict(self, stamp_ns: int) -> None:
        if self.estimate is None or stamp_ns <= self.estimate.stamp_ns:
            return
        self._grow()
        estimate = self.estimate
        imu = Imu(*self.imu.between(estimate.stamp_ns, stamp_ns))
        move = advance if self.recorder is None else self.recorder.advance
        nav, cov, memory = estimate.nav, estimate.cov, estimate.memory
        move(nav, cov, memory, estimate.stamp_ns, stamp_ns, imu, self._sensors_now())
        estimate.stamp_ns = stamp_ns

    def _grow(self) -> None:
        """States for all biases heard of."""
        estimate = self._there()
        sd = self.bias[0]
        estimate.nav, estimate.cov = augmented(estimate.nav, estimate.cov, sd, ERR_BIASES)

    def _sensors_now(self) -> Sensors:
        return self._sensors._replace(slow=self._sensors.slow._replace(biases=self.bias))

    def update(self, stamp_ns: int, epoch_rows: EpochRows, past: Past) -> UpdateResult:
        self.predict(stamp_ns)
        self._grow()
        estimate, rows = self._there(), epoch_rows.rows
        nav, cov = estimate.nav, estimate.cov
        if self._robust.kind != Robust.NONE or self._robust.nlos_probability > 0.0:
            reweight_3d(nav, cov, rows, self._robust)
        innovations, accepted = self.innovations(rows), np.zeros(len(epoch_rows.items))
        nis, dof = correct(nav, cov, rows, self._gate, accepted)
        if dof == 0:
            doubt_standstill(estimate.memory)
        sound = bool(is_sound(nav[_IN_PLANE], cov[np.ix_(_IN_PLANE, _IN_PLANE)]))
        outliers = (1.0 - accepted).tolist()
        return UpdateResult(nis, dof, accepted.tolist(), outliers, innovations, sound=sound)

    # output

    def describe(self, stamp_ns: int) -> Description:
        estimate, vue_id = self._there(), self._vue_id
        nav, cov = estimate.nav, estimate.cov
        rate = self._rate(stamp_ns)
        odometry = odometry_of(stamp_ns, vue_id, nav, cov, rate, self._gyro)
        mean, clock_cov = nav[NAV_CLOCK_DRIFT], cov[ERR_CLOCK_DRIFT, ERR_CLOCK_DRIFT]
        clock = output.clock_state(stamp_ns, vue_id, mean, clock_cov)
        radius_m = protection_level(cov[POSITION, POSITION], self._config.integrity_risk)
        return Description(odometry, clock, output.largest_sd(cov), radius_m)

    def _rate(self, stamp_ns: int) -> Array | None:
        """(3,) angular velocity as the newest sample has it."""
        _, rates = self.imu.between(stamp_ns - _RATE_WINDOW_NS, stamp_ns)
        return np.asarray(rates[-1, :3]) if len(rates) else None

    # smoothing

    def keep_posteriors(self) -> None:
        self.recorder = Recorder()

    def record(self, segment: int) -> tuple[Odometry, ...]:
        """Kept for ``smoothed``; a track that starts anew is a passage of its own there."""
        estimate = self.estimate
        if self.recorder is not None and estimate is not None:
            rate = self._rate(estimate.stamp_ns)
            self.recorder.note(estimate.nav, estimate.cov, rate, self.bias[0])
        return ()

    def go_back(self, stamp_ns: int) -> None:
        if self.recorder is not None:
            estimate = self.estimate
            self.recorder.go_back(estimate.stamp_ns if estimate else stamp_ns - 1)

    def smoothed(self) -> list[Odometry]:
        if self.recorder is None:
            return []
        return [
            odometry_of(i.stamp_ns, self._vue_id, i.nav, i.cov, i.rate, self._gyro)
            for i in self.recorder.smoothed()
        ]
