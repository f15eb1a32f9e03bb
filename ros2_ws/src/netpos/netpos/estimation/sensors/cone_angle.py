"""Cone angles of linear arrays along the y and z axes of the RSU.

A linear array measures the direction cosine u_y / |u| (u_z / |u|), u = axes d. The message holds
the angle whose sine it is; the row holds the cosine.
"""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined, leaf
from netpos.estimation.dispatch import Kernel
from netpos.estimation.sensors.elevation import bound
from netpos.estimation.sensors.geometry import in_map_axes, in_rsu_axes
from netpos.estimation.sensors.model import Sensor, angle_reading
from netpos.messages.values import AngleConvention, Array


@inlined
def _cosine(
    row: Array, dx: float, dy: float, dz: float, along_y: float, along_z: float
) -> tuple[float, float, float, float]:
    """Direction cosine of the offset d with the axis (0, along_y, along_z), and its gradient."""
    ux, uy, uz = in_rsu_axes(row, dx, dy, dz)
    r2 = max(ux * ux + uy * uy, 1e-12) + uz * uz
    r = math.sqrt(r2)
    value = (along_y * uy + along_z * uz) / r
    gy, gz = along_y / r - value * uy / r2, along_z / r - value * uz / r2
    gx, gy, gz = in_map_axes(row, -value * ux / r2, gy, gz)
    return value, gx, gy, gz


@leaf
def cosine_y(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Direction cosine of the offset d with the y axis, and its gradient."""
    return _cosine(row, dx, dy, dz, 1.0, 0.0)  # type: ignore[no-any-return]


@leaf
def cosine_z(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Direction cosine of the offset d with the z axis, and its gradient."""
    return _cosine(row, dx, dy, dz, 0.0, 1.0)  # type: ignore[no-any-return]


@inlined
def sine(angle: float, variance: float) -> tuple[float, float]:
    """Sine of a cone angle [rad] and its variance: at end-fire no smaller than the second-order
    term."""
    of_sine = max(math.cos(angle) ** 2 * variance, variance * variance / 2.0)
    return math.sin(angle), of_sine


def _sensor(name: str, kind: int, cosine: Kernel, quantity: str) -> Sensor:
    return Sensor(
        name=name,
        kind=kind,
        of_offset=cosine,
        second_order=bound,
        is_bound=True,
        in_strapdown=True,
        bias_sd=f"{quantity}_bias_sd_rad",
        reading=angle_reading(quantity, convention=AngleConvention.CONE, to_row=sine),
    )


SENSORS = (
    _sensor("COSINE_Y", 6, cosine_y, "azimuth"),
    _sensor("COSINE_Z", 7, cosine_z, "elevation"),
)
