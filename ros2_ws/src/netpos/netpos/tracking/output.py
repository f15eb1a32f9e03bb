"""State of a track to odometry and clock state."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import leaf
from netpos.estimation.factor import eigenvalues
from netpos.estimation.level.protection import radius_of
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.state import POSITION, HeightState, X
from netpos.messages.values import Array, ClockState, Odometry, TrackState
from netpos.tracking.config import TrackerConfig

# What a planar tracker takes for granted and does not estimate: that the device is at the height
# it was told (unless that is a state, ``with_height``), upright, and neither climbs nor tips nor
# (without a heading of its own) turns.
HEIGHT_SD_M, TILT_SD_RAD = 1.0, 0.2
CLIMB_SD_MPS, TURN_SD_RADPS = 1.0, 1.0
_YAW_VAR_MAX = math.pi**2 / 3.0  # of a heading about which nothing is known
_COVS = np.array(  # of pose and twist
    [
        np.diag(np.square([0.0, 0.0, HEIGHT_SD_M, TILT_SD_RAD, TILT_SD_RAD, 0.0])),
        np.diag(np.square([0.0, 0.0, CLIMB_SD_MPS, *[TURN_SD_RADPS] * 3])),
    ]
)
_POSITION, _QUATERNION, _VELOCITY, _RATE, _VECTORS = 0, 3, 7, 10, 13


@leaf
def largest_sd(cov: Array) -> float:
    """Standard deviation [m] of the position along its worst horizontal direction."""
    _, largest = eigenvalues(cov[X.PX, X.PX], cov[X.PX, X.PY], cov[X.PY, X.PY])
    return math.sqrt(max(largest, 0.0))


def heading(mean: Array, cov: Array, last: float, index: int = -1) -> tuple[float, float]:
    """Heading [rad] and its variance: the state ``index``, or (-1) the direction of motion, and
    ``last`` where the speed does not stand out from its error."""
    if index >= 0:
        return math.remainder(float(mean[index]), math.tau), float(cov[index, index])
    yaw, variance = _course(mean, cov, last)
    return yaw, variance


@leaf
def _course(mean: Array, cov: Array, last: float) -> tuple[float, float]:
    vx, vy = mean[X.VX], mean[X.VY]
    speed2 = vx * vx + vy * vy
    if speed2 < 1e-12:
        return last, _YAW_VAR_MAX
    xx, xy, yy = cov[X.VX, X.VX], cov[X.VX, X.VY], cov[X.VY, X.VY]
    variance = (vy * vy * xx - 2.0 * vx * vy * xy + vx * vx * yy) / (speed2 * speed2)
    if variance > _YAW_VAR_MAX / 4.0:
        return last, _YAW_VAR_MAX
    return math.atan2(vy, vx), variance


@leaf
def _fill(
    mean: Array, cov: Array, yaw: float, yaw_var: float, vectors: Array, covs: Array
) -> None:
    """Vectors and covariances of an odometry, all but its height, from what is not estimated."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    vx, vy = mean[X.VX], mean[X.VY]
    xx, xy, yy = cov[X.VX, X.VX], cov[X.VX, X.VY], cov[X.VY, X.VY]
    vectors[_POSITION], vectors[_POSITION + 1] = mean[X.PX], mean[X.PY]
    vectors[_VELOCITY], vectors[_VELOCITY + 1] = cos * vx + sin * vy, cos * vy - sin * vx
    vectors[_QUATERNION + 2] = math.sin(yaw / 2.0)
    vectors[_QUATERNION + 3] = math.cos(yaw / 2.0)
    pose, twist = covs[0], covs[1]
    for a in range(2):
        for b in range(2):
            pose[a, b] = cov[a, b]
    pose[5, 5] = yaw_var
    twist[0, 0] = cos * cos * xx + 2.0 * cos * sin * xy + sin * sin * yy
    twist[1, 1] = sin * sin * xx - 2.0 * cos * sin * xy + cos * cos * yy
    twist[0, 1] = twist[1, 0] = cos * sin * (yy - xx) + (cos * cos - sin * sin) * xy


@leaf
def _describe(
    mean: Array,
    cov: Array,
    yaw: float,
    yaw_var: float,
    risk: float,
    vectors: Array,
    covs: Array,
    clock_cov: Array,
) -> tuple[float, float, float]:
    """``_fill``, with the direction of motion where ``yaw_var`` < 0 (``yaw``: the last one), and
    the covariance of a clock in seconds; yaw, ``largest_sd`` and ``gaussian_radius``."""
    if yaw_var < 0.0:
        yaw, yaw_var = _course(mean, cov, yaw)
    _fill(mean, cov, yaw, yaw_var, vectors, covs)
    for a in range(2):
        for b in range(2):
            clock_cov[a, b] = cov[X.CLOCK + a, X.CLOCK + b] / (
                SPEED_OF_LIGHT_MPS * SPEED_OF_LIGHT_MPS
            )
    return yaw, largest_sd(cov), radius_of(cov, risk)


