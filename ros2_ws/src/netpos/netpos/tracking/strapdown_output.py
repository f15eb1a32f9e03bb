"""A navigation state as odometry."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.messages.values import Array, Odometry

_GYRO_MEAN_S = 0.01  # of one sample of a usual IMU


def odometry_of(
    stamp_ns: int, vue_id: str, nav: Array, cov: Array, measured: Array | None, gyro_density: float
) -> Odometry:
    """Odometry of a navigation state (n + 1,): pose in map, twist in base_link.

    cov : (n, n); measured : (3,) angular velocity in base_link [rad/s], biased, None where
    there is none; gyro_density : its noise
    """
    C = Rotation.from_quat(nav[6:10]).as_matrix()
    v = nav[3:6]
    rate = np.zeros(3) if measured is None else measured - nav[13:16]
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    pose = np.r_[0:3, 6:9]
    J = np.hstack([C.T, C.T @ cross])  # of C' v for errors of velocity and attitude
    twist_cov = np.zeros((6, 6))
    twist_cov[:3, :3] = J @ cov[3:9, 3:9] @ J.T
    twist_cov[3:, 3:] = cov[12:15, 12:15] + gyro_density**2 / _GYRO_MEAN_S * np.eye(3)
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
