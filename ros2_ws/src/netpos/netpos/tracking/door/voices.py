"""Whether two senders speak in the name of one RSU.

An RSU measures a device as often as it hears it. Whoever sends in its name, beside it, cannot keep
to its beat: sooner or later two stamps are closer together than half of the shortest interval that
the RSU has ever kept, and the values around them are further from a line than their noise and any
manoeuvre of the device allow. Nobody knows which of the two is the RSU's. So neither sender counts
for that device, until stamps have kept that distance for a second.

By the stamps and values of one RSU and device alone, which a recording keeps, so that a replay
refuses the same ones. An RSU that only sends more often, and does not contradict itself, is heard.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from netpos.estimation.sensors.table import readings
from netpos.messages.values import Field, RsuMeasurement

CONFLICT = "conflict"
"""Reason for the refusal."""
_NS = 1_000_000_000
_INTERVALS = 20  # before the shortest of them is known
_SLOTS = 64  # values remembered of a source, half an interval apart
_SOURCES_MAX = 1000
_SDS = 5.0  # 6e-7 of the differences of sound values are larger
_LENGTH = 20.0  # m/s^2: twice what tyres hold, and more than a step has
_ANGLE = 65.0  # rad/s^2: 0.65 (v / r)^2, of who passes the RSU at 20 m/s in 2 m
_POSITION = int(Field.POSITION)
_UNCOMPARED = int(Field.PHASE)  # it wraps within centimetres
_READINGS = {
    int(reading.field): reading
    for _, reading in readings()
    if not int(reading.field) & (_UNCOMPARED | _POSITION)
}


@dataclass(slots=True)
class _Source:
    """The shortest interval of seconds that are over and were not contradicted, 0 before it is
    known; the shortest of this second and of the one before; how many intervals there were; stamp
    of the newest value that was used; the values, by multiples of half the interval; until when
    neither sender counts, and the newest stamp of those that did not."""

    interval_ns: int = 0
    shortest_ns: int = 0
    before_ns: int = 0
    count: int = 0
    second: int = 0
    newest_ns: int = 0
    values: dict[int, RsuMeasurement] = field(default_factory=dict)
    shut_until_ns: int = 0
    refused_ns: int = 0

    def refuses(self, stamp_ns: int) -> bool:
        """Whether a measurement with this stamp does not count; those that come closer than the
        RSU ever does keep it so."""
        if stamp_ns >= self.shut_until_ns:
            return False
        if 0 < abs(stamp_ns - self.refused_ns) < self.interval_ns // 2:
            self.shut_until_ns = max(self.shut_until_ns, stamp_ns + _NS)
        self.refused_ns = stamp_ns
        return True

    def contradicts(self, item: RsuMeasurement) -> bool:
        """Whether a value is closer to another one than the RSU ever comes, and those within two
        intervals of it cannot be of one device."""
        half_ns = self.interval_ns // 2
        if half_ns == 0:
            return False
        slot = item.stamp_ns // half_ns
        beside = [m for k in range(slot - 1, slot + 2) if (m := self.values.get(k)) is not None]
        if not any(0 < abs(m.stamp_ns - item.stamp_ns) < half_ns for m in beside):
            return False
        near = [m for k in range(slot - 4, slot + 5) if (m := self.values.get(k)) is not None]
        near = [m for m in near if m.stamp_ns != item.stamp_ns]
        series = sorted([*near, item], key=lambda m: m.stamp_ns)
        if not any(bends(*three) for three in zip(series, series[1:], series[2:], strict=False)):
            return False
        self.shut_until_ns, self.refused_ns = item.stamp_ns + _NS, item.stamp_ns
        self.shortest_ns = self.before_ns = 0  # may be of the other sender
        return True

    def take(self, item: RsuMeasurement) -> None:
        """Note a value that is used."""
        stamp_ns = item.stamp_ns
        if stamp_ns > self.newest_ns:
            if self.newest_ns:
                self._learn(stamp_ns, stamp_ns - self.newest_ns)
            self.newest_ns = stamp_ns
        if self.interval_ns:
            self.values[stamp_ns // (self.interval_ns // 2)] = item
            if len(self.values) > _SLOTS:
                del self.values[next(iter(self.values))]

    def _learn(self, stamp_ns: int, since_ns: int) -> None:
        second = stamp_ns // _NS
        if second > self.second:
            if self.count >= _INTERVALS and self.before_ns:
                self._set_interval(self.before_ns)
            self.before_ns, self.shortest_ns = self.shortest_ns, 0
            self.second = second
        self.count += 1
        self.shortest_ns = min(self.shortest_ns or since_ns, since_ns)

    def _set_interval(self, shortest_ns: int) -> None:
        if not self.interval_ns or shortest_ns < self.interval_ns:
            self.interval_ns = max(shortest_ns, 2)
            half_ns = self.interval_ns // 2
            self.values = {m.stamp_ns // half_ns: m for m in self.values.values()}


class Voices:
    """The senders behind the names of all RSUs, device by device."""

    def __init__(self) -> None:
        self._sources: dict[tuple[str, str], _Source] = {}
        self._shut: dict[str, dict[str, _Source]] = {}  # once contradicted: device, RSU

    def refuses(self, rsu_id: str, vue_id: str, stamp_ns: int) -> bool:
        """Whether two senders speak in a name, so that a measurement with this stamp does not
        count."""
        shut = self._shut.get(vue_id)
        return shut is not None and rsu_id in shut and shut[rsu_id].refuses(stamp_ns)

    def silenced(self, vue_id: str, stamp_ns: int) -> int:
        """How many RSUs do not count for a device at a time."""
        shut = self._shut.get(vue_id)
        if shut is None:
            return 0
        return sum(source.shut_until_ns > stamp_ns for source in shut.values())

    def contradicts(self, item: RsuMeasurement) -> bool:
        """Whether a sound measurement shows that somebody else sends in the name of its RSU, which
        is then shut."""
        source = self._sources.get((item.rsu_id, item.vue_id))
        if source is None or not source.contradicts(item):
            return False
        self._shut.setdefault(item.vue_id, {})[item.rsu_id] = source
        return True

    def take(self, item: RsuMeasurement) -> None:
        """Take note of a measurement that is used."""
        key = item.rsu_id, item.vue_id
        source = self._sources.get(key)
        if source is None:
            if len(self._sources) >= _SOURCES_MAX:
                self._drop(next(iter(self._sources)))
            source = self._sources[key] = _Source()
        source.take(item)

    def forget(self, vue_id: str) -> None:
        """A device starts anew, its time with it."""
        for key in [key for key in self._sources if key[1] == vue_id]:
            self._drop(key)

    def _drop(self, key: tuple[str, str]) -> None:
        del self._sources[key]
        shut = self._shut.get(key[1])
        if shut is not None:
            shut.pop(key[0], None)
            if not shut:
                del self._shut[key[1]]


def bends(first: RsuMeasurement, middle: RsuMeasurement, last: RsuMeasurement) -> bool:
    """Whether three measurements of one RSU and device, in the order of their stamps, cannot be of
    one device: the middle one is further from the line through the others than five standard
    deviations and the hardest manoeuvre allow. Clocks that run evenly move it nowhere."""
    fields = int(middle.fields)
    if not int(first.fields) == int(last.fields) == fields or not (
        first.reference_rsu_id == middle.reference_rsu_id == last.reference_rsu_id
    ):
        return False
    whole_s = (last.stamp_ns - first.stamp_ns) / _NS
    late = (middle.stamp_ns - first.stamp_ns) / _NS / whole_s
    sagitta = 0.5 * whole_s**2 * late * (1.0 - late)  # of an acceleration of 1
    weights = 1.0 - late, -1.0, late
    for (a, b, c), variances, limit in zip(
        *_quantities(fields, (first, middle, last)), strict=True
    ):
        off = late * _turned(c - a, limit) - _turned(b - a, limit)
        sd = math.sqrt(sum(w * w * v for w, v in zip(weights, variances, strict=True)))
        if abs(_turned(off, limit)) > _SDS * sd + limit * sagitta:
            return True
    return False


def _turned(difference: float, limit: float) -> float:
    """A difference of two values, angles by the shorter way round."""
    return math.remainder(difference, 2.0 * math.pi) if limit == _ANGLE else difference


def _quantities(
    fields: int, three: tuple[RsuMeasurement, ...]
) -> tuple[list[tuple[float, ...]], list[tuple[float, ...]], list[float]]:
    """Values, variances and greatest acceleration of each quantity of three measurements."""
    values, variances, limits = [], [], []
    for bit, reading in _READINGS.items():
        if fields & bit:
            values.append(tuple(getattr(m, reading.value) for m in three))
            variances.append(tuple(getattr(m, reading.variance) for m in three))
            limits.append(_ANGLE if reading.unit == "rad" else _LENGTH / reading.scale)
    if fields & _POSITION:
        for axis in (0, 1):
            values.append(tuple(float(m.position[axis]) for m in three))
            variances.append(tuple(float(m.position_cov[axis, axis]) for m in three))
            limits.append(_LENGTH)
    return values, variances, limits
