"""The first state of a strapdown track: fixes of the last seconds and the IMU between them."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.fixes.position_fix import FixStatus, fix_position, start_of
from netpos.estimation.measurement import GROUP, KIND, LEVER, VARIANCE, Kind
from netpos.estimation.rows import drop_biases
from netpos.estimation.spatial.space import linearise_in_space
from netpos.estimation.state import NAV_POSITION, Err, Nav
from netpos.inertial.alignment import fit_course, way_of
from netpos.inertial.strapdown import ERR, NAV
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.imu_buffer import ImuBuffer
from netpos.tracking.estimators.strapdown_models import nav_of, start_sd

_WINDOW_NS = 20_000_000_000
_SPAN_MIN_NS = 3_000_000_000  # shorter, and one bad fix makes a heading the filter cannot mend
_ATTEMPT_NS = 500_000_000
_HEADING_SD_MAX = 0.1
_MISFIT_MAX = 4.0
_TILT_SD = 0.03
_FALSE_ALARM = 1e-3
_NS = 1e9


@dataclass(frozen=True, slots=True)
class _Fix:
    stamp_ns: int
    position: Array
    cov: Array
    lever: Array


@dataclass(slots=True)
class StrapdownStart:
    """Collects fixes until position, speed and heading follow from them."""

    config: TrackerConfig
    _fixes: deque[_Fix] = field(default_factory=deque)
    _tried_ns: int = 0
    missing: str = "no epoch gives a position yet: angles and times of two RSUs, or four times"
    """What a start lacks, for people."""

    def copy(self) -> StrapdownStart:
        """An independent copy."""
        return StrapdownStart(self.config, self._fixes.copy(), self._tried_ns, self.missing)

    def add_rows(self, stamp_ns: int, rows: Array, lever: Array) -> None:
        """Take the fix of one epoch of RSU rows, where they give one; without the station that
        contradicts the others, where one does."""
        fix = sound_fix(rows, self.config.device_height_m)
        if fix is not None:
            self.add_fix(stamp_ns, *fix, lever)

    def add_fix(self, stamp_ns: int, position: Array, cov: Array, lever: Array) -> None:
        """Take a position (3,) of the antenna at ``lever``."""
        self._fixes.append(_Fix(stamp_ns, position, cov, lever))
        while self._fixes[0].stamp_ns < stamp_ns - _WINDOW_NS:
            self._fixes.popleft()

    def solve(self, imu: ImuBuffer) -> tuple[int, Array, Array] | None:
        """Stamp, navigation state (NAV,) and covariance (ERR, ERR) at the newest fix; None while
        they are not known well enough."""
        if len(self._fixes) < 3:
            if self._fixes:
                self.missing = f"{len(self._fixes)} of 3 positions heard"
            return None
        fixes = list(self._fixes)
        begin, end = fixes[0].stamp_ns, fixes[-1].stamp_ns
        if end - begin < _SPAN_MIN_NS:
            self.missing = f"positions over {_SPAN_MIN_NS / _NS:g} s are needed"
            return None
        if end - self._tried_ns < _ATTEMPT_NS:
            return None
        self._tried_ns = end
        stamps, rates = imu.between(begin, end)
        if len(stamps) < 2 or stamps[0] - begin > _NS / 10 or end - stamps[-1] > _NS / 10:
            self.missing = "no IMU samples, or with holes, while positions were heard"
            return None
        at = (np.array([fix.stamp_ns for fix in fixes]) - begin) / _NS
        way = way_of((stamps - begin) / _NS, rates, at)
        position = np.array([fix.position for fix in fixes])
        cov = np.array([fix.cov for fix in fixes])
        cov[:, :2, :2] += self._drift_var(at[-1] - at, position)[:, None, None] * np.eye(2)
        course = fit_course(way, position[:, :2], cov[:, :2, :2])
        if course is None or course.misfit > _MISFIT_MAX:
            self.missing = "the way by the IMU and the positions do not fit each other"
            return None
        heading_sd = math.sqrt(course.cov[2, 2])
        position_sd = math.sqrt(max(course.cov[0, 0], course.cov[1, 1]))
        limit_m = self.config.initial_position_sd_max_m
        if heading_sd > _HEADING_SD_MAX or position_sd > limit_m:
            self.missing = (
                f"heading sd {math.degrees(heading_sd):.0f} deg (needed: below "
                f"{math.degrees(_HEADING_SD_MAX):.0f}), position sd {position_sd:.1f} m (needed: "
                f"below {limit_m:g}); the device must move"
            )
            return None
        weight = 1.0 / cov[:, 2, 2]
        height = float(position[:, 2] @ weight / weight.sum())
        turn = Rotation.from_euler("ZYX", [course.heading, course.pitch, course.roll])
        ahead = np.array([math.cos(course.heading), math.sin(course.heading), 0.0])
        antenna = np.array([*course.position, height])
        nav = nav_of(antenna - turn.apply(fixes[-1].lever), course.speed * ahead, turn.as_quat())
        return end, nav, self._covariance(course.cov, course.speed, ahead, 1.0 / weight.sum())

    def _drift_var(self, age_s: Array, position: Array) -> Array:
        """(k,) variance [m^2] of where the biases of the IMU take a way in ``age_s`` (k,)."""
        length = np.linalg.norm((position - position[-1])[:, :2], axis=1)
        turned = self.config.gyro_bias_sd_radps * age_s * length / 2
        return np.asarray((self.config.accel_bias_sd_mps2 * age_s**2 / 2) ** 2 + turned**2)

    def _covariance(self, course: Array, speed: float, ahead: Array, height_var: float) -> Array:
        """(ERR, ERR) of a start: course (4, 4) is that of east, north, heading and speed."""
        cov = np.diag(start_sd(self.config, 1.0, 0.1, _TILT_SD, _TILT_SD) ** 2)
        J = np.zeros((ERR, 4))
        J[Err.PX, 0] = J[Err.PY, 1] = J[Err.YAW, 2] = 1.0
        horizontal = [Err.VX, Err.VY]
        J[horizontal, 3] = ahead[:2]
        J[horizontal, 2] = speed * np.array([-ahead[1], ahead[0]])
        known = [Err.PX, Err.PY, Err.VX, Err.VY, Err.YAW]
        cov[known, known] = 0.0
        cov += J @ course @ J.T
        cov[known, known] += [0.01, 0.01, 0.25, 0.25, 1e-3]
        cov[Err.PZ, Err.PZ] = max(height_var, 0.25)
        return cov


def sound_fix(rows: Array, height_m: float) -> tuple[Array, Array] | None:
    """Position (3,) and covariance (3, 3) of the fix of ``rows`` (m, ROW_WIDTH).

    Where its residuals are too large it is that without the one station which makes them so, and
    where no single one does, with a covariance as much larger. None where there is no fix.
    """
    fix = fix_position(rows, start_of(rows, height_m))
    if fix.status != FixStatus.CONVERGED:
        return None
    cost, limit, dof = _residual_cost(rows, fix.position)
    if cost <= limit:
        return fix.position, fix.cov
    best, least = None, math.inf
    for group in np.unique(rows[:, GROUP]):
        others = rows[rows[:, GROUP] != group]
        other = fix_position(others, start_of(others, height_m))
        if other.status != FixStatus.CONVERGED:
            continue
        cost_without, limit_without, dof_without = _residual_cost(others, other.position)
        if dof_without > 0 and cost_without <= limit_without and cost_without < least:
            best, least = (other.position, other.cov), cost_without
    return best or (fix.position, fix.cov * cost / dof)


def _residual_cost(rows: Array, position: Array) -> tuple[float, float, int]:
    """Sum of squared residuals over their variances, what a true fix stays below but for one in a
    thousand, and the degrees of freedom."""
    nav, at = np.zeros(NAV), rows.copy()
    nav[NAV_POSITION], nav[Nav.QW] = position, 1.0
    at[:, LEVER : LEVER + 3] = 0.0  # the fix is the antenna's
    drop_biases(at)
    residual, _, _ = linearise_in_space(at, nav, np.zeros((ERR, ERR)))
    weight, times = 1.0 / rows[:, VARIANCE], rows[:, KIND] == Kind.TOA
    if times.any():
        residual[times] -= np.average(residual[times], weights=weight[times])
    dof = len(rows) - (4 if times.any() else 3)
    limit = chi_square_bound(dof, _FALSE_ALARM) if dof > 0 else math.inf
    return float(weight @ residual**2), limit, dof
