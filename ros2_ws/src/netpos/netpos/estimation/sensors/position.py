"""Position fixes, and other measurements that are linear in the state.

LINEAR  H x of a planar filter, H (6,) of the core states in the first six entries of ORIGIN and
        AXES, and where the row has a HEIGHT that of the height in the seventh; the position in it
        is that of the antenna, its height over the nominal one of the device
PLACE   u . a of a spatial filter, one axis at a time: u in ORIGIN, a the antenna (deng2022:eq.8)
"""

from __future__ import annotations

from netpos.estimation.compile import leaf
from netpos.estimation.sensors.geometry import turned_lever
from netpos.estimation.sensors.model import Sensor
from netpos.estimation.sensors.row import HEADING, HEIGHT, LEVER, ORIGIN
from netpos.estimation.state import N_CORE, X
from netpos.messages.values import Array


@leaf
def linear(row: Array, mean: Array, h: Array) -> float:
    """H x at ``mean`` (n,); H goes to ``h`` (n,)."""
    value = 0.0
    for i in range(N_CORE):
        h[i] = row[ORIGIN + i]
        value += h[i] * mean[i]
    if row[HEADING] >= 0.0:
        lx, ly = turned_lever(row, mean)
        value += h[X.PX] * lx + h[X.PY] * ly
        h[int(row[HEADING])] = h[X.PY] * lx - h[X.PX] * ly
    height = int(row[HEIGHT])
    if height > 0:
        h[height] = row[ORIGIN + N_CORE]
        value += h[height] * (mean[height] + row[LEVER + 2])
    return value


@leaf
def place(row: Array, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Component of the antenna's position along u, and u."""
    u = ORIGIN
    value = row[u] * x + row[u + 1] * y + row[u + 2] * z
    return value, row[u], row[u + 1], row[u + 2]


SENSORS = (
    # A fix has rows along axes that have no name: no words in the health of an RSU.
    Sensor(name="LINEAR", kind=4, of_state=linear, is_reported=False),
    Sensor(name="PLACE", kind=11, of_antenna=place),
)
