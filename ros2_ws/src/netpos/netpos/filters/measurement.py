"""Measurement models, one scalar row per measured quantity.

A row is a float vector of ``ROW_WIDTH`` entries, so that an epoch of any mixture of sensors is one
array a compiled kernel can take:

    KIND, VALUE, VARIANCE (for the update), GATE_VARIANCE (of a single value: smaller where
    successive errors are correlated),
    BIAS, COMMON (state indices of the biases in it, or -1), GROUP (rows of one group are accepted
    or rejected together),
    ORIGIN 3 (RSU position, m), AXES 9 (rotation map -> RSU axes, row-major),
    HEADING (state index of the device's heading, or -1), LEVER 3 (of the antenna in the device, m;
    forward and left count only where there is a heading), BLOCKED (probability that the path was
    blocked; 0: the option's)

For ``LINEAR`` rows the first six entries of ORIGIN and AXES hold H of the six core states; the
position in it is that of the antenna. BIAS and COMMON of a ``STEP_VELOCITY`` are the person's
length factor and heading offset.
With d = p - origin and u = axes d:

    AZIMUTH    atan2(u_y, u_x)                          fokin2020:eq.13, 42
    ELEVATION  atan2(u_z, hypot(u_x, u_y))
    RANGE      |d|
    TOA        |d| + clock offset   (all in metres)     fokin2020:eq.41
    SPEED      hypot(vx, vy)
    COSINE_Y   u_y / |u|    direction cosine of a linear array's cone angle
    COSINE_Z   u_z / |u|
    PHASE      a d / |d|, known but for whole turns     petukhov:eq.5
    UNWRAPPED_PHASE   the same with its whole turns (a sector of ambiguity has been chosen)
    STEP_VELOCITY     LINEAR of the velocity a person's dead reckoning reports (``step_velocity``)

For both phases the first three entries of AXES hold a: 2 pi L / lambda times the unit vector of
the array from slave to master, in map. Range and TOA of such an array count from its master, L/2
along a.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from netpos.filters.compile import inlined, kernel, leaf
from netpos.filters.state import N_CORE, X
from netpos.filters.step_velocity import curvature, reported
from netpos.messages.values import Array


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
    PHASE = 8
    UNWRAPPED_PHASE = 9
    STEP_VELOCITY = 10


KIND, VALUE, VARIANCE, GATE_VARIANCE, BIAS, COMMON, GROUP, ORIGIN = range(8)
AXES = 10
HEADING, LEVER, BLOCKED = 19, 20, 23
ROW_WIDTH = 24


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
    return int(row[KIND]) <= Kind.ELEVATION


@inlined
def is_cyclic(row: Array) -> bool:
    """Whether innovations of the row are wrapped: an angle, or a phase known but for whole
    turns."""
    return is_angle(row) or int(row[KIND]) == Kind.PHASE


@leaf
def _phase(row: Array, dx: float, dy: float, dz: float, h: Array) -> float:
    """Phase difference of the offset d from the array's middle; its gradient to h."""
    r = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
    a = AXES
    value = (row[a] * dx + row[a + 1] * dy + row[a + 2] * dz) / r
    h[X.PX] = (row[a] - value * dx / r) / r
    h[X.PY] = (row[a + 1] - value * dy / r) / r
    return float(value)


