"""Measurement rows in space: any quantity of ``measurement``, seen from a navigation state.

Rows are those of ``measurement``; with C and p of the state, the antenna stands at
a = p + C lever and d = a - origin. Rows of the kinds here hold a direction u in ORIGIN:

    PLACE          u . a              a position, one axis at a time     (deng2022:eq.8)
    BODY_VELOCITY  u . C' v           non-holonomic and zero-velocity constraints
    BODY_RATE      u . gyro bias      a gyro at rest shows nothing else

A TOA is a range plus the clock's offset where the state has one; the biases an RSU's rows name
are added (``error_state`` tells the order of the states).

With the error state of ``inertial.strapdown`` and r = C lever the Jacobian of a function of a
with gradient g is [g, 0, r x g, 0, 0].
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from netpos.filters.compile import kernel, leaf
from netpos.filters.measurement import (
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    KIND,
    LEVER,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
    direction,
    is_angle,
    range_second_order_variance,
    wrap,
)
from netpos.filters.state import Err, Nav
from netpos.inertial.strapdown import (
    ACCEL_BIAS,
    ATTITUDE_ERR,
    GYRO_BIAS,
    GYRO_BIAS_ERR,
    QUATERNION,
    VELOCITY,
    rotation_of,
)
from netpos.messages.values import Array


class SpaceKind(IntEnum):
    """What a row measures that a planar filter does not take; numbered on from ``Kind``."""

    PLACE = 11
    BODY_VELOCITY = 12
    BODY_RATE = 13


@leaf
def value_at(row: Array, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Predicted value of a row for an antenna at (x, y, z) in map, and its gradient there."""
    o = ORIGIN
    kind = int(row[KIND])
    if kind == SpaceKind.PLACE:
        value = row[o] * x + row[o + 1] * y + row[o + 2] * z
        return value, row[o], row[o + 1], row[o + 2]
    dx, dy, dz = x - row[o], y - row[o + 1], z - row[o + 2]
    if kind == Kind.RANGE or kind == Kind.TOA:
        r = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
        return r, dx / r, dy / r, dz / r
    return direction(row, dx, dy, dz)  # type: ignore[no-any-return]


@leaf
def innovation_at(row: Array, nav: Array, C: Array, h: Array) -> float:
    """Measured minus predicted value, wrapped where it is an angle; fills ``h`` (n,).

    nav : (n + 1,), C : (3, 3) its rotation matrix
    """
    h[:] = 0.0
    kind = int(row[KIND])
    u = ORIGIN
    if kind == SpaceKind.BODY_RATE:
        value = 0.0
        for i in range(3):
            h[GYRO_BIAS_ERR + i] = row[u + i]
            value += row[u + i] * nav[GYRO_BIAS + i]
        return float(row[VALUE] - value)
    if kind == SpaceKind.BODY_VELOCITY:
        value = 0.0
        for i in range(3):
            h[VELOCITY + i] = C[i, 0] * row[u] + C[i, 1] * row[u + 1] + C[i, 2] * row[u + 2]
            value += h[VELOCITY + i] * nav[VELOCITY + i]
        for i in range(3):  # (C u) x v
            j, k = (i + 1) % 3, (i + 2) % 3
            h[ATTITUDE_ERR + i] = (
                h[VELOCITY + j] * nav[VELOCITY + k] - h[VELOCITY + k] * nav[VELOCITY + j]
            )
        return float(row[VALUE] - value)
    a = LEVER
    rx = C[0, 0] * row[a] + C[0, 1] * row[a + 1] + C[0, 2] * row[a + 2]
    ry = C[1, 0] * row[a] + C[1, 1] * row[a + 1] + C[1, 2] * row[a + 2]
    rz = C[2, 0] * row[a] + C[2, 1] * row[a + 1] + C[2, 2] * row[a + 2]
    x, y, z = nav[Nav.PX] + rx, nav[Nav.PY] + ry, nav[Nav.PZ] + rz
    value, gx, gy, gz = value_at(row, x, y, z)
    h[Err.PX], h[Err.PY], h[Err.PZ] = gx, gy, gz
    h[Err.ROLL] = ry * gz - rz * gy
    h[Err.PITCH] = rz * gx - rx * gz
    h[Err.YAW] = rx * gy - ry * gx
    if kind == Kind.TOA and h.size > Err.CLOCK:
        h[Err.CLOCK] = 1.0
        value += nav[Nav.CLOCK]
    for column in (BIAS, COMMON):
        index = int(row[column])
        if Err.CLOCK < index < h.size:  # a state without clock and biases takes none
            h[index] = 1.0
            value += nav[index + 1]
    difference = row[VALUE] - value
    return float(wrap(difference)) if is_angle(row) else float(difference)


