"""Measurement models, one scalar row per measured quantity.

A row is a float vector of ``ROW_WIDTH`` entries, so that an epoch of any mixture of sensors is one
array a compiled kernel can take:

    KIND, VALUE, VARIANCE (for the update), GATE_VARIANCE (of a single value: smaller where
    successive errors are correlated),
    BIAS, COMMON (state indices of the biases in it, or -1), GROUP (rows of one group are accepted
    or rejected together),
    ORIGIN 3 (RSU position, m), AXES 9 (rotation map -> RSU axes, row-major)

For ``LINEAR`` rows the first six entries of ORIGIN and AXES hold H of the six core states.
With d = p - origin and u = axes d:

    AZIMUTH    atan2(u_y, u_x)                          fokin2020:eq.13, 42
    ELEVATION  atan2(u_z, hypot(u_x, u_y))
    RANGE      |d|
    TOA        |d| + clock offset   (all in metres)     fokin2020:eq.41
    SPEED      hypot(vx, vy)
    COSINE_Y   u_y / |u|    direction cosine of a linear array's cone angle
    COSINE_Z   u_z / |u|
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from netpos.filters.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement


class Kind(IntEnum):
    """What a row measures."""

    AZIMUTH = 0
    ELEVATION = 1
    TOA = 2
    RANGE = 3
    LINEAR = 4
    SPEED = 5
    COSINE_Y = 6
    COSINE_Z = 7


KIND, VALUE, VARIANCE, GATE_VARIANCE, BIAS, COMMON, GROUP, ORIGIN, AXES = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    10,
)
ROW_WIDTH = 19


@njit(cache=True)
def wrap(angle: float) -> float:
    """Angle wrapped to [-pi, pi); constant time for any finite input."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True)
def _direction_row(row: Array, mean: Array, height_m: float, h: Array) -> float:
    """Angles and direction cosines in the RSU's axes."""
    A = row[AXES:].reshape(3, 3)
    d = np.array([mean[0] - row[ORIGIN], mean[1] - row[ORIGIN + 1], height_m - row[ORIGIN + 2]])
    u = A @ d
    rho2 = max(u[0] * u[0] + u[1] * u[1], 1e-12)
    r2 = rho2 + u[2] * u[2]
    kind = int(row[KIND])
    if kind == Kind.AZIMUTH:
        gradient = np.array([-u[1], u[0], 0.0]) / rho2
        value = math.atan2(u[1], u[0])
    elif kind == Kind.ELEVATION:
        rho = math.sqrt(rho2)
        gradient = np.array([-u[0] * u[2] / rho, -u[1] * u[2] / rho, rho]) / r2
        value = math.atan2(u[2], rho)
    else:
        axis = 1 if kind == Kind.COSINE_Y else 2
        r = math.sqrt(r2)
        value = u[axis] / r
        gradient = -value * u / r2
        gradient[axis] += 1.0 / r
    for i in range(2):
        h[i] = gradient[0] * A[0, i] + gradient[1] * A[1, i] + gradient[2] * A[2, i]
    return value


@njit(cache=True)
def _range_row(row: Array, mean: Array, height_m: float, h: Array) -> float:
    dx = mean[0] - row[ORIGIN]
    dy = mean[1] - row[ORIGIN + 1]
    dz = height_m - row[ORIGIN + 2]
    d = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
    h[0] = dx / d
    h[1] = dy / d
    if int(row[KIND]) == Kind.TOA:
        h[4] = 1.0
        return d + float(mean[4])
    return d


@njit(cache=True)
def predict_row(row: Array, mean: Array, height_m: float, h: Array) -> float:
    """Predicted value of one row at ``mean`` (n,); fills its Jacobian ``h`` (n,). ``height_m``:
    device height in map."""
    h[:] = 0.0
    kind = int(row[KIND])
    value = 0.0
    if kind == Kind.TOA or kind == Kind.RANGE:
        value = _range_row(row, mean, height_m, h)
    elif kind == Kind.LINEAR:
        for i in range(6):
            h[i] = row[ORIGIN + i]
            value += h[i] * mean[i]
    elif kind == Kind.SPEED:
        value = math.hypot(mean[2], mean[3])
        h[2] = mean[2] / max(value, 1e-6)
        h[3] = mean[3] / max(value, 1e-6)
    else:
        value = _direction_row(row, mean, height_m, h)
    for column in (BIAS, COMMON):
        index = int(row[column])
        if index >= 0:
            h[index] = 1.0
            value += mean[index]
    return value


@njit(cache=True)
def curvature_variance(row: Array, mean: Array, cov: Array, height_m: float) -> float:
    """Variance of what linearising ``row`` at ``mean`` (n,) leaves out, for a prior ``cov`` (n,
    n).

    Half the trace of (h'' P)^2 of the second-order extended Kalman filter (Bar-Shalom, Li and
    Kirubarajan 2001, eq. 10.3.3-12), with the largest curvature of the quantity. It keeps a device
    that may be anywhere around an RSU from being placed on top of it.
    """
    kind = int(row[KIND])
    if kind in (Kind.LINEAR, Kind.SPEED):
        return 0.0
    dx = mean[0] - row[ORIGIN]
    dy = mean[1] - row[ORIGIN + 1]
    dz = height_m - row[ORIGIN + 2]
    rho2 = dx * dx + dy * dy
    r2 = max(rho2 + dz * dz, 1e-6)
    if kind in (Kind.TOA, Kind.RANGE):
        across = dy * dy * cov[0, 0] - 2.0 * dx * dy * cov[0, 1] + dx * dx * cov[1, 1]
        return float(0.5 * (across / max(rho2, 1e-6)) ** 2 / r2)
    square = cov[0, 0] ** 2 + 2.0 * cov[0, 1] ** 2 + cov[1, 1] ** 2
    d2 = max(rho2, 1e-6) if kind == Kind.AZIMUTH else r2
    return float(0.5 * square / (d2 * d2))


