"""What the RSUs measure of a beacon: who hears it, the true quantities, their variances, the
noise.

    azimuth   = atan2(dy, dx) in the RSU's axes                        (fokin2020:eq.13)
    elevation = atan2(dz, hypot(dx, dy)) in the RSU's axes
    toa       = |d| / c + clock offset                                 (fokin2020:eq.14)
    range     = |d|, two-way, free of the clock

Noise depends on (seed, RSU, device, stamp) only, so any process, live or offline, draws the same
measurement."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from netpos.radio.noise import Key, draw_normals
from netpos.radio.propagation import (
    LOS_MODELS,
    SPEED_OF_LIGHT_MPS,
    LosModel,
    los_chance,
    path_loss_db,
    smooth_uniform,
)
from netpos.world.buildings import segment_blocked

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

AZIMUTH, ELEVATION, TOA, RANGE = range(4)  # columns of values and variances
ALWAYS_VISIBLE = -1


class Sites(NamedTuple):
    """The RSUs (m) as one device meets them."""

    position: Array  # (m, 3) m, map
    rotation: Array  # (m, 3, 3) map to RSU axes
    noise_key: Key  # (m, 2)
    sight_key: Key  # (m, 2)


class Sight(NamedTuple):
    """Who hears a beacon: the nearest RSUs with a line of sight."""

    nearest: int
    max_distance_m: float  # plane distance, d_los
    buildings: Array  # (k, 4)
    model: int  # index into LOS_MODELS or ALWAYS_VISIBLE
    correlation_m: float
    device_height_m: float


class Errors(NamedTuple):
    """Variances of the four quantities, either fixed or from the Cramér-Rao bound at the RSU's
    distance."""

    fixed: Array  # (4,) rad^2, rad^2, s^2, m^2; used where snr_at_0_db_loss is 0
    with_elevation: bool  # azimuth and elevation are estimated together
    snr_at_0_db_loss: float  # of Waveform, times the number of elements; 0: fixed variances
    path_loss: Array  # (5,) of PathLoss.coefficients
    second_moment: Array  # (3, 3) of AntennaArray
    rms_bandwidth_hz: float
    half_view_rad: float
    tx_power_dbm: float


class Observations(NamedTuple):
    """Measurements of n beacons; row i has ``heard_by[i]`` of them, nearest RSU first."""

    heard_by: Ints  # (n,) number of RSUs
    rsu: Ints  # (n, nearest) index of the RSU, -1 where none
    values: Array  # (n, nearest, 4) azimuth rad, elevation rad, toa s, range m
    variances: Array  # (n, nearest, 4)
    rssi_dbm: Array  # (n, nearest), 0 where not modelled


def los_model_number(model: LosModel | None) -> int:
    """Number of a line-of-sight model for ``Sight.model``."""
    return ALWAYS_VISIBLE if model is None else LOS_MODELS.index(model)


@njit(cache=True)
def _sees(position: Array, site: Array, plane_m: float, sight: Sight, key: Key) -> bool:
    if plane_m > sight.max_distance_m:
        return False
    if segment_blocked(position[0], position[1], site[0], site[1], sight.buildings):
        return False
    if sight.model < 0:
        return True
    chance = los_chance(sight.model, plane_m, sight.device_height_m)
    return bool(smooth_uniform(position[0], position[1], sight.correlation_m, key) < chance)


@njit(cache=True)
def _variances(
    azimuth: float, elevation: float, distance: float, errors: Errors, out: Array
) -> float:
    """Fill ``out`` (4,); returns the received power [dBm], 0 where not modelled."""
    if errors.snr_at_0_db_loss == 0.0:
        out[:] = errors.fixed
        return 0.0
    loss_db = path_loss_db(distance, errors.path_loss)
    snr = errors.snr_at_0_db_loss * 10.0 ** (-loss_db / 10.0)
    scale = 2.0 * snr * (2.0 * math.pi) ** 2
    ca, sa = math.cos(azimuth), math.sin(azimuth)
    ce, se = math.cos(elevation), math.sin(elevation)
    if not errors.with_elevation:
        ce, se = 1.0, 0.0
    by_azimuth = np.array([-sa * ce, ca * ce, 0.0])
    by_elevation = np.array([-ca * se, -sa * se, ce])
    along = scale * np.sum(by_azimuth * (errors.second_moment @ by_azimuth))
    up = scale * np.sum(by_elevation * (errors.second_moment @ by_elevation))
    cross = scale * np.sum(by_azimuth * (errors.second_moment @ by_elevation))
    if errors.with_elevation:
        determinant = along * up - cross * cross
        out[AZIMUTH] = up / determinant
        out[ELEVATION] = along / determinant
    else:
        out[AZIMUTH] = 1.0 / along
        out[ELEVATION] = 0.0
    out[TOA] = 1.0 / (2.0 * snr * (2.0 * math.pi * errors.rms_bandwidth_hz) ** 2)
    out[RANGE] = SPEED_OF_LIGHT_MPS**2 * out[TOA]
    return float(errors.tx_power_dbm - loss_db)


@njit(cache=True)
def observe(
    stamps_ns: Ints,
    positions: Array,
    clock_offsets_s: Array,
    sites: Sites,
    sight: Sight,
    errors: Errors,
) -> Observations:
    """Measurements of the beacons of one device at stamps (n,), antenna positions (n, 3) m and
    clock offsets (n,) s."""
    n, nearest = stamps_ns.size, sight.nearest
    heard_by = np.zeros(n, dtype=np.int64)
    rsu = np.full((n, nearest), -1, dtype=np.int64)
    values = np.zeros((n, nearest, 4))
    variances = np.zeros((n, nearest, 4))
    rssi = np.zeros((n, nearest))
    for i in range(n):
        offset = positions[i] - sites.position
        plane = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2)
        for k in np.argsort(plane, kind="mergesort"):
            j = heard_by[i]
            if j == nearest:
                break
            if not _sees(positions[i], sites.position[k], plane[k], sight, sites.sight_key[k]):
                continue
            d = np.zeros(3)
            for row in range(3):
                for column in range(3):
                    d[row] += sites.rotation[k, row, column] * offset[k, column]
            distance = math.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
            azimuth = math.atan2(d[1], d[0])
            if distance == 0.0 or abs(azimuth) > errors.half_view_rad:
                continue
            elevation = math.atan2(d[2], math.hypot(d[0], d[1]))
            rssi[i, j] = _variances(azimuth, elevation, distance, errors, variances[i, j])
            noise = draw_normals(stamps_ns[i], 0, 0, sites.noise_key[k])
            sd = np.sqrt(variances[i, j])
            turned = azimuth + sd[AZIMUTH] * noise[AZIMUTH]
            values[i, j, AZIMUTH] = (turned + math.pi) % (2.0 * math.pi) - math.pi
            values[i, j, ELEVATION] = elevation + sd[ELEVATION] * noise[ELEVATION]
            values[i, j, TOA] = (
                distance / SPEED_OF_LIGHT_MPS + clock_offsets_s[i] + sd[TOA] * noise[TOA]
            )
            values[i, j, RANGE] = distance + sd[RANGE] * noise[RANGE]
            rsu[i, j] = k
            heard_by[i] += 1
    return Observations(heard_by, rsu, values, variances, rssi)
