"""How measurements fitted, as the health of the RSUs takes it; figures of them, and words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from statistics import median
from typing import NamedTuple

import numpy as np

from netpos.estimation.measurement import GROUP, KIND, wrap
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.sensors.model import Wraps
from netpos.estimation.sensors.table import SENSORS
from netpos.messages.values import Array, GroundSpeed, RsuMeasurement, Velocity

_KIND_AND_GROUP = slice(KIND, GROUP + 1, GROUP - KIND)
_KIND_NAMES = {sensor.kind: sensor.name for sensor in SENSORS if sensor.is_reported}
_OFF = _SCATTERS = 3.0  # median and sd of the normalised innovations of what is refused
_NORMAL_QUARTILE = 0.6744897501960817
_RATE_NS = 10_000_000_000
_CYCLIC = {sensor.name.lower() for sensor in SENSORS if sensor.wraps != Wraps.NEVER}


class Observation(NamedTuple):
    """What a track found of one measurement; ``values``: for each of ``kinds`` the innovation in m
    or rad and its sd, one after the other."""

    stamp_ns: int
    vue_id: str
    accepted: bool
    kinds: tuple[str, ...]
    values: Sequence[float]


class FittedEpoch(NamedTuple):
    """What a track found of one epoch: ``items`` by group, ``rows`` (m, ROW_WIDTH) and how they
    fitted, ``innovations`` (m, 2), and whether they were ``accepted``, by group."""

    stamp_ns: int
    vue_id: str
    items: Sequence[RsuMeasurement | Velocity | GroundSpeed]
    rows: Array
    innovations: Array
    accepted: Sequence[float]

    def observations(self) -> list[tuple[str, Observation]]:
        """One per measurement of an RSU, which is named with it."""
        values, observations = tuple(self.innovations.ravel().tolist()), []
        spans = _spans_of(self.rows[:, _KIND_AND_GROUP].tobytes())
        for item, taken, span in zip(self.items, self.accepted, spans, strict=True):
            if isinstance(item, RsuMeasurement):
                names, first, end = span
                observation = Observation(
                    self.stamp_ns, self.vue_id, bool(taken), names, values[first:end]
                )
                observations.append((item.rsu_id, observation))
        return observations


@lru_cache(256)
def _spans_of(kinds_and_groups: bytes) -> list[tuple[tuple[str, ...], int, int]]:
    """Per group: names of the rows that are told of, which follow one another, and where in the
    flattened innovations they begin and end."""
    kinds, groups = np.frombuffer(kinds_and_groups).reshape(-1, 2).T.tolist()
    spans = []
    for group in range(int(max(groups)) + 1):
        rows = [i for i, g in enumerate(groups) if g == group and kinds[i] in _KIND_NAMES]
        names = tuple(_KIND_NAMES[int(kinds[i])] for i in rows)
        first = rows[0] if rows else 0
        assert rows == list(range(first, first + len(rows)))
        spans.append((names, 2 * first, 2 * (first + len(rows))))
    return spans


def words(entries: Sequence[Observation]) -> str:
    """What is wrong with an RSU, from measurements that were refused."""
    faults = off(entries, _OFF)
    if not faults:
        for kind, values in _by_kind(entries).items():
            scatter = _scatter(_normalised(kind, values))
            if scatter >= _SCATTERS:
                faults.append(f"{kind} scatters {scatter:.1f} times as far as stated")
    return ", ".join(faults) or "refused by the gate"


def off(entries: Sequence[Observation], limit: float) -> list[str]:
    """One phrase per kind whose median normalised innovation reaches ``limit`` and its own
    scatter, worst first."""
    devices = len({e.vue_id for e in entries})
    phrases = []
    for kind, values in _by_kind(entries).items():
        normalised = _normalised(kind, values)
        size = abs(median(normalised))
        if size >= max(limit, _scatter(normalised)):
            phrases.append((size, _phrase(kind, median(_unwrapped(kind, values)), devices)))
    return [phrase for _, phrase in sorted(phrases, reverse=True)]


def _scatter(values: Sequence[float]) -> float:
    """Standard deviation by the median absolute deviation."""
    centre = median(values)
    return median(abs(v - centre) for v in values) / _NORMAL_QUARTILE


def _phrase(kind: str, error: float, devices: int) -> str:
    side = "late" if error > 0.0 else "early"
    if kind in _CYCLIC:
        return f"{kind} off by {math.degrees(error):.1f} deg"
    if kind == "range":
        return f"range {side} by {abs(error):.1f} m"
    if kind == "toa":
        step = f"clock step of {error / SPEED_OF_LIGHT_MPS * 1e9:.0f} ns"
        # A path can be blocked for one device, and it is never shorter than the direct one.
        return step if devices > 1 or error < 0.0 else f"{step} or blocked path"
    return f"{kind} off by {error:.3g}"


def _by_kind(entries: Iterable[Observation]) -> dict[str, list[tuple[float, float]]]:
    """Innovations by kind name in lower case."""
    kinds: dict[str, list[tuple[float, float]]] = {}
    for entry in entries:
        pairs = zip(entry.values[::2], entry.values[1::2], strict=True)
        for kind, pair in zip(entry.kinds, pairs, strict=True):
            kinds.setdefault(kind.lower(), []).append(pair)
    return kinds


def _unwrapped(kind: str, values: list[tuple[float, float]]) -> list[float]:
    """Innovations, angles within half a turn of the first one: an array turned round is +-180."""
    if kind not in _CYCLIC:
        return [value for value, _ in values]
    first = values[0][0]
    return [first + float(wrap(value - first)) for value, _ in values]


def medians(entries: Iterable[Observation], normalised: bool = False) -> dict[str, float]:
    """Median innovation (m, rad) by kind, or median of innovation / sd."""
    values_of = _normalised if normalised else _unwrapped
    return {kind: median(values_of(kind, v)) for kind, v in _by_kind(entries).items()}


def mean_nis(entries: Iterable[Observation]) -> float:
    """Mean squared normalised innovation; 1 for a consistent track."""
    squares = [
        (values[i] / values[i + 1]) ** 2
        for values in [entry.values for entry in entries]
        for i in range(0, len(values), 2)
    ]
    return math.fsum(squares) / len(squares) if squares else 0.0  # fsum: in any order the same


def _normalised(kind: str, values: list[tuple[float, float]]) -> list[float]:
    return [v / sd for v, (_, sd) in zip(_unwrapped(kind, values), values, strict=True)]


def rate_hz(window: Sequence[Observation]) -> float:
    """Measurements per second over the last 10 s in which there were any."""
    if not window:
        return 0.0
    newest = window[-1].stamp_ns
    stamps = [e.stamp_ns for e in window if e.stamp_ns > newest - _RATE_NS]
    span = newest - stamps[0]
    return sum(s > stamps[0] for s in stamps) / (span * 1e-9) if span > 0 else 0.0
