"""A navigation state as odometry."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.estimation.state import (
    ERR_ATTITUDE,
    ERR_GYRO_BIAS,
    ERR_POSITION,
    NAV_GYRO_BIAS,
    NAV_POSITION,
    NAV_QUATERNION,
    NAV_VELOCITY,
    Err,
)
from netpos.messages.values import Array, Odometry

_GYRO_MEAN_S = 0.01  # of one sample of a usual IMU


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
