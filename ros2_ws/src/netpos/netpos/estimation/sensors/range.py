"""Two-way range: |d|, free of the device's clock."""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined
from netpos.estimation.sensors.model import Reading, Refusal, Sensor
from netpos.messages.values import Array, Field


@inlined
def distance(_row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Length of the offset d [m] and its gradient."""
    r = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
    return r, dx / r, dy / r, dz / r


@inlined
def exact(_row: Array, dx: float, dy: float, dz: float, cov: Array, axes: int) -> float:
    """Half the trace of (h'' P)^2 (Bar-Shalom, Li and Kirubarajan 2001, eq. 10.3.3-12), with
    h'' = (I - u u') / |d|, u = d / |d|: exact for a Gaussian prior, above and below the RSU too.
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
def bend(_row: Array, dx: float, dy: float, dz: float, cov: Array, axes: int) -> float:
    """Half the trace of h'' P: how much longer the mean distance is than that of the mean
    (Bar-Shalom, Li and Kirubarajan 2001, eq. 10.3.3-10)."""
    r2 = max(dx * dx + dy * dy + dz * dz, 1e-6)
    d = (dx, dy, dz)
    total, along = 0.0, 0.0
    for i in range(axes):
        Pd = 0.0
        for j in range(axes):
            Pd += cov[i, j] * d[j]
        total += cov[i, i]
        along += d[i] * Pd
    return float(0.5 * (total - along / r2) / math.sqrt(r2))


SENSOR = Sensor(
    name="RANGE",
    kind=3,
    of_offset=distance,
    second_order=exact,
    second_order_mean=bend,
    is_range=True,
    stretches=True,
    in_strapdown=True,
    bias_sd="range_bias_sd_m",
    common_bias_sd="common_range_bias_sd_m",
    reading=Reading(
        quantity="range",
        field=Field.RANGE,
        value="range_m",
        variance="range_var",
        unit="m",
        from_master=True,
        refusals=(
            Refusal(
                reason="negative_range",
                is_bad=lambda value: value < 0.0,
                remedy="send a distance >= 0 m, or no RANGE where none was measured",
            ),
        ),
        simulated="range",
    ),
)
