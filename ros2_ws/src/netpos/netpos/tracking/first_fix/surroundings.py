"""Where a device can be among the RSUs that hear it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from netpos.estimation.measurement import AXES, KIND, ORIGIN
from netpos.estimation.sensors.table import BY_KIND
from netpos.estimation.state import N_CORE, POSITION
from netpos.messages.values import Array
from netpos.tracking.rsus.rsu import Rsu

NEAREST_M = 1.0
"""How near a device comes to an RSU that does not measure its distance."""


class Surroundings:
    """The RSUs that hear a device, in a window of ``rows`` (m, ROW_WIDTH), and where it can be
    among them: not behind an array without a back, and not on top of an RSU.

    height_m, heights : nominal height of the device, and how many of the states behind those of
        motion and clock are errors of it
    """

    def __init__(self, rows: Array, rsus: Iterable[Rsu], height_m: float, heights: int) -> None:
        heard = list({id(rsu): rsu for rsu in rsus}.values())
        places = np.array([rsu.info.position for rsu in heard]).reshape(-1, 3)
        self._one_sided = [rsu for rsu in heard if rsu.has_no_back]
        self._height_m, self._heights = height_m, slice(N_CORE, N_CORE + heights)
        self._origins = places[:, :2]
        self._near = _without_distance(rows, places)

    def is_possible(self, state: Array) -> bool:
        """Whether the device may be in a ``state`` (n,)."""
        x, y = state[POSITION].tolist()
        in_front = all(
            rsu.in_front(x - rsu.info.position[0], y - rsu.info.position[1])
            for rsu in self._one_sided
        )
        return in_front and not self.is_on_rsu(state)

    def is_on_rsu(self, state: Array) -> bool:
        """Whether ``state`` (n,) is nearer to an RSU than a device can be. Any angle fits there:
        this is asked of RSUs that measure no distance, and of the only one that measures times."""
        up = self._height_m + state[self._heights].sum()
        away = self._near - [*state[POSITION], up]
        return bool((np.einsum("ki,ki->k", away, away) < NEAREST_M**2).any())

    def from_nearest(self, position: Array) -> Array:
        """The way (2,) to a horizontal ``position`` (2,) from the RSU that is nearest to it."""
        ways = position - self._origins
        nearest: Array = ways[np.argmin(np.hypot(*ways.T))]
        return nearest


def _without_distance(rows: Array, places: Array) -> Array:
    """Those of the RSUs at ``places`` (k, 3) whose distance ``rows`` do not measure."""
    ranged: set[tuple[float, ...]] = set()
    timed: set[tuple[float, ...]] = set()
    for kind, *origin in np.unique(rows[:, [KIND, *range(ORIGIN, AXES)]], axis=0).tolist():
        sensor = BY_KIND[int(kind)]
        if sensor.is_range:
            (timed if sensor.has_clock else ranged).add(tuple(origin))
    if len(timed) > 1:  # what one RSU hears says nothing of the distance
        ranged |= timed
    near = [place for place in places.tolist() if tuple(place) not in ranged]
    return np.array(near).reshape(-1, 3)
