"""State of a track to odometry and clock state."""

from __future__ import annotations

import math

import numpy as np

from netpos.filters.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import Array, ClockState, Odometry

# What a planar tracker does not estimate (height, roll, pitch and their rates) is reported with
# this variance.
UNOBSERVED_VAR = 1e6
_YAW_VAR_MAX = math.pi**2 / 3.0  # of a heading about which nothing is known


def heading(mean: Array, cov: Array, last: float) -> tuple[float, float]:
    """Direction of motion [rad] and its variance; ``last`` where the speed does not stand out from
    its error."""
    vx, vy = float(mean[2]), float(mean[3])
    speed2 = vx * vx + vy * vy
    if speed2 < 1e-12:
        return last, _YAW_VAR_MAX
    across = np.array([-vy, vx]) / speed2
    variance = float(across @ cov[2:4, 2:4] @ across)
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
    to_body = np.array([[cos, sin], [-sin, cos]])
    pose_cov = np.diag([0.0, 0.0, UNOBSERVED_VAR, UNOBSERVED_VAR, UNOBSERVED_VAR, yaw_var])
    pose_cov[:2, :2] = cov[:2, :2]
    twist_cov = np.diag([0.0, 0.0, *([UNOBSERVED_VAR] * 4)])
    twist_cov[:2, :2] = to_body @ cov[2:4, 2:4] @ to_body.T
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        position=np.array([mean[0], mean[1], height_m]),
        quaternion=np.array([0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0)]),
        linear_velocity=np.array([*(to_body @ mean[2:4]), 0.0]),
        pose_cov=pose_cov,
        twist_cov=twist_cov,
    )


def clock_state(stamp_ns: int, vue_id: str, mean: Array, cov: Array) -> ClockState:
    """Clock state in seconds and seconds per second."""
    c = SPEED_OF_LIGHT_MPS
    return ClockState(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        offset_s=float(mean[4]) / c,
        drift=float(mean[5]) / c,
        cov=cov[4:6, 4:6] / (c * c),
    )
