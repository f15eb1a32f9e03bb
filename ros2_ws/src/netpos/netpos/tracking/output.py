"""State of a track to odometry and clock state."""

from __future__ import annotations

import math

import numpy as np

from netpos.filters.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import Array, ClockState, Odometry, TrackState
from netpos.tracking.config import TrackerConfig

# What a planar tracker does not estimate (height, roll, pitch and their rates) is reported with
# this variance.
UNOBSERVED_VAR = 1e6
_YAW_VAR_MAX = math.pi**2 / 3.0  # of a heading about which nothing is known
_POSE_COV = np.diag([0.0, 0.0, UNOBSERVED_VAR, UNOBSERVED_VAR, UNOBSERVED_VAR, 0.0])
_TWIST_COV = np.diag([0.0, 0.0, *([UNOBSERVED_VAR] * 4)])


def eigenvalues(xx: float, xy: float, yy: float) -> tuple[float, float]:
    """Smallest and largest eigenvalue of a symmetric 2 x 2 matrix."""
    middle, radius = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    outer = middle + math.copysign(radius, middle)  # of the larger magnitude: nothing cancels
    inner = (xx * yy - xy * xy) / outer if outer else 0.0
    return min(inner, outer), max(inner, outer)


def largest_sd(cov: Array) -> float:
    """Standard deviation [m] of the position along its worst horizontal direction."""
    (xx, xy), (_, yy) = cov[:2, :2].tolist()
    return math.sqrt(max(eigenvalues(xx, xy, yy)[1], 0.0))


def heading(mean: Array, cov: Array, last: float, index: int = -1) -> tuple[float, float]:
    """Heading [rad] and its variance: the state ``index``, or (-1) the direction of motion, and
    ``last`` where the speed does not stand out from its error."""
    if index >= 0:
        return math.remainder(float(mean[index]), math.tau), float(cov[index, index])
    vx, vy = mean[2:4].tolist()
    speed2 = vx * vx + vy * vy
    if speed2 < 1e-12:
        return last, _YAW_VAR_MAX
    (xx, xy), (_, yy) = cov[2:4, 2:4].tolist()
    variance = (vy * vy * xx - 2.0 * vx * vy * xy + vx * vx * yy) / (speed2 * speed2)
    if variance > _YAW_VAR_MAX / 4.0:
        return last, _YAW_VAR_MAX
    return math.atan2(vy, vx), variance


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
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y, vx, vy = mean[:4].tolist()
    (xx, xy), (_, yy) = cov[2:4, 2:4].tolist()
    pose_cov, twist_cov = _POSE_COV.copy(), _TWIST_COV.copy()
    pose_cov[:2, :2] = cov[:2, :2]
    pose_cov[5, 5] = yaw_var
    twist_cov[0, 0] = cos * cos * xx + 2.0 * cos * sin * xy + sin * sin * yy
    twist_cov[1, 1] = sin * sin * xx - 2.0 * cos * sin * xy + cos * cos * yy
    twist_cov[0, 1] = twist_cov[1, 0] = cos * sin * (yy - xx) + (cos * cos - sin * sin) * xy
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        position=np.array((x, y, height_m)),
        quaternion=np.array((0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))),
        linear_velocity=np.array((cos * vx + sin * vy, cos * vy - sin * vx, 0.0)),
        pose_cov=pose_cov,
        twist_cov=twist_cov,
    )


def with_yaw_rate(odometry: Odometry, mean: Array, cov: Array, heading: int) -> Odometry:
    """Odometry of a rigid body whose heading and yaw rate are the states from ``heading`` on."""
    rate = heading + 1
    odometry.angular_velocity = np.array((0.0, 0.0, float(mean[rate])))
    odometry.twist_cov[5, 5] = cov[rate, rate]
    odometry.pose_cov[:2, 5] = odometry.pose_cov[5, :2] = cov[:2, heading]
    return odometry


def clock_state(stamp_ns: int, vue_id: str, mean: Array, cov: Array) -> ClockState:
    """Clock state in seconds and seconds per second of offset and drift in metres: mean (2,), cov
    (2, 2)."""
    c = SPEED_OF_LIGHT_MPS
    return ClockState(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        offset_s=float(mean[0]) / c,
        drift=float(mean[1]) / c,
        cov=cov / (c * c),
    )


def track_state(
    config: TrackerConfig, stamp_ns: int, last_accepted_ns: int | None, position_sd_m: float
) -> TrackState:
    """What a track is worth at ``stamp_ns``; last_accepted_ns : of its last accepted measurement,
    None before the first fix; position_sd_m : along its worst axis [m], inf where it is not
    decided."""
    if last_accepted_ns is None:
        return TrackState.WAITING
    if stamp_ns - last_accepted_ns > config.coast_after_s * 1e9:
        return TrackState.COASTING
    if position_sd_m > config.initial_position_sd_max_m:
        return TrackState.INITIALISING
    return TrackState.TRACKING