def describe(
    stamp_ns: int,
    vue_id: str,
    mean: Array,
    cov: Array,
    height_m: float,
    last_yaw: float,
    heading_index: int,
    risk: float,
) -> tuple[Odometry, ClockState, float, float, float]:
    """Odometry and clock of a planar track (n,), (n, n), its yaw [rad] (``heading``), the sd of
    its position along the worst direction [m] and the radius [m] that its Gaussian error leaves
    with the probability ``risk``.

    Raises ``ValueError`` for a covariance that is none.
    """
    vectors, covs, clock_cov = np.zeros(_VECTORS), _COVS.copy(), np.empty((2, 2))
    yaw, yaw_var = last_yaw, -1.0
    if heading_index >= 0:
        yaw, yaw_var = heading(mean, cov, last_yaw, heading_index)
    yaw, sd_m, radius_m = _describe(mean, cov, yaw, yaw_var, risk, vectors, covs, clock_cov)
    if math.isnan(radius_m):
        raise ValueError(f"the position's covariance is none: {cov[POSITION, POSITION].tolist()}")
    clock = ClockState(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        offset_s=mean.item(X.CLOCK) / SPEED_OF_LIGHT_MPS,
        drift=mean.item(X.DRIFT) / SPEED_OF_LIGHT_MPS,
        cov=clock_cov,
    )
    told = _odometry(stamp_ns, vue_id, vectors, covs, height_m)
    if heading_index >= 0:
        with_yaw_rate(told, mean, cov, heading_index)
    return told, clock, yaw, sd_m, radius_m


def odometry(
    stamp_ns: int,
    vue_id: str,
    mean: Array,
    cov: Array,
    height_m: float,
    yaw: float,
    yaw_var: float,
) -> Odometry:
    """Odometry of a planar track: pose in map, twist in base_link (x along ``yaw``)."""
    vectors, covs = np.zeros(_VECTORS), _COVS.copy()
    _fill(mean, cov, yaw, yaw_var, vectors, covs)
    return _odometry(stamp_ns, vue_id, vectors, covs, height_m)


def _odometry(
    stamp_ns: int, vue_id: str, vectors: Array, covs: Array, height_m: float
) -> Odometry:
    vectors[_POSITION + 2] = height_m
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        position=vectors[_POSITION:_QUATERNION],
        quaternion=vectors[_QUATERNION:_VELOCITY],
        linear_velocity=vectors[_VELOCITY:_RATE],
        angular_velocity=vectors[_RATE:],
        pose_cov=covs[0],
        twist_cov=covs[1],
    )


def with_yaw_rate(odometry: Odometry, mean: Array, cov: Array, heading: int) -> Odometry:
    """Odometry of a rigid body whose heading and yaw rate are the states from ``heading`` on."""
    rate = heading + 1
    odometry.angular_velocity[2] = mean[rate]
    odometry.twist_cov[5, 5] = cov[rate, rate]
    odometry.pose_cov[:2, 5] = odometry.pose_cov[5, :2] = cov[POSITION, heading]
    return odometry


def with_height(odometry: Odometry, mean: Array, cov: Array, height: HeightState) -> Odometry:
    """Odometry of a planar track whose state holds the height of the device."""
    k = height.entry
    odometry.position[2] = height.nominal_m + mean[k]
    odometry.pose_cov[2, 2] = cov[k, k]
    odometry.pose_cov[:2, 2] = odometry.pose_cov[2, :2] = cov[POSITION, k]
    return odometry


def clock_state(stamp_ns: int, vue_id: str, mean: Array, cov: Array) -> ClockState:
    """Clock state in seconds and seconds per second of offset and drift in metres: mean (2,), cov
    (2, 2)."""
    c = SPEED_OF_LIGHT_MPS
    return ClockState(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        offset_s=mean.item(0) / c,
        drift=mean.item(1) / c,
        cov=cov / (c * c),
    )


def track_state(
    config: TrackerConfig,
    stamp_ns: int,
    last_accepted_ns: int | None,
    position_sd_m: float,
    *,
    decided: bool = True,
    bounded: bool = True,
    placed: bool = True,
) -> TrackState:
    """What a track is worth at ``stamp_ns``; last_accepted_ns : of its last accepted measurement,
    None before the first fix; position_sd_m : along its worst axis [m]; decided : whether it is
    known which of several places is the true one; bounded : whether there is a protection level,
    none where a manoeuvre would go unnoticed; placed : whether the device can be where the
    estimate is."""
    if last_accepted_ns is None:
        return TrackState.WAITING
    if stamp_ns - last_accepted_ns > config.coast_after_s * 1e9:
        return TrackState.COASTING
    if not decided:
        return TrackState.AMBIGUOUS
    if position_sd_m > config.initial_position_sd_max_m or not (bounded and placed):
        return TrackState.INITIALISING
    return TrackState.TRACKING
