"""What the RSUs measure of a beacon: who hears it, the true quantities, their variances, the
noise.

    azimuth   = atan2(dy, dx) in the RSU's axes                        (fokin2020:eq.13)
    elevation = atan2(dz, hypot(dx, dy)) in the RSU's axes
    toa       = |d| / c + clock offset of the device - clock error of the RSU
                                                                       (fokin2020:eq.14)
    range     = |d|, two-way, free of the clock
    phase     = -2 pi L / lambda y / |d| of a two-antenna anchor, wrapped (netpos.radio.anchor)

Range and TOA of an anchor count from its master antenna.

Noise depends on (seed, RSU, device, stamp) only, so any process, live or offline, draws the same
measurement."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from netpos.radio.clocks import clock_error
from netpos.radio.noise import Key, draw_normals, draw_uniform
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

Direction = tuple[float, float, float]

QUANTITIES = ("azimuth", "elevation", "toa", "range", "phase")
"""What is simulated: names of the columns of values and variances."""
AZIMUTH, ELEVATION, TOA, RANGE, PHASE = range(5)
ALWAYS_VISIBLE = -1
_ROUNDING = 1.0 + 1e-12  # squared distances may be compared within this factor only


class Sites(NamedTuple):
    """The RSUs (m) as one device meets them."""

    position: Array  # (m, 3) m, map
    rotation: Array  # (m, 3, 3) map to RSU axes
    noise_key: Key  # (m, 2)
    sight_key: Key  # (m, 2)
    clock_tones: Array  # (m, k, 3) of clocks.clock_tones; k = 0: perfect clocks
    baseline_m: Array  # (m,) of a two-antenna anchor; 0: none
    wavelength_m: Array  # (m,)
    range_scale: Array  # (m,) what two-way ranging leaves of the clocks' drift
    range_offset_m: Array  # (m,)


class Sight(NamedTuple):
    """Who hears a beacon: the nearest RSUs with a line of sight."""

    nearest: int
    max_distance_m: float  # plane distance, d_los
    buildings: Array  # (k, 4)
    model: int  # index into LOS_MODELS or ALWAYS_VISIBLE
    correlation_m: float
    device_height_m: float
    fewest: int = 1 << 30  # below nearest: a number drawn evenly from fewest to nearest is heard


class Errors(NamedTuple):
    """Variances of the quantities, either fixed or from the Cramér-Rao bound at the RSU's
    distance (not of a phase)."""

    fixed: Array  # (5,) rad^2, rad^2, s^2, m^2, rad^2; used where snr_at_0_db_loss is 0
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
    values: Array  # (n, nearest, 5) azimuth rad, elevation rad, toa s, range m, phase rad
    variances: Array  # (n, nearest, 5)
    rssi_dbm: Array  # (n, nearest), 0 where not modelled


def los_model_number(model: LosModel | None) -> int:
    """Number of a line-of-sight model for ``Sight.model``."""
    return ALWAYS_VISIBLE if model is None else LOS_MODELS.index(model)


@njit(cache=True)
def _in_axes(position: Array, k: int, sites: Sites) -> tuple[float, float, float]:
    """Offset of a device from RSU k in the RSU's axes [m]."""
    x = position[0] - sites.position[k, 0]
    y = position[1] - sites.position[k, 1]
    z = position[2] - sites.position[k, 2]
    turn = sites.rotation[k]
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@njit(cache=True)
def _hears(
    position: Array, k: int, plane_m: float, sites: Sites, sight: Sight, half_view_rad: float
) -> bool:
    """Whether RSU k, ``plane_m`` away, sees the device and serves its direction."""
    if plane_m > sight.max_distance_m:
        return False
    site = sites.position[k]
    if segment_blocked(position[0], position[1], site[0], site[1], sight.buildings):
        return False
    if sight.model >= 0:
        chance = los_chance(sight.model, plane_m, sight.device_height_m)
        key = sites.sight_key[k]
        if smooth_uniform(position[0], position[1], sight.correlation_m, key) >= chance:
            return False
    if plane_m > 0.0 and half_view_rad >= math.pi:
        return True
    x, y, z = _in_axes(position, k, sites)
    return x * x + y * y + z * z > 0.0 and abs(math.atan2(y, x)) <= half_view_rad


