"""Speed over ground, whatever the direction: hypot(vx, vy), of wheels or Doppler. A strapdown
track knows the direction and takes it as a velocity of the body (``body_motion``)."""

from __future__ import annotations

import math

from netpos.estimation.compile import leaf
from netpos.estimation.sensors.model import Sensor
from netpos.estimation.state import X
from netpos.messages.values import Array


@leaf
def speed(_row: Array, mean: Array, h: Array) -> float:
    """Speed at ``mean`` (n,); its gradient goes to ``h`` (n,)."""
    value = math.sqrt(mean[X.VX] * mean[X.VX] + mean[X.VY] * mean[X.VY])
    h[X.VX] = mean[X.VX] / max(value, 1e-6)
    h[X.VY] = mean[X.VY] / max(value, 1e-6)
    return value


SENSOR = Sensor(name="SPEED", kind=5, of_state=speed)