@leaf
def bend_variance(row: Array, nav: Array, cov: Array) -> float:
    """Variance of what linearising ``row`` leaves out, for the position covariance in ``cov``:
    ``measurement.curvature_variance`` in space (lever arm left out)."""
    kind = int(row[KIND])
    if kind >= SpaceKind.PLACE:
        return 0.0
    d0 = nav[Nav.PX] - row[ORIGIN]
    d1 = nav[Nav.PY] - row[ORIGIN + 1]
    d2 = nav[Nav.PZ] - row[ORIGIN + 2]
    if kind == Kind.RANGE or kind == Kind.TOA:
        return float(range_second_order_variance(d0, d1, d2, cov, 3))
    rho2 = max(d0 * d0 + d1 * d1, 1e-6)
    r2 = rho2 + d2 * d2
    square = 0.0
    for i in range(3):
        for j in range(3):
            square += cov[i, j] * cov[i, j]
    if kind == Kind.AZIMUTH:
        plane = (
            cov[Err.PX, Err.PX] ** 2 + 2.0 * cov[Err.PX, Err.PY] ** 2 + cov[Err.PY, Err.PY] ** 2
        )
        return float(0.5 * plane / (rho2 * rho2))
    return float(0.5 * square / (r2 * r2))


@kernel
def linearise_in_space(rows: Array, nav: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Innovations (m,), Jacobian H (m, n) and ``bend_variance`` (m,) of ``rows`` (m, ROW_WIDTH) at
    nav (n + 1,), cov (n, n)."""
    m = rows.shape[0]
    innovation, H, bend = np.empty(m), np.empty((m, cov.shape[0])), np.empty(m)
    C = np.empty((3, 3))
    rotation_of(nav[QUATERNION:ACCEL_BIAS], C)
    for i in range(m):
        innovation[i] = innovation_at(rows[i], nav, C, H[i])
        bend[i] = bend_variance(rows[i], nav, cov)
    return innovation, H, bend


def direction_rows(
    kind: SpaceKind, directions: Array, values: Array, variances: Array, group: int
) -> Array:
    """Rows (..., ROW_WIDTH) of one group: components ``values`` (...) of a vector along
    ``directions`` (..., 3)."""
    rows = np.zeros((*values.shape, ROW_WIDTH))
    rows[..., KIND] = kind
    rows[..., VALUE] = values
    rows[..., VARIANCE] = rows[..., GATE_VARIANCE] = variances
    rows[..., BIAS] = rows[..., COMMON] = rows[..., HEADING] = -1
    rows[..., GROUP] = group
    rows[..., ORIGIN : ORIGIN + 3] = directions
    return rows


def place_rows(
    position: Array, cov: Array, lever: tuple[float, float, float], group: int = 0
) -> Array:
    """Decorrelated rows (..., 3, ROW_WIDTH) of position fixes (..., 3) m of an antenna at
    ``lever`` in base_link.

    Raises ``LinAlgError`` where a ``cov`` (..., 3, 3) is not positive definite.
    """
    factor = np.linalg.cholesky((cov + np.swapaxes(cov, -1, -2)) / 2.0)
    directions = np.linalg.inv(factor)
    values = np.einsum("...ij,...j->...i", directions, position)
    rows = direction_rows(SpaceKind.PLACE, directions, values, np.ones_like(values), group)
    rows[..., LEVER : LEVER + 3] = lever
    return rows
