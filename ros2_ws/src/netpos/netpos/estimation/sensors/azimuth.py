"""Azimuth of the device in the axes of the RSU: atan2(u_y, u_x), u = axes d.

fokin2020:eq.13, 42.
"""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined, leaf
from netpos.estimation.sensors.geometry import in_map_axes, in_rsu_axes, largest_second_order
from netpos.estimation.sensors.model import Sensor, Wraps, angle_reading
from netpos.estimation.sensors.row import AXES
from netpos.estimation.state import X
from netpos.messages.values import AngleConvention, Array


@leaf
def azimuth(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Azimuth of the offset d [rad] and its gradient."""
    ux, uy, _ = in_rsu_axes(row, dx, dy, dz)
    rho2 = max(ux * ux + uy * uy, 1e-12)
    gx, gy, gz = in_map_axes(row, -uy / rho2, ux / rho2, 0.0)
    return math.atan2(uy, ux), gx, gy, gz


@inlined
def bound(_row: Array, dx: float, dy: float, _dz: float, cov: Array, _axes: int) -> float:
    """Half the trace of (h'' P)^2 with the largest curvature in both directions of the plane; of
    upright axes."""
    return float(largest_second_order(max(dx * dx + dy * dy, 1e-6), cov, 2))


@inlined
def exact(row: Array, dx: float, dy: float, dz: float, cov: Array, axes: int) -> float:
    """Half the trace of (h'' P)^2: an azimuth does not bend along itself. Of upright axes; else
    ``bound``."""
    if row[AXES + 8] != 1.0:
        return float(bound(row, dx, dy, dz, cov, axes))
    rho4 = max(dx * dx + dy * dy, 1e-3) ** 2
    a, b = 2.0 * dx * dy / rho4, (dy * dy - dx * dx) / rho4  # h'' = [[a, b], [b, -a]]
    xx, xy, yy = cov[X.PX, X.PX], cov[X.PX, X.PY], cov[X.PY, X.PY]
    first, last = a * xx + b * xy, b * xy - a * yy
    return float(0.5 * (first**2 + last**2) + (a * xy + b * yy) * (b * xx - a * xy))


SENSOR = Sensor(
    name="AZIMUTH",
    kind=0,
    of_offset=azimuth,
    second_order=bound,
    is_bound=True,
    exact_second_order=exact,
    wraps=Wraps.ALWAYS,
    in_strapdown=True,
    bias_sd="azimuth_bias_sd_rad",
    reading=angle_reading("azimuth", convention=AngleConvention.SPHERICAL, simulated="azimuth"),
)
