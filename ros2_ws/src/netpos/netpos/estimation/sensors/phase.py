"""Phase difference of two antennas: a d / |d| (petukhov:eq.5).

The first three entries of AXES hold a: 2 pi L / lambda times the unit vector of the array from
slave to master, in map. A phase is known but for whole turns; an unwrapped one has them, as a
sector of the ambiguity has been chosen.
"""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined, leaf
from netpos.estimation.sensors.geometry import squared_entries
from netpos.estimation.sensors.model import Reading, Refusal, Sensor, Wraps
from netpos.estimation.sensors.row import AXES
from netpos.messages.values import Array, Field


@leaf
def phase(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Phase difference [rad] of the offset d from the middle of the array, and its gradient."""
    a = AXES
    r = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
    value = (row[a] * dx + row[a + 1] * dy + row[a + 2] * dz) / r
    return (
        value,
        (row[a] - value * dx / r) / r,
        (row[a + 1] - value * dy / r) / r,
        (row[a + 2] - value * dz / r) / r,
    )


@inlined
def bound(row: Array, dx: float, dy: float, dz: float, cov: Array, axes: int) -> float:
    """Half the trace of (h'' P)^2 with a curvature of |a| / r^2 in every direction."""
    a = AXES
    r2 = max(dx * dx + dy * dy + dz * dz, 1e-6)
    square = squared_entries(cov, axes)
    square *= row[a] * row[a] + row[a + 1] * row[a + 1] + row[a + 2] * row[a + 2]
    return float(0.5 * square / (r2 * r2))


SENSORS = (
    Sensor(
        name="PHASE",
        kind=8,
        of_offset=phase,
        second_order=bound,
        is_bound=True,
        wraps=Wraps.INNOVATION,
        reading=Reading(
            quantity="phase",
            field=Field.PHASE,
            value="phase_difference_rad",
            variance="phase_difference_var",
            unit="rad",
            along_array=True,
            refusals=(
                Refusal(
                    reason="phase_not_wrapped",
                    is_bad=lambda value: abs(value) > math.pi,
                    remedy="wrap it to [-pi, pi]",
                ),
            ),
            simulated="phase",
        ),
    ),
    Sensor(name="UNWRAPPED_PHASE", kind=9, of_offset=phase, second_order=bound, is_bound=True),
)
