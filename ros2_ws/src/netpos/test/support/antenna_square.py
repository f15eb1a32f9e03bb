"""A device with three antennas in a square of four RSUs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from netpos.messages.values import (
    Array,
    Field,
    Odometry,
    RsuInfo,
    RsuMeasurement,
)
from netpos.tracking import Tracker, TrackerConfig, TrackOutput

T0_NS = 1_000_000_000
HEIGHT_M = 1.0
CORNERS = {
    f"a{k}": np.array([x, y, HEIGHT_M])
    for k, (x, y) in enumerate(((-10.0, -10.0), (10.0, -10.0), (10.0, 10.0), (-10.0, 10.0)))
}
ANTENNAS = {"left": (0.5, 0.4, 0.0), "right": (0.5, -0.4, 0.0), "back": (-0.6, 0.0, 0.0)}
Path = Callable[[float], tuple[float, float, float]]


def standing(yaw: float) -> Path:
    return lambda _: (1.0, 2.0, yaw)


def circle(t_s: float) -> tuple[float, float, float]:
    """Left around the middle at 0.3 rad/s, facing outwards: never the way it moves."""
    angle = 0.3 * t_s
    return 4.0 * math.cos(angle), 4.0 * math.sin(angle), angle


def measure(
    path: Path,
    t_s: float,
    rng: np.random.Generator | None = None,
    sd: float = 0.05,
    antennas: dict[str, tuple[float, float, float]] = ANTENNAS,
) -> list[RsuMeasurement]:
    """Ranges of every antenna to every corner."""
    x, y, yaw = path(t_s)
    c, s = math.cos(yaw), math.sin(yaw)
    result = []
    for name, corner in CORNERS.items():
        for antenna, (lx, ly, lz) in antennas.items():
            place = np.array([x + c * lx - s * ly, y + s * lx + c * ly, HEIGHT_M + lz])
            noise = 0.0 if rng is None else rng.normal(0.0, sd)
            result.append(
                RsuMeasurement(
                    stamp_ns=T0_NS + round(t_s * 1e9),
                    rsu_id=f"{name}_{antenna}",
                    vue_id="vue_1",
                    expected=len(CORNERS) * len(antennas),
                    fields=Field.RANGE,
                    range_m=float(np.linalg.norm(place - corner)) + noise,
                    range_var=sd**2,
                    lever_arm=(lx, ly, lz),
                )
            )
    return result


def tracker(**config: Any) -> Tracker:
    values = {
        "motion_model": "rigid_body",
        "device_height_m": HEIGHT_M,
        "hold_s": 0.0,
        "accel_density_mps2_sqrthz": 0.5,
        "turn_rate_density": 0.5,
        "initial_speed_sd_mps": 1.5,
        "coverage_radius_m": 20.0,
    }
    made = Tracker(TrackerConfig(**(values | config)))
    for name, corner in CORNERS.items():
        for antenna in ANTENNAS:
            made.add_rsu(RsuInfo(rsu_id=f"{name}_{antenna}", position=corner))
    return made


def followed(
    path: Path, seconds: float, seed: int, feed: Any, target: Tracker | None = None, **options: Any
) -> list[tuple[float, TrackOutput]]:
    """Time and report of every epoch, ten per second."""
    target, rng = target or tracker(), np.random.default_rng(seed)
    result = []
    for k in range(round(seconds * 10)):
        (report,) = feed(target, measure(path, 0.1 * k, rng, **options))
        result.append((0.1 * k, report))
    return result


def yaw_of(odometry: Odometry) -> float:
    return 2.0 * math.atan2(odometry.quaternion[2], odometry.quaternion[3])


def heading_error(path: Path, t_s: float, odometry: Odometry) -> float:
    return math.remainder(yaw_of(odometry) - path(t_s)[2], math.tau)


def errors(path: Path, reports: list[tuple[float, TrackOutput]]) -> tuple[Array, Array]:
    """Position errors (n, 2) m and heading errors (n,) rad."""
    found = [(t, r.odometry) for t, r in reports if r.odometry is not None]
    place = np.array([o.position[:2] - path(t)[:2] for t, o in found])
    return place, np.array([heading_error(path, t, o) for t, o in found])
