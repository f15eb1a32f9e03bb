"""Motion in the axes of the body, of spatial filters: u in ORIGIN, C the attitude.

BODY_VELOCITY  u . C' v       ground speed, non-holonomic and zero-velocity constraints
BODY_RATE      u . gyro bias  a gyro at rest shows nothing else
"""

from __future__ import annotations

from netpos.estimation.compile import leaf
from netpos.estimation.sensors.model import Sensor
from netpos.estimation.sensors.row import ORIGIN
from netpos.inertial.navigation_state import ATTITUDE_ERR, GYRO_BIAS, GYRO_BIAS_ERR, VELOCITY
from netpos.messages.values import Array


@leaf
def velocity(row: Array, nav: Array, C: Array, h: Array) -> float:
    """Component of the velocity along u of the body; gradient [C u, 0, (C u) x v, 0, 0]."""
    u = ORIGIN
    value = 0.0
    for i in range(3):
        h[VELOCITY + i] = C[i, 0] * row[u] + C[i, 1] * row[u + 1] + C[i, 2] * row[u + 2]
        value += h[VELOCITY + i] * nav[VELOCITY + i]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        h[ATTITUDE_ERR + i] = (
            h[VELOCITY + j] * nav[VELOCITY + k] - h[VELOCITY + k] * nav[VELOCITY + j]
        )
    return value


@leaf
def rate(row: Array, nav: Array, _C: Array, h: Array) -> float:
    """Component of the gyro bias along u."""
    value = 0.0
    for i in range(3):
        h[GYRO_BIAS_ERR + i] = row[ORIGIN + i]
        value += row[ORIGIN + i] * nav[GYRO_BIAS + i]
    return value


SENSORS = (
    Sensor(name="BODY_VELOCITY", kind=12, of_navigation=velocity, adds_biases=False),
    Sensor(name="BODY_RATE", kind=13, of_navigation=rate, adds_biases=False),
)
