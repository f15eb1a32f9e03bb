"""Rows of measurements in a planar filter: predicted values, gradients, innovations.

A row (``sensors.row``) is of one sensor (``sensors.table``). With the antenna at a and d = a - RSU
the value of a row is a function of d, or of the state; to it come the device's clock offset where
the sensor has it (fokin2020:eq.41), and the states BIAS and COMMON of the row. Where the state has
the height of the device (HEIGHT), d is a function of three states, and so is what linearising
leaves out.
"""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import inlined, kernel, leaf, link, local_array
from netpos.estimation.dispatch import Kernel, choose, is_one_of
from netpos.estimation.sensors.geometry import turned_lever
from netpos.estimation.sensors.model import Wraps
from netpos.estimation.sensors.row import (
    AXES,
    BIAS,
    BLOCKED,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    HEIGHT,
    KIND,
    LEVER,
    ORIGIN,
    OUTLIER_SHARE,
    REFERENCE,
    ROW_WIDTH,
    SAME_BEND,
    VALUE,
    VARIANCE,
)
from netpos.estimation.sensors.table import SENSORS, Kind
from netpos.estimation.state import X
from netpos.messages.values import Array

__all__ = [
    "AXES",
    "BIAS",
    "BLOCKED",
    "COMMON",
    "GATE_VARIANCE",
    "GROUP",
    "HEADING",
    "HEIGHT",
    "KIND",
    "LEVER",
    "ORIGIN",
    "OUTLIER_SHARE",
    "REFERENCE",
    "ROW_WIDTH",
    "SAME_BEND",
    "SAME_BEND_S",
    "VALUE",
    "VARIANCE",
    "Kind",
    "curvature_mean",
    "curvature_variance",
    "has_clock",
    "innovation_row",
    "innovation_variance",
    "is_angle",
    "is_cyclic",
    "is_range",
    "linearise",
    "of_offset",
    "offset_up",
    "part_kind",
    "predict_row",
    "same_bend_variance",
    "second_order_mean_of_offset",
    "second_order_of_offset",
    "second_order_variance",
    "slow_error_of",
    "wrap",
]

SAME_BEND_S = 1.0
"""Values of an RSU have the same bend, what linearising leaves out, for so long where the device
stays."""
_SAME_BEND_WAY = 0.05  # of the distance


@inlined
def _no_value(
    _row: Array, _dx: float, _dy: float, _dz: float
) -> tuple[float, float, float, float]:
    return math.nan, math.nan, math.nan, math.nan


@inlined
def _no_state_value(_row: Array, _mean: Array, _h: Array) -> float:
    return math.nan


@inlined
def _no_second_order(
    _row: Array, _dx: float, _dy: float, _dz: float, _cov: Array, _axes: int
) -> float:
    return 0.0


@inlined
def _no_state_second_order(_row: Array, _mean: Array, _cov: Array) -> float:
    return 0.0


of_offset = choose([(s.kind, s.of_offset) for s in SENSORS], _no_value)
"""``(kind, row, dx, dy, dz)``: value and gradient (3) in map for an offset d = antenna - RSU."""
second_order_of_offset = choose(
    [(s.kind, s.second_order) for s in SENSORS if s.of_offset], _no_second_order
)
"""``(kind, row, dx, dy, dz, cov, axes)``: variance of what linearising leaves out, or a bound."""
_exact_second_order = choose([(s.kind, s.exact_second_order) for s in SENSORS], _no_second_order)
second_order_mean_of_offset = choose(
    [(s.kind, s.second_order_mean) for s in SENSORS], _no_second_order
)
"""``(kind, row, dx, dy, dz, cov, axes)``: how far the mean value is above that of the mean."""
_FOR_UPDATE, _EXACT, _OF_MEAN = range(3)  # which second-order term
_of_state = choose([(s.kind, s.of_state) for s in SENSORS], _no_state_value)
_state_second_order = choose(
    [(s.kind, s.second_order) for s in SENSORS if s.of_state], _no_state_second_order
)

_has_state_model = is_one_of(s.kind for s in SENSORS if s.of_state)
_has_second_order_mean = is_one_of(s.kind for s in SENSORS if s.second_order_mean)
_has_exact_second_order = is_one_of(s.kind for s in SENSORS if s.exact_second_order)
_adds_biases = is_one_of(s.kind for s in SENSORS if s.adds_biases)
_has_clock = is_one_of(s.kind for s in SENSORS if s.has_clock)
_is_angle = is_one_of(s.kind for s in SENSORS if s.wraps == Wraps.ALWAYS)
_is_cyclic = is_one_of(s.kind for s in SENSORS if s.wraps != Wraps.NEVER)
_is_range = is_one_of(s.kind for s in SENSORS if s.is_range)


def _always(kind: int) -> Kernel:
    @link
    def constant() -> int:
        return kind

    return constant  # type: ignore[no-any-return]