@leaf
def direction(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Angle or direction cosine of the offset d in the RSU's axes, and its gradient in map."""
    a = AXES
    ux = row[a] * dx + row[a + 1] * dy + row[a + 2] * dz
    uy = row[a + 3] * dx + row[a + 4] * dy + row[a + 5] * dz
    uz = row[a + 6] * dx + row[a + 7] * dy + row[a + 8] * dz
    rho2 = max(ux * ux + uy * uy, 1e-12)
    r2 = rho2 + uz * uz
    kind = int(row[KIND])
    if kind == Kind.AZIMUTH:
        gx, gy, gz = -uy / rho2, ux / rho2, 0.0
        value = math.atan2(uy, ux)
    elif kind == Kind.ELEVATION:
        rho = math.sqrt(rho2)
        gx, gy, gz = -ux * uz / (rho * r2), -uy * uz / (rho * r2), rho / r2
        value = math.atan2(uz, rho)
    else:
        r = math.sqrt(r2)
        value = (uy if kind == Kind.COSINE_Y else uz) / r
        gx, gy, gz = -value * ux / r2, -value * uy / r2, -value * uz / r2
        if kind == Kind.COSINE_Y:
            gy += 1.0 / r
        else:
            gz += 1.0 / r
    return (
        value,
        gx * row[a] + gy * row[a + 3] + gz * row[a + 6],
        gx * row[a + 1] + gy * row[a + 4] + gz * row[a + 7],
        gx * row[a + 2] + gy * row[a + 5] + gz * row[a + 8],
    )


@leaf
def _turned_lever(row: Array, mean: Array) -> tuple[float, float]:
    """Lever arm of a row with a heading, in map."""
    heading = mean[int(row[HEADING])]
    c, s = math.cos(heading), math.sin(heading)
    return c * row[LEVER] - s * row[LEVER + 1], s * row[LEVER] + c * row[LEVER + 1]


@inlined
def _from_rsu(row: Array, mean: Array, height_m: float, h: Array) -> float:
    """Quantities of the offset between the RSU and the device's antenna."""
    x, y = mean[X.PX], mean[X.PY]
    heading = int(row[HEADING])
    lx = ly = 0.0
    if heading >= 0:
        lx, ly = _turned_lever(row, mean)
    dx = x + lx - row[ORIGIN]
    dy = y + ly - row[ORIGIN + 1]
    dz = height_m + row[LEVER + 2] - row[ORIGIN + 2]
    kind = int(row[KIND])
    if kind == Kind.TOA or kind == Kind.RANGE:
        value = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
        h[X.PX] = dx / value
        h[X.PY] = dy / value
        if kind == Kind.TOA:
            h[X.CLOCK] = 1.0
            value += mean[X.CLOCK]
    elif kind >= Kind.PHASE:
        value = _phase(row, dx, dy, dz, h)
    else:
        value, h[X.PX], h[X.PY], _ = direction(row, dx, dy, dz)
    if heading >= 0:
        h[heading] = h[X.PY] * lx - h[X.PX] * ly
    return float(value)


@inlined
def predict_row(row: Array, mean: Array, height_m: float, h: Array) -> float:
    """Predicted value of one row at ``mean`` (n,); fills its Jacobian ``h`` (n,). ``height_m``:
    device height in map."""
    for i in range(mean.size):
        h[i] = 0.0
    kind = int(row[KIND])
    value = 0.0
    if kind == Kind.LINEAR:
        for i in range(N_CORE):
            h[i] = row[ORIGIN + i]
            value += h[i] * mean[i]
        if row[HEADING] >= 0.0:
            lx, ly = _turned_lever(row, mean)
            value += h[X.PX] * lx + h[X.PY] * ly
            h[int(row[HEADING])] = h[X.PY] * lx - h[X.PX] * ly
    elif kind == Kind.STEP_VELOCITY:
        gx, gy = row[ORIGIN + 2], row[ORIGIN + 3]
        return float(reported(gx, gy, mean, int(row[BIAS]), int(row[COMMON]), h))
    elif kind == Kind.SPEED:
        value = math.sqrt(mean[X.VX] * mean[X.VX] + mean[X.VY] * mean[X.VY])
        h[X.VX] = mean[X.VX] / max(value, 1e-6)
        h[X.VY] = mean[X.VY] / max(value, 1e-6)
    else:
        value = _from_rsu(row, mean, height_m, h)
    for column in (BIAS, COMMON):
        index = int(row[column])
        if index >= 0:
            h[index] = 1.0
            value += mean[index]
    return value


@inlined
def innovation_row(row: Array, mean: Array, height_m: float, h: Array) -> float:
    """Measured minus predicted value of one row, wrapped where it is an angle; fills ``h``."""
    innovation = row[VALUE] - predict_row(row, mean, height_m, h)
    return wrap(innovation) if is_cyclic(row) else float(innovation)


@inlined
def range_second_order_variance(dx: float, dy: float, dz: float, cov: Array, axes: int) -> float:
    """Variance of the second-order term of the distance |d|, d = (dx, dy, dz), whose first
    ``axes`` components (2 or 3) have the covariance in the first entries of ``cov``.

    Half the trace of (h'' P)^2 (Bar-Shalom, Li and Kirubarajan 2001, eq. 10.3.3-12) with
    h'' = (I - u u') / |d|, u = d / |d|: exact for a Gaussian prior, wherever the RSU stands.
    """
    r2 = max(dx * dx + dy * dy + dz * dz, 1e-6)
    d = (dx, dy, dz)
    square, along, turned = 0.0, 0.0, 0.0  # trace P^2, u'Pu and |Pu|^2, without u's length
    for i in range(axes):
        Pd = 0.0
        for j in range(axes):
            Pd += cov[i, j] * d[j]
            square += cov[i, j] * cov[i, j]
        along += d[i] * Pd
        turned += Pd * Pd
    total = square - 2.0 * turned / r2 + (along / r2) ** 2
    return float(0.5 * max(total, 0.0) / r2)


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
    if kind == Kind.LINEAR or kind == Kind.SPEED:
        return 0.0
    if kind == Kind.STEP_VELOCITY:
        gx, gy = row[ORIGIN + 2], row[ORIGIN + 3]
        return float(curvature(gx, gy, mean, cov, int(row[BIAS]), int(row[COMMON])))
    dx = mean[X.PX] - row[ORIGIN]
    dy = mean[X.PY] - row[ORIGIN + 1]
    if row[HEADING] >= 0.0:
        lx, ly = _turned_lever(row, mean)
        dx += lx
        dy += ly
    dz = height_m + row[LEVER + 2] - row[ORIGIN + 2]
    if kind == Kind.TOA or kind == Kind.RANGE:
        return float(range_second_order_variance(dx, dy, dz, cov, 2))
    rho2 = dx * dx + dy * dy
    r2 = max(rho2 + dz * dz, 1e-6)
    square = cov[X.PX, X.PX] ** 2 + 2.0 * cov[X.PX, X.PY] ** 2 + cov[X.PY, X.PY] ** 2
    d2 = max(rho2, 1e-6) if kind == Kind.AZIMUTH else r2
    if kind >= Kind.PHASE:
        a = AXES
        square *= row[a] * row[a] + row[a + 1] * row[a + 1] + row[a + 2] * row[a + 2]
    return float(0.5 * square / (d2 * d2))


@leaf
def second_order_variance(row: Array, mean: Array, cov: Array, height_m: float) -> float:
    """``curvature_variance`` with what an azimuth's curvature really is: none along itself.

    Too small for an update to rely on near an RSU, where the azimuth bends within the prior; but
    what weighs a wide prior against a narrow one must not take the wide one for wider than it is.
    """
    if int(row[KIND]) != Kind.AZIMUTH or row[HEADING] >= 0.0 or row[AXES + 8] != 1.0:
        return float(curvature_variance(row, mean, cov, height_m))
    dx, dy = mean[X.PX] - row[ORIGIN], mean[X.PY] - row[ORIGIN + 1]
    rho4 = max(dx * dx + dy * dy, 1e-3) ** 2
    a, b = 2.0 * dx * dy / rho4, (dy * dy - dx * dx) / rho4  # h'' = [[a, b], [b, -a]]
    xx, xy, yy = cov[X.PX, X.PX], cov[X.PX, X.PY], cov[X.PY, X.PY]
    first, last = a * xx + b * xy, b * xy - a * yy
    return float(0.5 * (first**2 + last**2) + (a * xy + b * yy) * (b * xx - a * xy))


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
