"""map -> odom (REP-105): where the frame of a device's dead reckoning is in the map."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from netpos.messages.values import Array

Pose = tuple[int, Array, Array]
"""Stamp [ns], position (3,) [m], quaternion (4,) x y z w."""

_KEPT_NS = 10_000_000_000
_GAP_NS = 1_000_000_000  # between two poses in odom further apart nothing is interpolated
_WAITING = 100
_UNJOINED = 10  # poses in a row that fell into a gap of those in odom


class MapToOdom:
    """Joins the poses of a device in map and in odom, each pair at one stamp.

    A pose in map waits until a pose in odom has reached its stamp; that in odom is interpolated.
    Nothing is extrapolated.
    """

    def __init__(self) -> None:
        self._odom: deque[Pose] = deque()
        self._map: deque[Pose] = deque(maxlen=_WAITING)
        self._unjoined = 0

    @property
    def is_lost(self) -> bool:
        """Whether the newest pose in map waits for one in odom for longer than a second."""
        waits = self._map and self._map[-1][0] - self._map[0][0] > _GAP_NS
        return bool(waits) or self._unjoined >= _UNJOINED

    def add_odom(self, stamp_ns: int, position: Array, quaternion: Array) -> list[Pose]:
        """Take odom -> base; what map -> odom is, now that this is known."""
        if self._odom and stamp_ns <= self._odom[-1][0]:
            if stamp_ns < self._odom[-1][0] - _KEPT_NS:
                self._odom.clear()  # time was set back
            else:
                return []
        self._odom.append((stamp_ns, position, quaternion))
        while self._odom[0][0] < stamp_ns - _KEPT_NS:
            self._odom.popleft()
        return self._joined()

    def add_map(self, stamp_ns: int, position: Array, quaternion: Array) -> list[Pose]:
        """Take map -> base; what map -> odom is, where odom -> base has reached its stamp."""
        self._map.append((stamp_ns, position, quaternion))
        return self._joined()

    def _joined(self) -> list[Pose]:
        found = []
        while self._map and self._odom and self._map[0][0] <= self._odom[-1][0]:
            stamp_ns, position, quaternion = self._map.popleft()
            odom = self._odom_at(stamp_ns)
            self._unjoined = self._unjoined + 1 if odom is None else 0
            if odom is not None:
                found.append((stamp_ns, *_behind(position, quaternion, *odom)))
        return found

    def _odom_at(self, stamp_ns: int) -> tuple[Array, Array] | None:
        if stamp_ns == self._odom[-1][0]:
            return self._odom[-1][1:]
        for before, after in pairwise(self._odom):
            if before[0] <= stamp_ns < after[0]:
                if after[0] - before[0] > _GAP_NS:
                    return None
                share = (stamp_ns - before[0]) / (after[0] - before[0])
                turn = Slerp([0.0, 1.0], Rotation.from_quat([before[2], after[2]]))(share)
                return before[1] + share * (after[1] - before[1]), turn.as_quat()
        return None


def _behind(
    position: Array, quaternion: Array, odom_position: Array, odom_quaternion: Array
) -> tuple[Array, Array]:
    """map -> odom of map -> base and odom -> base."""
    turn = Rotation.from_quat(quaternion) * Rotation.from_quat(odom_quaternion).inv()
    place: Array = np.asarray(position) - turn.apply(odom_position)
    return place, turn.as_quat()
