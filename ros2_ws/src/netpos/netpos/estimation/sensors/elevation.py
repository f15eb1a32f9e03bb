"""Elevation of the device in the axes of the RSU: atan2(u_z, hypot(u_x, u_y)), u = axes d."""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined, leaf
from netpos.estimation.sensors.geometry import in_map_axes, in_rsu_axes, largest_second_order
from netpos.estimation.sensors.model import Sensor, Wraps, angle_reading
from netpos.messages.values import AngleConvention, Array


@leaf
def elevation(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Elevation of the offset d [rad] and its gradient."""
    ux, uy, uz = in_rsu_axes(row, dx, dy, dz)
    rho2 = max(ux * ux + uy * uy, 1e-12)
    r2 = rho2 + uz * uz
    rho = math.sqrt(rho2)
    gx, gy, gz = in_map_axes(row, -ux * uz / (rho * r2), -uy * uz / (rho * r2), rho / r2)
    return math.atan2(uz, rho), gx, gy, gz


@inlined
def bound(_row: Array, dx: float, dy: float, dz: float, cov: Array, axes: int) -> float:
    """Half the trace of (h'' P)^2 with a curvature of 1 / r^2 in every direction; up to 45 deg."""
    return float(largest_second_order(max(dx * dx + dy * dy + dz * dz, 1e-6), cov, axes))


SENSOR = Sensor(
    name="ELEVATION",
    kind=1,
    of_offset=elevation,
    second_order=bound,
    is_bound=True,
    wraps=Wraps.ALWAYS,
    in_strapdown=True,
    bias_sd="elevation_bias_sd_rad",
    reading=angle_reading(
        "elevation", convention=AngleConvention.SPHERICAL, simulated="elevation"
    ),
)
