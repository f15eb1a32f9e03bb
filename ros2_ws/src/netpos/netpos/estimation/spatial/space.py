"""Rows of measurements in a spatial filter: any sensor, seen from a navigation state.

With p, v and the attitude C of the state the antenna is at a = p + C lever, and d = a - RSU. A
sensor of d is the same function as in a planar filter (``measurement.of_offset``); others are
functions of a or of the whole state. A TOA is a range plus the clock's offset where the state has
one; the biases an RSU's rows name are added (``error_state`` tells the order of the states).

With the error state of ``inertial.strapdown`` and r = C lever the Jacobian of a function of a
with gradient g is [g, 0, r x g, 0, 0].
"""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import inlined, kernel, leaf
from netpos.estimation.dispatch import choose, is_one_of
from netpos.estimation.measurement import (
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    KIND,
    LEVER,
    ORIGIN,
    REFERENCE,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
    has_clock,
    is_cyclic,
    of_offset,
    second_order_mean_of_offset,
    second_order_of_offset,
    wrap,
)
from netpos.estimation.sensors.table import SENSORS
from netpos.estimation.state import Err, Nav
from netpos.estimation.update.conditioning import (
    Robust,
    RobustOptions,
    m_estimate,
    may_be_late,
    nlos_correct,
)
from netpos.inertial.navigation_state import ACCEL_BIAS, QUATERNION
from netpos.inertial.strapdown import rotation_of
from netpos.messages.values import Array


@inlined
def _no_antenna_value(
    _row: Array, _x: float, _y: float, _z: float
) -> tuple[float, float, float, float]:
    return math.nan, math.nan, math.nan, math.nan


@inlined
def _no_navigation_value(_row: Array, _nav: Array, _C: Array, _h: Array) -> float:
    return math.nan


_of_antenna = choose([(s.kind, s.of_antenna) for s in SENSORS], _no_antenna_value)
_of_navigation = choose([(s.kind, s.of_navigation) for s in SENSORS], _no_navigation_value)
_has_antenna_model = is_one_of(s.kind for s in SENSORS if s.of_antenna)
_has_navigation_model = is_one_of(s.kind for s in SENSORS if s.of_navigation)
_has_offset_model = is_one_of(s.kind for s in SENSORS if s.of_offset)
_adds_biases = is_one_of(s.kind for s in SENSORS if s.adds_biases)


