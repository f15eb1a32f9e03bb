"""RSUs, noise-free or noisy rows of them, and the first fix they give."""

from __future__ import annotations

import math

import numpy as np
from netpos.estimation.rows import rsu_rows
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.first_fix.initialise import Initialiser
from netpos.tracking.rsus.rsu import Rsu, SlowErrors
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from track_cases import T0


def rsu(x: float, y: float, yaw_deg: float = 0.0, **change: object) -> Rsu:
    q = Rotation.from_euler("z", yaw_deg, degrees=True).as_quat()
    values = {"rsu_id": f"{x},{y}", "position": np.array([x, y, 0.0]), "quaternion": q}
    return Rsu.of(RsuInfo(**(values | change)))  # type: ignore[arg-type]


def measure(
    station: Rsu,
    state: Array,
    fields: Field,
    rng: np.random.Generator | None = None,
    angle_sd: float = 0.02,
    range_sd: float = 0.3,
    group: int = 0,
    stamp_ns: int = T0,
) -> Array:
    """Rows of a measurement of [x, y, vx, vy, clock m, drift m/s]; noise-free without ``rng``."""
    noise = rng.normal(size=3) if rng is not None else np.zeros(3)
    d = state[:2] - station.info.position[:2]
    ux, uy, _ = Rotation.from_quat(station.info.quaternion).inv().apply([*d, 0.0])
    r = math.hypot(*d)
    cone = station.info.angle_convention is AngleConvention.CONE
    azimuth = math.asin(uy / r) if cone else math.atan2(uy, ux)
    m = RsuMeasurement(
        stamp_ns=stamp_ns,
        rsu_id=station.info.rsu_id,
        vue_id="v",
        fields=fields,
        azimuth_rad=azimuth + angle_sd * noise[0],
        azimuth_var=angle_sd**2,
        toa_s=(r + state[4] + range_sd * noise[1]) / speed_of_light,
        toa_var=(range_sd / speed_of_light) ** 2,
        range_m=r + range_sd * noise[2],
        range_var=range_sd**2,
        position=np.array([*state[:2], 0.0]),
        position_cov=np.eye(3) * range_sd**2,
    )
    return rsu_rows(m, station.info, station.axes, group)


def solve(
    config: TrackerConfig,
    stations: list[Rsu],
    state: Array,
    fields: Field,
    rng: np.random.Generator | None = None,
) -> tuple[Array, Array] | None:
    initialiser = Initialiser(config)
    rows = np.vstack([measure(s, state, fields, rng, group=i) for i, s in enumerate(stations)])
    initialiser.add(T0, rows, tuple(stations))
    return fix_of(initialiser)


def fix_of(initialiser: Initialiser, slow: SlowErrors | None = None) -> tuple[Array, Array] | None:
    """Mean (n,) and covariance (n, n) of a first fix, of 6 states and the slow errors."""
    fix = initialiser.solve(slow)
    if fix is None:
        return None
    weights = np.exp(fix.log_weights)
    mean = weights @ fix.means
    away = fix.means - mean
    spread = np.einsum("k,ki,kj->ij", weights, away, away)
    return mean, np.einsum("k,kij->ij", weights, fix.covs) + spread


def at(x: float, y: float, clock: float = 0.0) -> Array:
    return np.array([x, y, 0.0, 0.0, clock, 0.0])
