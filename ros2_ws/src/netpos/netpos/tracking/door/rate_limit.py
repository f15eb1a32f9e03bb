"""How much one RSU may send: who sends more than any RSU measures takes the time of the others."""

from __future__ import annotations

_NS = 1_000_000_000
_WINDOWS = 4
_SOURCES_MAX = 1000
_STAMPS = 64
_NONE: dict[int, int] = {}
RATE = "rate"
"""Reason for the refusal."""


class RateLimit:
    """At most so many measurements of an RSU in each second of their stamps: ``of_device`` of one
    device, ``of_all`` of all together. Two stamps of one device closer than half the period of
    ``of_device`` are one too many as well: the noise of a receiver is not new so soon, and what is
    repeated there would count as evidence of its own.

    By the stamps and the order of one RSU alone, both of which a recording keeps, so that a replay
    refuses the same ones. The newest ``_WINDOWS`` seconds of a source are remembered, and
    its newest ``_STAMPS`` stamps.
    """

    def __init__(self, of_device: int, of_all: int) -> None:
        self._counts: dict[tuple[str, str], dict[int, int]] = {}
        self._stamps: dict[tuple[str, str], dict[int, int]] = {}  # by multiples of _apart_ns
        self.set_limits(of_device, of_all)

    def set_limits(self, of_device: int, of_all: int) -> None:
        """Go on with other limits; what was counted stays."""
        self._of_device, self._of_all = of_device, of_all
        self._apart_ns = max(_NS // (2 * of_device), 1)
        for source, stamps in self._stamps.items():
            self._stamps[source] = {ns // self._apart_ns: ns for ns in stamps.values()}

    def exceeded(self, rsu_id: str, vue_id: str, stamp_ns: int) -> bool:
        """Whether another measurement with this stamp is one too many."""
        if self._too_close((rsu_id, vue_id), stamp_ns):
            return True
        second, counts = stamp_ns // _NS, self._counts
        of_all = counts.get((rsu_id, ""), _NONE).get(second, 0)
        return of_all >= self._of_all or (
            counts.get((rsu_id, vue_id), _NONE).get(second, 0) >= self._of_device
        )

    def count(self, rsu_id: str, vue_id: str, stamp_ns: int) -> None:
        """Take note of a measurement within the limits."""
        for source in ((rsu_id, ""), (rsu_id, vue_id)):
            self._count(source, stamp_ns // _NS)

    def took(self, rsu_id: str, vue_id: str, stamp_ns: int) -> None:
        """Take note of the stamp of a measurement that is used: others keep a distance."""
        stamps = _of_source(self._stamps, (rsu_id, vue_id))
        stamps[stamp_ns // self._apart_ns] = stamp_ns
        if len(stamps) > _STAMPS:
            del stamps[next(iter(stamps))]

    def forget(self, vue_id: str) -> None:
        """A device starts anew, its time with it."""
        for source in [source for source in self._stamps if source[1] == vue_id]:
            del self._stamps[source]

    def _too_close(self, source: tuple[str, str], stamp_ns: int) -> bool:
        """Whether a stamp is near to another one, and not the same."""
        stamps = self._stamps.get(source)
        if stamps is None:
            return False
        slot = stamp_ns // self._apart_ns
        near = [stamps[k] for k in (slot - 1, slot, slot + 1) if k in stamps]
        return any(0 < abs(ns - stamp_ns) < self._apart_ns for ns in near)

    def _count(self, source: tuple[str, str], second: int) -> None:
        seconds = _of_source(self._counts, source)
        seconds[second] = seconds.get(second, 0) + 1
        if len(seconds) > _WINDOWS:
            del seconds[next(iter(seconds))]


def _of_source(
    kept: dict[tuple[str, str], dict[int, int]], source: tuple[str, str]
) -> dict[int, int]:
    """What is kept of a source; of too many the first makes room."""
    found = kept.get(source)
    if found is None:
        if len(kept) >= _SOURCES_MAX:
            del kept[next(iter(kept))]
        found = kept[source] = {}
    return found
