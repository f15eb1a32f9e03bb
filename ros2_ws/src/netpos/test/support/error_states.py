"""Vehicles, rows and an IMU for the tests of the error-state filter."""

from __future__ import annotations

import numpy as np
from netpos.estimation.spatial.error_state import (
    MEMORY,
    UNCONSTRAINED,
    Constraints,
    Imu,
    Sensors,
    advance,
)
from netpos.estimation.spatial.space import innovation_at
from netpos.estimation.state import NAV_POSITION, NAV_QUATERNION, NAV_VELOCITY, Nav
from netpos.inertial.strapdown import ERR, NAV, InertialNoise, rotation_of, still_earth
from netpos.messages.values import Array
from scipy.spatial.transform import Rotation

NOISE = InertialNoise(2e-3, 8.7e-4, 9.8e-3, 1.7e-4, 100.0)
LEVER_ARM = (0.5, 0.1, 1.0)
OPEN = np.array([0.0, np.inf])
_SCALES = np.repeat([3.0, 1.0, 0.1, 0.01, 1e-3], 3)


def vehicle(rng: np.random.Generator) -> tuple[Array, Array]:
    """A navigation state near the middle with correlated errors of some metres and degrees."""
    nav = np.zeros(NAV)
    nav[NAV_POSITION], nav[NAV_VELOCITY] = (
        rng.normal(0.0, [5.0, 5.0, 1.0]),
        rng.normal(0.0, [5.0, 5.0, 0.5]),
    )
    nav[NAV_QUATERNION] = Rotation.from_euler("ZYX", rng.normal(0.0, [1.5, 0.05, 0.05])).as_quat()
    A = rng.normal(size=(ERR, ERR)) / 4.0
    return nav, (A @ A.T + 0.3 * np.eye(ERR)) * np.outer(_SCALES, _SCALES)


def moving(speed: float) -> Array:
    """A level vehicle at the origin, along x."""
    nav = np.zeros(NAV)
    nav[Nav.VX], nav[Nav.QW] = speed, 1.0
    return nav


def linearised(rows: Array, nav: Array) -> tuple[Array, Array]:
    """Innovations (m,) of rows and their Jacobian (m, ERR)."""
    C, H = np.empty((3, 3)), np.empty((len(rows), ERR))
    rotation_of(nav[NAV_QUATERNION], C)
    return np.array([innovation_at(r, nav, C, h) for r, h in zip(rows, H, strict=True)]), H


def driven(
    nav: Array,
    cov: Array,
    imu: Imu,
    to_s: float,
    constraints: Constraints = UNCONSTRAINED,
    noise: InertialNoise = NOISE,
    memory: Array | None = None,
) -> float:
    """``advance`` from 0 on over an earth that does not turn, in place; the time [s] without
    samples."""
    sensors = Sensors(noise, still_earth(), constraints)
    memory = np.zeros(MEMORY) if memory is None else memory
    return float(advance(nav, cov, memory, 0, round(to_s * 1e9), imu, sensors))
