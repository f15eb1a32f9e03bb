"""Whether a sensor is stuck: it goes on sending, with new stamps, the values it had.

Values that a working sensor repeats exactly are no rarity: it rounds them, and where the device
stands they hardly change. So a run of repeats is compared with two chances of one repeat, and the
larger one counts:

- What the noise allows. A value rounded to a grid of step q falls into one given cell with a
  probability of at most erf(q / (2 sqrt(2) sd)), whatever is measured. q is not known; the
  smallest difference between successive values among the first ones is no smaller.
- What is usual: the share of messages that were repeats before this run, by Laplace's rule of
  succession, for the first repeat; the share of repeats that a repeat followed for the others.
  Repeats of a device that stands come in runs. For what the device reports this alone counts: an
  IMU declares no noise with its samples, and what dead reckoning declares is the noise of a step,
  not of a message.

A velocity is compared with its covariance, which grows with the age of the step. One that is no
larger than its standard deviation says that the device rests: it is not judged, because it may
rest for hours.

A run of repeats is too long from the first one on for which the product of the chances is below
1e-9. It ends with the next other value.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from operator import attrgetter

from netpos.estimation.sensors.table import readings
from netpos.messages.values import Field, GroundSpeed, ImuSample, RsuMeasurement, Velocity
from netpos.tracking.rest import rests

REPEATED = "repeated"
"""Reason for the refusal."""
_LOG_RISK = math.log(1e-9)  # of a run that a working sensor makes, at every message
_REMEMBERED = 1000  # messages behind what is usual: older ones fade
_COMPARED = 200  # messages whose differences are looked at
_SOURCES_MAX = 1000
_POSITION = int(Field.POSITION)
_OF_IMU, _OF_VELOCITY = 0, -1  # in place of the fields of a measurement
_READINGS = {int(reading.field): reading for _, reading in reversed(readings())}


@dataclass(slots=True)
class _Run:
    """Values, the stamp they came with last, and how often they were repeated."""

    values: tuple[float, ...]
    stamp_ns: int
    repeats: int = 0


@dataclass(slots=True)
class _Source:
    """The present run by reference; of the measurements before, how many repeated the one before
    them, and of these how many repeated a repeat; the smallest difference of each value, none
    before two have differed."""

    runs: dict[str, _Run] = field(default_factory=dict)
    heard: float = 0.0
    repeated: float = 0.0
    again: float = 0.0
    smallest: tuple[float, ...] = ()

    def hear(self, reference: str, values: tuple[float, ...], stamp_ns: int) -> int:
        """Take values; how many repeats there are in a row now."""
        run = self.runs.get(reference)
        if run is None:
            self.runs[reference] = _Run(values, stamp_ns)
            return 0
        if run.values == values:
            run.repeats += run.stamp_ns != stamp_ns  # the same message twice is no measurement
        else:
            if self.heard < _COMPARED:
                self._compare(run.values, values)
            self._count(run.repeats)
            run.values, run.repeats = values, 0
        run.stamp_ns = stamp_ns
        return run.repeats

    def _count(self, repeats: int) -> None:
        self.heard += repeats + 1
        self.repeated += repeats
        self.again += max(repeats - 1, 0)
        if self.heard > _REMEMBERED:
            self.heard, self.repeated, self.again = (
                0.5 * self.heard,
                0.5 * self.repeated,
                0.5 * self.again,
            )

    def _compare(self, one: tuple[float, ...], other: tuple[float, ...]) -> None:
        known = self.smallest or (math.inf,) * len(one)
        differences = [abs(a - b) for a, b in zip(one, other, strict=True)]
        self.smallest = tuple(
            [d if 0.0 < d < s else s for d, s in zip(differences, known, strict=True)]
        )

    def is_unusual(self, repeats: int) -> bool:
        """Whether a run is too long by what was heard before; never while no two differed."""
        if not (repeats and self.smallest):
            return False
        first = (self.repeated + 1.0) / (self.heard + 2.0)
        # As likely after a repeat as else, until more is known.
        other = max(first, (self.again + 2.0 * first) / (self.repeated + 2.0))
        return math.log(first) + (repeats - 1) * math.log(other) < _LOG_RISK

    def is_unlikely(self, repeats: int, sds: tuple[float, ...]) -> bool:
        """Whether a run is too long for the noise of each value."""
        steps = zip(self.smallest, sds, strict=True)
        chance = min(math.erf(step / (math.sqrt(8.0) * sd)) for step, sd in steps)
        return chance == 0.0 or repeats * math.log(chance) < _LOG_RISK


class Repeats:
    """The runs of repeats of every RSU and device, by the quantities measured, and of what every
    device reports. By the order of the messages of one source alone, which a recording keeps."""

    def __init__(self) -> None:
        self._sources: dict[tuple[str, str, int], _Source] = {}

    def stuck(self, item: RsuMeasurement | ImuSample | Velocity | GroundSpeed) -> bool:
        """Take note of a sound measurement; whether it is one repeat too many."""
        if isinstance(item, RsuMeasurement):
            fields = int(item.fields)
            source = self._source((item.rsu_id, item.vue_id, fields))
            repeats = source.hear(item.reference_rsu_id, _values(fields)(item), item.stamp_ns)
            return source.is_unusual(repeats) and source.is_unlikely(repeats, _sds(item))
        if isinstance(item, ImuSample):
            values = (*item.angular_velocity.tolist(), *item.specific_force.tolist())
            source = self._source(("", item.vue_id, _OF_IMU))
        else:
            velocity, variances, covariance = _reported(item)
            if rests(velocity, variances):
                return False
            values = (*velocity, *variances, covariance)
            source = self._source((item.source, item.vue_id, _OF_VELOCITY))
        return source.is_unusual(source.hear("", values, item.stamp_ns))

    def _source(self, key: tuple[str, str, int]) -> _Source:
        source = self._sources.get(key)
        if source is None:
            if len(self._sources) >= _SOURCES_MAX:
                del self._sources[next(iter(self._sources))]
            source = self._sources[key] = _Source()
        return source


def _reported(
    item: Velocity | GroundSpeed,
) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Velocity and its variances, by axis, and the covariance of the two axes."""
    if isinstance(item, GroundSpeed):
        return (item.speed_mps,), (item.speed_var,), 0.0
    (x, y), ((xx, xy), (_, yy)) = item.velocity.tolist(), item.cov.tolist()
    return (x, y), (xx, yy), xy


@lru_cache(256)
def _values(fields: int) -> Callable[[RsuMeasurement], tuple[float, ...]]:
    """What reads the values of a measurement with these ``fields``."""
    names = [reading.value for field, reading in _READINGS.items() if fields & field]
    read = [attrgetter(name) for name in names]
    if fields & _POSITION:
        return lambda m: (*[value(m) for value in read], *m.position[:2].tolist())
    if len(names) > 1:
        return attrgetter(*names)
    return lambda m: (read[0](m),)


def _sds(m: RsuMeasurement) -> tuple[float, ...]:
    """Standard deviation of each of the values."""
    carried = [r for field, r in _READINGS.items() if int(m.fields) & field]
    variances = [getattr(m, reading.variance) for reading in carried]
    if int(m.fields) & _POSITION:
        variances += [float(m.position_cov[0, 0]), float(m.position_cov[1, 1])]
    return tuple(map(math.sqrt, variances))