@njit(cache=True)
def _nearest_hearing(
    position: Array,
    sites: Sites,
    sight: Sight,
    half_view_rad: float,
    hint: Ints,
    found: Ints,
    plane: Array,
) -> int:
    """Fill ``found`` and ``plane`` (nearest,) with the nearest RSUs that hear the device and their
    plane distances; returns their number. Equal distances: lower index first.

    The RSUs of ``hint`` (those of the last beacon; -1: none) are tried first: they make the circle
    small, and only RSUs inside it need their line of sight tested.
    """
    nearest, count = found.size, 0
    reach2 = sight.max_distance_m**2 * _ROUNDING
    for step in range(hint.size + sites.position.shape[0]):
        k = hint[step] if step < hint.size else step - hint.size
        if k < 0:
            continue
        x, y = position[0] - sites.position[k, 0], position[1] - sites.position[k, 1]
        square = x * x + y * y
        if square > reach2:
            continue
        away = math.sqrt(square)
        place = count  # where k belongs among those found
        known = False
        for j in range(count):
            known |= found[j] == k
            if place == count and (away < plane[j] or (away == plane[j] and k < found[j])):
                place = j
        if known or place == nearest:
            continue
        if not _hears(position, k, away, sites, sight, half_view_rad):
            continue
        count = min(count + 1, nearest)
        for j in range(count - 1, place, -1):
            found[j], plane[j] = found[j - 1], plane[j - 1]
        found[place], plane[place] = k, away
        if count == nearest:
            reach2 = plane[nearest - 1] ** 2 * _ROUNDING
    return count


@njit(cache=True)
def _cross_moment(moment: Array, a: Direction, b: Direction) -> float:
    """a' moment b."""
    total = 0.0
    for i in range(3):
        total += a[i] * (moment[i, 0] * b[0] + moment[i, 1] * b[1] + moment[i, 2] * b[2])
    return total


@njit(cache=True)
def _variances(
    azimuth: float, elevation: float, distance: float, errors: Errors
) -> tuple[tuple[float, float, float, float], float]:
    """Variances of all quantities but the phase, and the received power [dBm], 0 where not
    modelled."""
    if errors.snr_at_0_db_loss == 0.0:
        fixed = errors.fixed
        return (fixed[0], fixed[1], fixed[2], fixed[3]), 0.0
    loss_db = path_loss_db(distance, errors.path_loss)
    snr = errors.snr_at_0_db_loss * 10.0 ** (-loss_db / 10.0)
    scale = 2.0 * snr * (2.0 * math.pi) ** 2
    ca, sa = math.cos(azimuth), math.sin(azimuth)
    moment = errors.second_moment
    toa = 1.0 / (2.0 * snr * (2.0 * math.pi * errors.rms_bandwidth_hz) ** 2)
    by_distance = SPEED_OF_LIGHT_MPS**2 * toa
    power = errors.tx_power_dbm - loss_db
    if not errors.with_elevation:
        by_azimuth = (-sa, ca, 0.0)
        along = scale * _cross_moment(moment, by_azimuth, by_azimuth)
        return (1.0 / along, 0.0, toa, by_distance), power
    ce, se = math.cos(elevation), math.sin(elevation)
    by_azimuth = (-sa * ce, ca * ce, 0.0)
    by_elevation = (-ca * se, -sa * se, ce)
    along = scale * _cross_moment(moment, by_azimuth, by_azimuth)
    up = scale * _cross_moment(moment, by_elevation, by_elevation)
    cross = scale * _cross_moment(moment, by_azimuth, by_elevation)
    determinant = along * up - cross * cross
    return (up / determinant, along / determinant, toa, by_distance), power


