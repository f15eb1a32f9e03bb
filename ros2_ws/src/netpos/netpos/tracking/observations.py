"""How the measurements of an epoch fitted, as the health of the RSUs takes it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from netpos.estimation.measurement import GROUP, KIND
from netpos.estimation.sensors.table import SENSORS
from netpos.messages.values import Array, GroundSpeed, RsuMeasurement, Velocity

_KIND_AND_GROUP = slice(KIND, GROUP + 1, GROUP - KIND)
_KIND_NAMES = {sensor.kind: sensor.name for sensor in SENSORS if sensor.is_reported}


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
        values, found = tuple(self.innovations.ravel().tolist()), []
        places = _places_of(self.rows[:, _KIND_AND_GROUP].tobytes())
        for item, taken, place in zip(self.items, self.accepted, places, strict=True):
            if isinstance(item, RsuMeasurement):
                names, first, end = place
                told = Observation(
                    self.stamp_ns, self.vue_id, bool(taken), names, values[first:end]
                )
                found.append((item.rsu_id, told))
        return found


@lru_cache(256)
def _places_of(kinds_and_groups: bytes) -> list[tuple[tuple[str, ...], int, int]]:
    """Per group: names of the rows that are told of, which follow one another, and where in the
    flattened innovations they begin and end."""
    kinds, groups = np.frombuffer(kinds_and_groups).reshape(-1, 2).T.tolist()
    places = []
    for group in range(int(max(groups)) + 1):
        rows = [i for i, g in enumerate(groups) if g == group and kinds[i] in _KIND_NAMES]
        names = tuple(_KIND_NAMES[int(kinds[i])] for i in rows)
        first = rows[0] if rows else 0
        assert rows == list(range(first, first + len(rows)))
        places.append((names, 2 * first, 2 * (first + len(rows))))
    return places