@leaf
def value_at(row: Array, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Predicted value of a row for an antenna at (x, y, z) in map, and its gradient there."""
    kind = int(row[KIND])
    if _has_antenna_model(kind):
        return _of_antenna(kind, row, x, y, z)  # type: ignore[no-any-return]
    dx, dy, dz = x - row[ORIGIN], y - row[ORIGIN + 1], z - row[ORIGIN + 2]
    return of_offset(kind, row, dx, dy, dz)  # type: ignore[no-any-return]


@inlined
def _lever(row: Array, C: Array) -> tuple[float, float, float]:
    """Lever arm of the antenna, in map."""
    a = LEVER
    return (
        C[0, 0] * row[a] + C[0, 1] * row[a + 1] + C[0, 2] * row[a + 2],
        C[1, 0] * row[a] + C[1, 1] * row[a + 1] + C[1, 2] * row[a + 2],
        C[2, 0] * row[a] + C[2, 1] * row[a + 1] + C[2, 2] * row[a + 2],
    )


@inlined
def _of_position(row: Array, nav: Array, C: Array, h: Array) -> float:
    """Value of a sensor of the antenna's position."""
    rx, ry, rz = _lever(row, C)
    x, y, z = nav[Nav.PX] + rx, nav[Nav.PY] + ry, nav[Nav.PZ] + rz
    value, gx, gy, gz = value_at(row, x, y, z)
    h[Err.PX], h[Err.PY], h[Err.PZ] = gx, gy, gz
    h[Err.ROLL] = ry * gz - rz * gy
    h[Err.PITCH] = rz * gx - rx * gz
    h[Err.YAW] = rx * gy - ry * gx
    if has_clock(row) and h.size > Err.CLOCK:
        h[Err.CLOCK] = 1.0
        value += nav[Nav.CLOCK]
    return float(value)


@leaf
def innovation_at(row: Array, nav: Array, C: Array, h: Array) -> float:
    """Measured minus predicted value, wrapped where it is an angle; fills ``h`` (n,).

    nav : (n + 1,), C : (3, 3) its rotation matrix
    """
    h[:] = 0.0
    kind = int(row[KIND])
    if _has_navigation_model(kind):
        value = float(_of_navigation(kind, row, nav, C, h))
    else:
        value = _of_position(row, nav, C, h)
    if _adds_biases(kind):
        for column in (BIAS, COMMON):
            index = int(row[column])
            if Err.CLOCK < index < h.size:  # a state without clock and biases takes none
                h[index] = 1.0
                value += nav[index + 1]
        reference = int(row[REFERENCE])
        if Err.CLOCK < reference < h.size:
            h[reference] = -1.0
            value -= nav[reference + 1]
    difference = row[VALUE] - value
    return float(wrap(difference)) if is_cyclic(row) else float(difference)


@inlined
def _away(row: Array, nav: Array) -> tuple[float, float, float]:
    """Offset of the device from the RSU in map [m], its lever arm left out."""
    dx, dy = nav[Nav.PX] - row[ORIGIN], nav[Nav.PY] - row[ORIGIN + 1]
    return dx, dy, nav[Nav.PZ] - row[ORIGIN + 2]


@leaf
def bend_variance(row: Array, nav: Array, cov: Array) -> float:
    """Variance of what linearising ``row`` leaves out, for the position covariance in ``cov``:
    ``measurement.curvature_variance`` in space (lever arm left out)."""
    kind = int(row[KIND])
    if not _has_offset_model(kind):
        return 0.0
    dx, dy, dz = _away(row, nav)
    return float(second_order_of_offset(kind, row, dx, dy, dz, cov, 3))


@leaf
def bend_mean(row: Array, nav: Array, cov: Array) -> float:
    """How far the mean value of ``row`` is above that of the mean, for the position covariance in
    ``cov``: ``measurement.curvature_mean`` in space (lever arm left out)."""
    dx, dy, dz = _away(row, nav)
    return float(second_order_mean_of_offset(int(row[KIND]), row, dx, dy, dz, cov, 3))


@kernel
def linearise_in_space(rows: Array, nav: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Innovations (m,) from the mean values, Jacobian H (m, n) and ``bend_variance`` (m,) of
    ``rows`` (m, ROW_WIDTH) at nav (n + 1,), cov (n, n)."""
    m = rows.shape[0]
    innovation, H, bend = np.empty(m), np.empty((m, cov.shape[0])), np.empty(m)
    C = np.empty((3, 3))
    rotation_of(nav[QUATERNION:ACCEL_BIAS], C)
    for i in range(m):
        innovation[i] = innovation_at(rows[i], nav, C, H[i]) - bend_mean(rows[i], nav, cov)
        bend[i] = bend_variance(rows[i], nav, cov)
    return innovation, H, bend


@kernel
def reweight_3d(nav: Array, cov: Array, rows: Array, options: RobustOptions) -> None:
    """Re-weight ``rows`` (m, ROW_WIDTH) in place, as seen from a prior nav (n + 1,), cov (n, n) of
    ``error_state``."""
    innovations, H, second_order_var = linearise_in_space(rows, nav, cov)
    if options.nlos_probability > 0.0:
        for i in range(rows.shape[0]):
            if may_be_late(rows[i]):
                innovation_var = rows[i, VARIANCE] + second_order_var[i] + H[i] @ cov @ H[i]
                before = rows[i, VALUE]
                prior, excess_m = options.nlos_probability, options.nlos_excess_m
                nlos_correct(rows[i], innovations[i], innovation_var, prior, excess_m)
                innovations[i] += rows[i, VALUE] - before
    if options.kind != Robust.NONE:
        m_estimate(cov, rows, innovations, H, second_order_var, options)


def direction_rows(
    kind: Kind, directions: Array, values: Array, variances: Array, group: int
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
    rows = direction_rows(Kind.PLACE, directions, values, np.ones_like(values), group)
    rows[..., LEVER : LEVER + 3] = lever
    return rows
