"""The sensors: one line each. Everything that depends on the sensor is derived from this table."""

from __future__ import annotations

from enum import EnumMeta, IntEnum
from typing import TYPE_CHECKING

from netpos.estimation.sensors import (
    azimuth,
    body_motion,
    cone_angle,
    elevation,
    ground_speed,
    phase,
    position,
    step_velocity,
    tdoa,
    toa,
)
from netpos.estimation.sensors import range as two_way_range
from netpos.estimation.sensors.model import Reading, Sensor

# The order is that of the rows of one measurement.
SENSORS: tuple[Sensor, ...] = (
    azimuth.SENSOR,
    elevation.SENSOR,
    *cone_angle.SENSORS,
    toa.SENSOR,
    tdoa.SENSOR,
    two_way_range.SENSOR,
    *phase.SENSORS,
    *position.SENSORS,
    ground_speed.SENSOR,
    step_velocity.SENSOR,
    *body_motion.SENSORS,
)

BY_KIND: dict[int, Sensor] = {sensor.kind: sensor for sensor in SENSORS}

if TYPE_CHECKING:

    class _AnyName(EnumMeta):
        def __getattr__(cls, name: str) -> Kind: ...

    class Kind(IntEnum, metaclass=_AnyName):
        """What a row measures: name and number of every sensor of the table."""

else:
    Kind = IntEnum("Kind", {s.name: s.kind for s in SENSORS}, module=__name__)
    Kind.__doc__ = "What a row measures: name and number of every sensor of the table."


def readings() -> list[tuple[Sensor, Reading]]:
    """The sensors that a field of a measurement gives, in the order of the table."""
    return [(sensor, sensor.reading) for sensor in SENSORS if sensor.reading is not None]


def _check() -> None:
    kinds = [sensor.kind for sensor in SENSORS]
    for sensor in SENSORS:
        if not 0 <= sensor.kind <= 62 or kinds.count(sensor.kind) > 1:
            raise ValueError(
                f"the kind of {sensor.name} must be 0 to 62 and its own, got {sensor.kind}; "
                f"taken are {sorted(set(kinds))}"
            )
    if len(Kind) < len(SENSORS):
        raise ValueError("two sensors share a name; give each its own")


_check()