part_kind = choose(
    [(s.kind, _always(s.difference_of)) for s in SENSORS if s.difference_of >= 0], _always(-1)
)
"""``(kind)``: kind of the quantity of which a row is the difference between two RSUs; -1: of
none."""


@inlined
def wrap(angle: float) -> float:
    """Angle wrapped to [-pi, pi); constant time for any finite input."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return -math.pi if wrapped >= math.pi else wrapped


@inlined
def is_angle(row: Array) -> bool:
    """Whether differences of the row's predictions are wrapped."""
    return bool(_is_angle(int(row[KIND])))


@inlined
def is_cyclic(row: Array) -> bool:
    """Whether innovations of the row are wrapped: an angle, or a phase known but for whole
    turns."""
    return bool(_is_cyclic(int(row[KIND])))


@inlined
def is_range(row: Array) -> bool:
    """Whether the row is a distance, by a two-way range or a time of arrival: what a blocked path
    makes late."""
    return bool(_is_range(int(row[KIND])))


@inlined
def has_clock(row: Array) -> bool:
    """Whether the device's clock offset is part of the row's value."""
    return bool(_has_clock(int(row[KIND])))


@inlined
def _lever(row: Array, mean: Array) -> tuple[float, float]:
    """Horizontal lever arm in map; 0 where no heading turns it."""
    if row[HEADING] >= 0.0:
        lx, ly = turned_lever(row, mean)
        return lx, ly
    return 0.0, 0.0


@inlined
def offset_up(row: Array, mean: Array, height_m: float) -> float:
    """How far the antenna is above the RSU [m]; ``height_m``: nominal height of the device."""
    dz = height_m + row[LEVER + 2] - row[ORIGIN + 2]
    height = int(row[HEIGHT])
    return float(dz + mean[height] if height > 0 else dz)


@inlined
def _offset(row: Array, mean: Array, height_m: float) -> tuple[float, float, float]:
    """Offset d of the device's antenna from the RSU, in map [m]."""
    lx, ly = _lever(row, mean)
    dx, dy = mean[X.PX] + lx - row[ORIGIN], mean[X.PY] + ly - row[ORIGIN + 1]
    return dx, dy, offset_up(row, mean, height_m)


@inlined
def _from_rsu(kind: int, row: Array, mean: Array, height_m: float, h: Array) -> float:
    """Value of a sensor of the offset between the RSU and the device's antenna."""
    dx, dy, dz = _offset(row, mean, height_m)
    value, h[X.PX], h[X.PY], up = of_offset(kind, row, dx, dy, dz)
    height = int(row[HEIGHT])
    if height > 0:
        h[height] = up
    if has_clock(row):
        h[X.CLOCK] = 1.0
        value += mean[X.CLOCK]
    heading = int(row[HEADING])
    if heading >= 0:
        lx, ly = _lever(row, mean)
        h[heading] = h[X.PY] * lx - h[X.PX] * ly
    return float(value)


@inlined
def predict_row(row: Array, mean: Array, height_m: float, h: Array) -> float:
    """Predicted value of one row at ``mean`` (n,); fills its Jacobian ``h`` (n,). ``height_m``:
    nominal height of the device in map. NaN for a kind that no sensor has."""
    for i in range(mean.size):
        h[i] = 0.0
    kind = int(row[KIND])
    if _has_state_model(kind):
        value = float(_of_state(kind, row, mean, h))
    else:
        value = _from_rsu(kind, row, mean, height_m, h)
    if _adds_biases(kind):
        for column in (BIAS, COMMON):
            index = int(row[column])
            if index >= 0:
                h[index] = 1.0
                value += mean[index]
        reference = int(row[REFERENCE])
        if reference > 0:
            h[reference] = -1.0
            value -= mean[reference]
    return value


@inlined
def slow_error_of(row: Array) -> int:
    """Index of the state that is the RSU's own slow error in the row; -1: it has none."""
    return int(row[BIAS]) if _adds_biases(int(row[KIND])) else -1


@inlined
def innovation_row(row: Array, mean: Array, height_m: float, h: Array) -> float:
    """Measured minus predicted value of one row, wrapped where it is an angle; fills ``h``."""
    innovation = row[VALUE] - predict_row(row, mean, height_m, h)
    return wrap(innovation) if is_cyclic(row) else float(innovation)


@leaf
def _second_order_in_3d(
    term: int, kind: int, row: Array, d: tuple[float, float, float], cov: Array
) -> float:
    """Second-order ``term`` of a row for a prior ``cov`` (n, n) of position and height."""
    P, height = local_array(3, 3), int(row[HEIGHT])
    for a in range(2):
        P[a, 2] = P[2, a] = cov[a, height]
        for b in range(2):
            P[a, b] = cov[a, b]
    P[2, 2] = cov[height, height]
    if term == _OF_MEAN:
        return float(second_order_mean_of_offset(kind, row, d[0], d[1], d[2], P, 3))
    if term == _EXACT:
        return float(_exact_second_order(kind, row, d[0], d[1], d[2], P, 3))
    return float(second_order_of_offset(kind, row, d[0], d[1], d[2], P, 3))