@njit(cache=True)
def linearise(rows: Array, mean: Array, height_m: float) -> tuple[Array, Array]:
    """Innovations (m,) and Jacobian H (m, n) of ``rows`` (m, ROW_WIDTH) at ``mean``; angle
    innovations are wrapped."""
    m = rows.shape[0]
    innovation = np.empty(m)
    H = np.empty((m, mean.size))
    for i in range(m):
        innovation[i] = rows[i, VALUE] - predict_row(rows[i], mean, height_m, H[i])
        if int(rows[i, KIND]) <= Kind.ELEVATION:
            innovation[i] = wrap(innovation[i])
    return innovation, H


def rsu_axes(info: RsuInfo) -> Array:
    """Rotation map -> RSU axes, row-major (9,), of the RSU's pose."""
    axes: Array = Rotation.from_quat(info.quaternion).as_matrix().T.reshape(-1)
    return axes


@dataclass(frozen=True, slots=True)
class Coupling:
    """How the slow and coloured errors of one RSU enter its rows, by kind; what is absent is white
    and unbiased."""

    bias: Mapping[Kind, int]  # state index of the RSU's own bias
    common: Mapping[Kind, int]  # state index of the bias its network shares
    inflation: Mapping[Kind, float]  # variance factor of correlated noise


UNCOUPLED = Coupling({}, {}, {})


def scalar_values(
    m: RsuMeasurement, convention: AngleConvention
) -> Iterator[tuple[Kind, float, float]]:
    """Kind, value and variance of each scalar quantity in a measurement, in units of the rows."""
    c = SPEED_OF_LIGHT_MPS
    cone = convention is AngleConvention.CONE
    if m.fields & Field.AZIMUTH:
        if cone:
            yield Kind.COSINE_Y, math.sin(m.azimuth_rad), _cosine_var(m.azimuth_rad, m.azimuth_var)
        else:
            yield Kind.AZIMUTH, m.azimuth_rad, m.azimuth_var
    if m.fields & Field.ELEVATION:
        if cone:
            variance = _cosine_var(m.elevation_rad, m.elevation_var)
            yield Kind.COSINE_Z, math.sin(m.elevation_rad), variance
        else:
            yield Kind.ELEVATION, m.elevation_rad, m.elevation_var
    if m.fields & Field.TOA:
        yield Kind.TOA, c * m.toa_s, c * c * m.toa_var
    if m.fields & Field.RANGE:
        yield Kind.RANGE, m.range_m, m.range_var


def _cosine_var(angle: float, variance: float) -> float:
    """Variance of sin(angle), at end-fire no smaller than the second-order term."""
    return max(math.cos(angle) ** 2 * variance, variance * variance / 2.0)


def rsu_rows(
    m: RsuMeasurement, info: RsuInfo, axes: Array, group: int, coupling: Coupling = UNCOUPLED
) -> Array:
    """Rows (m, ROW_WIDTH) of one RSU measurement; a position fix becomes two decorrelated LINEAR
    rows.

    axes : (9,) of ``rsu_axes``
    """
    rows = []
    for kind, value, variance in scalar_values(m, info.angle_convention):
        row = np.empty(ROW_WIDTH)
        row[KIND], row[VALUE], row[GROUP] = kind, value, group
        row[VARIANCE] = variance * coupling.inflation.get(kind, 1.0)
        row[GATE_VARIANCE] = variance
        row[BIAS] = coupling.bias.get(kind, -1)
        row[COMMON] = coupling.common.get(kind, -1)
        row[ORIGIN:AXES] = info.position
        row[AXES:] = axes
        rows.append(row)
    out = np.array(rows).reshape(-1, ROW_WIDTH)
    if m.fields & Field.POSITION:
        fix = linear_rows(m.position[:2], m.position_cov[:2, :2], np.eye(2, 6), group)
        out = np.vstack([out, fix])
    return out


def linear_rows(value: Array, cov: Array, H: Array, group: int) -> Array:
    """Rows of a linear measurement ``value = H x + noise`` with full covariance, decorrelated by
    its Cholesky factor.

    value (m,), cov (m, m) positive definite, H (m, 6) of the core states. Raises ``LinAlgError``
    where cov is not.
    """
    L = np.linalg.cholesky(cov)
    rows = np.zeros((len(value), ROW_WIDTH))
    rows[:, KIND] = Kind.LINEAR
    rows[:, VALUE] = np.linalg.solve(L, value)
    rows[:, VARIANCE] = rows[:, GATE_VARIANCE] = 1.0
    rows[:, BIAS] = rows[:, COMMON] = -1
    rows[:, GROUP] = group
    rows[:, ORIGIN : ORIGIN + 6] = np.linalg.solve(L, H)
    return rows


def speed_row(speed_mps: float, variance: float, group: int) -> Array:
    """Row (1, ROW_WIDTH) of a ground-speed measurement."""
    row = np.zeros((1, ROW_WIDTH))
    row[0, :ORIGIN] = Kind.SPEED, speed_mps, variance, variance, -1, -1, group
    return row