@njit(cache=True)
def _wrap(angle: float) -> float:
    """In [-pi, pi), also where rounding would give pi."""
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped if wrapped < math.pi else -math.pi


@njit(cache=True)
def _phase(stamp_ns: int, k: int, cosine: float, sites: Sites, sd: float) -> float:
    """Noisy phase difference of a device whose direction has ``cosine`` with the y axis of anchor
    k (petukhov:eq.5)."""
    turns = -sites.baseline_m[k] / sites.wavelength_m[k] * cosine
    noise = draw_normals(stamp_ns, 1, 0, sites.noise_key[k])[0]
    return float(_wrap(2.0 * math.pi * turns + sd * noise))


@njit(cache=True)
def _measure(
    stamp_ns: int,
    position: Array,
    clock_offset_s: float,
    k: int,
    sites: Sites,
    errors: Errors,
    values: Array,
    variances: Array,
) -> float:
    """Fill ``values`` and ``variances`` (5,) with what RSU k measures of a beacon; returns the
    received power [dBm]."""
    x, y, z = _in_axes(position, k, sites)
    distance = math.sqrt(x * x + y * y + z * z)
    azimuth = math.atan2(y, x)
    elevation = math.atan2(z, math.hypot(x, y)) if z != 0.0 else z
    var, rssi_dbm = _variances(azimuth, elevation, distance, errors)
    noise = draw_normals(stamp_ns, 0, 0, sites.noise_key[k])
    values[AZIMUTH] = _wrap(azimuth + math.sqrt(var[AZIMUTH]) * noise[AZIMUTH])
    values[ELEVATION] = elevation + math.sqrt(var[ELEVATION]) * noise[ELEVATION]
    rsu_clock_s = clock_error(stamp_ns * 1e-9, sites.clock_tones[k])
    to_master = distance
    if sites.baseline_m[k] > 0.0:
        to_master = math.hypot(math.hypot(x, z), y + sites.baseline_m[k] / 2.0)
        sd = math.sqrt(errors.fixed[PHASE])
        values[PHASE] = _phase(stamp_ns, k, y / distance, sites, sd)
        variances[PHASE] = errors.fixed[PHASE]
    delay = to_master / SPEED_OF_LIGHT_MPS + clock_offset_s - rsu_clock_s
    values[TOA] = delay + math.sqrt(var[TOA]) * noise[TOA]
    ranged = to_master * (1.0 + sites.range_scale[k]) + sites.range_offset_m[k]
    values[RANGE] = ranged + math.sqrt(var[RANGE]) * noise[RANGE]
    for quantity in range(4):
        variances[quantity] = var[quantity]
    return float(rssi_dbm)


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
    values = np.zeros((n, nearest, len(QUANTITIES)))
    variances = np.zeros((n, nearest, len(QUANTITIES)))
    rssi = np.zeros((n, nearest))
    plane = np.empty(nearest)
    hint = np.full(nearest, -1, dtype=np.int64)
    for i in range(n):
        position = positions[i]
        heard_by[i] = _nearest_hearing(
            position, sites, sight, errors.half_view_rad, hint, rsu[i], plane
        )
        hint = rsu[i].copy()
        if sight.fewest < nearest:
            share = draw_uniform(stamps_ns[i], 1, sites.noise_key[0])  # 0 is its noise
            most = sight.fewest + int(share * (nearest - sight.fewest + 1))
            heard_by[i] = min(heard_by[i], most)
            rsu[i, heard_by[i] :] = -1
        for j in range(heard_by[i]):
            rssi[i, j] = _measure(
                stamps_ns[i],
                position,
                clock_offsets_s[i],
                rsu[i, j],
                sites,
                errors,
                values[i, j],
                variances[i, j],
            )
    return Observations(heard_by, rsu, values, variances, rssi)
