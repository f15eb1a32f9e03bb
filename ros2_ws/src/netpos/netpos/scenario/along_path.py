"""Simulated stations along a real path, and their simulated measurements.

For recordings with a true path and a real IMU but without stations: the stations are on a square
grid as in deng2022, ``heights`` above the nearest part of the way, and measure with its errors.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos.radio.measure import (
    ALWAYS_VISIBLE,
    AZIMUTH,
    ELEVATION,
    RANGE,
    Errors,
    Observations,
    Sight,
    observe,
)
from netpos.radio.noise import generator
from netpos.scenario.build import rotations_of, sites_of

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

SPACING_M = 100.0
HEIGHTS_M = (5.0, 15.0)
AZIMUTH_SD_RAD, ELEVATION_SD_RAD, RANGE_SD_M = math.radians(8.5), math.radians(2.5), 1.0
FIELDS = Field.AZIMUTH | Field.ELEVATION | Field.RANGE


def stations_along(path: Array, seed: int) -> tuple[RsuInfo, ...]:
    """Stations within two spacings of a path (n, 3) m, heights from the stream ``rsus/height``."""
    low = np.floor(path[:, :2].min(axis=0) / SPACING_M) - 2
    high = np.ceil(path[:, :2].max(axis=0) / SPACING_M) + 2
    x, y = (np.arange(a, b + 1) * SPACING_M for a, b in zip(low, high, strict=True))
    places = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
    away, nearest = cKDTree(path[:, :2]).query(places)
    heights = generator(seed, "rsus/height").uniform(*HEIGHTS_M, len(places))
    heights += path[nearest, 2]
    kept = np.flatnonzero(away <= 2 * SPACING_M)
    return tuple(
        RsuInfo(rsu_id=f"rsu_{i + 1:03d}", position=np.array([*places[k], heights[k]]), stamp_ns=1)
        for i, k in enumerate(kept.tolist())
    )


def observe_along(
    stations: tuple[RsuInfo, ...],
    stamps_ns: Stamps,
    antenna: Array,
    seed: int,
    vue_id: str,
    *,
    fewest: int,
    nearest: int,
) -> Observations:
    """Measurements of the antenna (n, 3) at stamps (n,) by ``fewest`` to ``nearest`` stations."""
    perfect = np.zeros((len(stations), 0, 3))
    sites = sites_of(stations, rotations_of(stations), perfect, seed, vue_id)
    none = np.zeros((0, 4))
    sight = Sight(nearest, math.inf, none, ALWAYS_VISIBLE, 50.0, 0.0, fewest)
    errors = Errors(
        fixed=np.square([AZIMUTH_SD_RAD, ELEVATION_SD_RAD, 0.0, RANGE_SD_M]),
        with_elevation=False,
        snr_at_0_db_loss=0.0,
        path_loss=np.zeros(5),
        second_moment=np.zeros((3, 3)),
        rms_bandwidth_hz=0.0,
        half_view_rad=math.pi,
        tx_power_dbm=0.0,
    )
    seen: Observations = observe(stamps_ns, antenna, np.zeros(len(antenna)), sites, sight, errors)
    return seen


def measurements_of(
    seen: Observations,
    stations: tuple[RsuInfo, ...],
    stamps_ns: Stamps,
    vue_id: str,
    lever_arm: tuple[float, float, float],
) -> list[RsuMeasurement]:
    """The observations as messages."""
    return [
        RsuMeasurement(
            stamp_ns=int(stamps_ns[i]),
            rsu_id=stations[int(seen.rsu[i, j])].rsu_id,
            vue_id=vue_id,
            sequence=i,
            expected=int(seen.heard_by[i]),
            fields=FIELDS,
            azimuth_rad=float(seen.values[i, j, AZIMUTH]),
            azimuth_var=float(seen.variances[i, j, AZIMUTH]),
            elevation_rad=float(seen.values[i, j, ELEVATION]),
            elevation_var=float(seen.variances[i, j, ELEVATION]),
            range_m=float(seen.values[i, j, RANGE]),
            range_var=float(seen.variances[i, j, RANGE]),
            lever_arm=lever_arm,
        )
        for i in range(len(stamps_ns))
        for j in range(int(seen.heard_by[i]))
    ]
