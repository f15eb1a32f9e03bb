"""Cone angles of linear arrays along the y and z axes of the RSU.

A linear array measures the direction cosine u_y / |u| (u_z / |u|), u = axes d. The message holds
the angle whose sine it is; the row holds the cosine.
"""

from __future__ import annotations

import math

from netpos.filters.compile import inlined, leaf
from netpos.filters.sensors.elevation import bound
from netpos.filters.sensors.geometry import in_map_axes, in_rsu_axes
from netpos.filters.sensors.model import Reading, Sensor
from netpos.messages.values import AngleConvention, Array, Field


@leaf
def cosine_y(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Direction cosine of the offset d with the y axis, and its gradient."""
    ux, uy, uz = in_rsu_axes(row, dx, dy, dz)
    r2 = max(ux * ux + uy * uy, 1e-12) + uz * uz
    r = math.sqrt(r2)
    value = uy / r
    gx, gy, gz = in_map_axes(row, -value * ux / r2, -value * uy / r2 + 1.0 / r, -value * uz / r2)
    return value, gx, gy, gz


@leaf
def cosine_z(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Direction cosine of the offset d with the z axis, and its gradient."""
    ux, uy, uz = in_rsu_axes(row, dx, dy, dz)
    r2 = max(ux * ux + uy * uy, 1e-12) + uz * uz
    r = math.sqrt(r2)
    value = uz / r
    gx, gy, gz = in_map_axes(row, -value * ux / r2, -value * uy / r2, -value * uz / r2 + 1.0 / r)
    return value, gx, gy, gz


@inlined
def sine(angle: float, variance: float) -> tuple[float, float]:
    """Sine of a cone angle [rad] and its variance: at end-fire no smaller than the second-order
    term."""
    of_sine = max(math.cos(angle) ** 2 * variance, variance * variance / 2.0)
    return math.sin(angle), of_sine


SENSORS = (
    Sensor(
        name="COSINE_Y",
        kind=6,
        of_offset=cosine_y,
        second_order=bound,
        is_bound=True,
        in_strapdown=True,
        bias_sd="azimuth_bias_sd_rad",
        reading=Reading(
            quantity="azimuth",
            field=Field.AZIMUTH,
            value="azimuth_rad",
            variance="azimuth_var",
            unit="rad",
            convention=AngleConvention.CONE,
            to_row=sine,
        ),
    ),
    Sensor(
        name="COSINE_Z",
        kind=7,
        of_offset=cosine_z,
        second_order=bound,
        is_bound=True,
        in_strapdown=True,
        bias_sd="elevation_bias_sd_rad",
        reading=Reading(
            quantity="elevation",
            field=Field.ELEVATION,
            value="elevation_rad",
            variance="elevation_var",
            unit="rad",
            convention=AngleConvention.CONE,
            to_row=sine,
        ),
    ),
)
