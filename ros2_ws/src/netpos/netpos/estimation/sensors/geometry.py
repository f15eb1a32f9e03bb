"""Geometry that several sensors share."""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined, leaf
from netpos.estimation.sensors.row import AXES, HEADING, LEVER
from netpos.estimation.state import X
from netpos.messages.values import Array


@inlined
def in_rsu_axes(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float]:
    """The offset d, in map, in the axes of the RSU."""
    a = AXES
    return (
        row[a] * dx + row[a + 1] * dy + row[a + 2] * dz,
        row[a + 3] * dx + row[a + 4] * dy + row[a + 5] * dz,
        row[a + 6] * dx + row[a + 7] * dy + row[a + 8] * dz,
    )


@inlined
def in_map_axes(row: Array, gx: float, gy: float, gz: float) -> tuple[float, float, float]:
    """The gradient g, in the axes of the RSU, in map: the inverse of ``in_rsu_axes``."""
    a = AXES
    return (
        gx * row[a] + gy * row[a + 3] + gz * row[a + 6],
        gx * row[a + 1] + gy * row[a + 4] + gz * row[a + 7],
        gx * row[a + 2] + gy * row[a + 5] + gz * row[a + 8],
    )


@leaf
def turned_lever(row: Array, mean: Array) -> tuple[float, float]:
    """Horizontal lever arm of a row with a heading, in map."""
    heading = mean[int(row[HEADING])]
    c, s = math.cos(heading), math.sin(heading)
    return c * row[LEVER] - s * row[LEVER + 1], s * row[LEVER] + c * row[LEVER + 1]


@inlined
def squared_entries(cov: Array, axes: int) -> float:
    """Sum of the squared entries of the position's covariance, the first ``axes`` of ``cov``."""
    if axes == 2:
        xx, xy, yy = cov[X.PX, X.PX], cov[X.PX, X.PY], cov[X.PY, X.PY]
        return float(xx**2 + 2.0 * xy**2 + yy**2)
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += cov[i, j] * cov[i, j]
    return total


@inlined
def largest_second_order(r2: float, cov: Array, axes: int) -> float:
    """Half the trace of (h'' P)^2 for a curvature 1 / r^2 in every direction: a bound for the
    direction seen from a distance ``r2`` = r^2 [m^2]."""
    return float(0.5 * squared_entries(cov, axes) / (r2 * r2))