@inlined
def curvature_variance(row: Array, mean: Array, cov: Array, height_m: float) -> float:
    """Variance of what linearising ``row`` at ``mean`` (n,) leaves out, for a prior ``cov`` (n,
    n).

    Half the trace of (h'' P)^2 of the second-order extended Kalman filter (Bar-Shalom, Li and
    Kirubarajan 2001, eq. 10.3.3-12): exact for ranges and times, with the largest curvature of the
    quantity for angles and phases. It keeps a device that may be anywhere around an RSU from being
    placed on top of it.
    """
    kind = int(row[KIND])
    if _has_state_model(kind):
        return float(_state_second_order(kind, row, mean, cov))
    dx, dy, dz = _offset(row, mean, height_m)
    if row[HEIGHT] > 0.0:
        return float(_second_order_in_3d(_FOR_UPDATE, kind, row, (dx, dy, dz), cov))
    return float(second_order_of_offset(kind, row, dx, dy, dz, cov, 2))


@inlined
def curvature_mean(row: Array, mean: Array, cov: Array, height_m: float) -> float:
    """How far the mean value of ``row`` is above that at ``mean`` (n,), for a prior ``cov`` (n,
    n): half the trace of h'' P of the second-order extended Kalman filter (Bar-Shalom, Li and
    Kirubarajan 2001, eq. 10.3.3-10)."""
    kind = int(row[KIND])
    if not _has_second_order_mean(kind):
        return 0.0
    dx, dy, dz = _offset(row, mean, height_m)
    if row[HEIGHT] > 0.0:
        return float(_second_order_in_3d(_OF_MEAN, kind, row, (dx, dy, dz), cov))
    return float(second_order_mean_of_offset(kind, row, dx, dy, dz, cov, 2))


@leaf
def second_order_variance(row: Array, mean: Array, cov: Array, height_m: float) -> float:
    """``curvature_variance`` with the true curvature of a sensor that has a bound there: an
    azimuth does not bend along itself.

    Too small for an update to rely on near an RSU, where the azimuth bends within the prior; but
    what weighs a wide prior against a narrow one must not take the wide one for wider than it is.
    """
    kind = int(row[KIND])
    if row[HEADING] >= 0.0 or not _has_exact_second_order(kind):
        return float(curvature_variance(row, mean, cov, height_m))
    dx, dy = mean[X.PX] - row[ORIGIN], mean[X.PY] - row[ORIGIN + 1]
    dz = offset_up(row, mean, height_m)
    if row[HEIGHT] > 0.0:
        return float(_second_order_in_3d(_EXACT, kind, row, (dx, dy, dz), cov))
    return float(_exact_second_order(kind, row, dx, dy, dz, cov, 2))


@leaf
def same_bend_variance(
    row: Array, mean: Array, cov: Array, height_m: float, second_order_var: float
) -> float:
    """``second_order_var``, the ``curvature_variance`` of ``row``, and the true curvature once for
    every other value with the same bend: as white noise of that variance they together count as
    one. In the unit of the row, squared.

    Where the device of ``mean`` (n,) moves, they are those of a twentieth of its distance to the
    RSU: farther on the direction has turned, and with the square of the distance the bend is
    another one by a tenth.
    """
    if row[SAME_BEND] == 0.0:
        return second_order_var
    values = 1.0 + row[SAME_BEND]
    dx, dy = mean[X.PX] - row[ORIGIN], mean[X.PY] - row[ORIGIN + 1]
    near = _SAME_BEND_WAY * math.sqrt(dx * dx + dy * dy)
    way = SAME_BEND_S * math.sqrt(mean[X.VX] ** 2 + mean[X.VY] ** 2)
    if way > near:
        values = max(values * near / way, 1.0)
    others = (values - 1.0) * second_order_variance(row, mean, cov, height_m)
    return float(second_order_var + others)


@leaf
def innovation_variance(
    row: Array, mean: Array, cov: Array, height_m: float, variance: float, h: Array
) -> float:
    """Variance of the row's innovation: ``variance``, what linearising leaves out, and the prior
    ``cov`` (n, n) along the row's Jacobian ``h`` (n,) at ``mean`` (n,)."""
    total = variance + curvature_variance(row, mean, cov, height_m)
    for a in range(mean.size):
        if h[a] != 0.0:
            for b in range(mean.size):
                total += h[a] * cov[a, b] * h[b]
    return float(total)


@kernel
def linearise(rows: Array, mean: Array, height_m: float) -> tuple[Array, Array]:
    """Innovations (m,) and Jacobian H (m, n) of ``rows`` (m, ROW_WIDTH) at ``mean``; angle
    innovations are wrapped."""
    m = rows.shape[0]
    innovation = np.empty(m)
    H = np.empty((m, mean.size))
    for i in range(m):
        innovation[i] = innovation_row(rows[i], mean, height_m, H[i])
    return innovation, H
