"""Time difference of arrival: how much later an RSU hears a beacon than another, |d| - |d - b|.

b is the position of the reference from the RSU, in map [m]; a row keeps it in the first three of
its AXES. The device's clock cancels. So does the bias that a network shares; those of the two
RSUs themselves stay, as a difference.
"""

from __future__ import annotations

from netpos.estimation.compile import inlined
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.sensors.model import Reading, Sensor
from netpos.estimation.sensors.range import SENSOR as RANGE
from netpos.estimation.sensors.range import bend, distance
from netpos.estimation.sensors.row import AXES
from netpos.messages.values import Array, Field


@inlined
def difference(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Distance to the RSU minus that to the reference [m], and its gradient."""
    r, gx, gy, gz = distance(row, dx, dy, dz)
    bx, by, bz = row[AXES], row[AXES + 1], row[AXES + 2]
    other, ox, oy, oz = distance(row, dx - bx, dy - by, dz - bz)
    return r - other, gx - ox, gy - oy, gz - oz


@inlined
def exact(row: Array, dx: float, dy: float, dz: float, cov: Array, axes: int) -> float:
    """Half the trace of (h'' P)^2 with h'' = (I - u u') / r - (I - w w') / s, u and w the
    directions from the RSU and from the reference, r and s the distances: exact for a Gaussian
    prior."""
    r, ux, uy, uz = distance(row, dx, dy, dz)
    s, wx, wy, wz = distance(row, dx - row[AXES], dy - row[AXES + 1], dz - row[AXES + 2])
    u, w = (ux, uy, uz), (wx, wy, wz)
    r, s = max(r, 1e-3), max(s, 1e-3)
    total = 0.0
    for i in range(axes):
        for j in range(axes):
            ij, ji = 0.0, 0.0  # (h'' P)_ij and (h'' P)_ji
            for k in range(axes):
                h_ik = -u[i] * u[k] / r + w[i] * w[k] / s
                h_jk = -u[j] * u[k] / r + w[j] * w[k] / s
                if i == k:
                    h_ik += 1.0 / r - 1.0 / s
                if j == k:
                    h_jk += 1.0 / r - 1.0 / s
                ij += h_ik * cov[k, j]
                ji += h_jk * cov[k, i]
            total += ij * ji
    return float(0.5 * max(total, 0.0))


@inlined
def bends(row: Array, dx: float, dy: float, dz: float, cov: Array, axes: int) -> float:
    """Half the trace of h'' P, of both distances."""
    bx, by, bz = row[AXES], row[AXES + 1], row[AXES + 2]
    other = bend(row, dx - bx, dy - by, dz - bz, cov, axes)
    return float(bend(row, dx, dy, dz, cov, axes) - other)


SENSOR = Sensor(
    name="TDOA",
    kind=14,
    of_offset=difference,
    second_order=exact,
    second_order_mean=bends,
    difference_of=RANGE.kind,
    in_strapdown=True,
    bias_sd="range_bias_sd_m",
    reading=Reading(
        quantity="tdoa",
        field=Field.TDOA,
        value="tdoa_s",
        variance="tdoa_var",
        unit="s",
        scale=SPEED_OF_LIGHT_MPS,
        from_master=True,
        simulated="toa",
    ),
)
