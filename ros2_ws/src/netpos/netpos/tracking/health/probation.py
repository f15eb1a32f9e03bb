"""Which RSUs are independent of one another, and which are too new to have a vote.

A device whose track at least three admitted RSUs at different places agree with is *guarded*. An
RSU that comes then is on probation: what it measures is fused only where it alone agrees with the
prediction, and it has no vote, until it has agreed with the track in three slots in a row. The
first RSUs of a network, and those that come while nothing guards a device, are admitted as soon
as they agree with another. Everything follows from stamps, as in ``health``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from netpos.tracking.health.observations import Observation
from netpos.tracking.rsus.rsu import Rsu

_APART_M = 1.0
_WITNESSES = 3  # two ranges leave a mirrored place
_SLOTS = 3  # to agree in before it is admitted; a guard holds as long


@dataclass(slots=True)
class Vote:
    """What one device says of one RSU in one slot."""

    entries: list[Observation]
    ratio: float
    mean_nis: float
    witnesses: frozenset[str] = frozenset()


def independent(votes: Mapping[str, Vote], names: Iterable[str], rsus: Mapping[str, Rsu]) -> int:
    """How many of the RSUs ``names`` are independent: those within 1 m of another count once. An
    RSU that sends positions may be anywhere, and counts."""
    sites: list[np.ndarray] = []
    found = 0
    for name in sorted(names):
        rsu = rsus.get(name)
        if rsu is not None and any(entry.kinds for entry in votes[name].entries[:1]):
            place = rsu.info.position
            if any(float(np.linalg.norm(place - site)) < _APART_M for site in sites):
                continue
            sites.append(place)
        found += 1
    return found


class Probation:
    """Who is admitted, and which devices are guarded; both from a stamp on."""

    def __init__(self, slot_ns: int, settle_ns: int) -> None:
        self._slot_ns, self._settle_ns = slot_ns, settle_ns
        self._admitted: dict[str, int] = {}  # from which stamp on
        self._proving: dict[str, int] = {}
        self._guards: dict[str, deque[int]] = {}  # ends of guarded slots by device

    @property
    def any(self) -> bool:
        """Whether a device is, or was, guarded."""
        return bool(self._guards)

    def holds(self, rsu_id: str, vue_id: str, stamp_ns: int) -> bool:
        """Whether an RSU is on probation in a measurement of this device and stamp."""
        if self._admitted.get(rsu_id, stamp_ns + 1) <= stamp_ns:
            return False
        for end_ns in self._guards.get(vue_id, ()):
            if 0 <= stamp_ns - end_ns - self._settle_ns < _SLOTS * self._slot_ns:
                return True
        return False

    def judge(
        self,
        vue_id: str,
        votes: Mapping[str, Vote],
        taken: Collection[str],
        end_ns: int,
        rsus: Mapping[str, Rsu],
    ) -> None:
        """Conclude from a slot of a device that ended at ``end_ns``; ``taken``: RSUs that agree
        with its track and are not excluded."""
        old = {name for name in taken if name in self._admitted}
        if independent(votes, old, rsus) >= _WITNESSES:
            self._guards.setdefault(vue_id, deque(maxlen=64)).append(end_ns)
        first = not self._admitted
        for name in votes.keys() - self._admitted.keys():
            held = self.holds(name, vue_id, votes[name].entries[-1].stamp_ns)
            if name not in taken or len(taken) < 2 or not (first or old):
                self._proving[name] = 0
                continue
            self._proving[name] = self._proving.get(name, 0) + 1
            if not held or self._proving[name] >= _SLOTS:
                self._admitted[name] = end_ns + self._settle_ns
                del self._proving[name]

    def forget(self, vue_ids: Collection[str]) -> None:
        """Keep the guards of these devices only."""
        self._guards = {vue: ends for vue, ends in self._guards.items() if vue in vue_ids}
