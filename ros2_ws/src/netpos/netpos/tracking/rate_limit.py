"""How much one RSU may send: who sends more than any RSU measures takes the time of the others."""

from __future__ import annotations

_NS = 1_000_000_000
_WINDOWS = 4
_SOURCES_MAX = 1000
_NONE: dict[int, int] = {}
RATE = "rate"
"""Reason for the refusal."""


class RateLimit:
    """At most so many measurements of an RSU in each second of their stamps: ``of_device`` of one
    device, ``of_all`` of all together.

    By the stamps and the order of one RSU alone, both of which a recording keeps, so that a replay
    refuses the same ones. The newest ``_WINDOWS`` seconds of a source are remembered.
    """

    def __init__(self, of_device: int, of_all: int) -> None:
        self.set_limits(of_device, of_all)
        self._counts: dict[tuple[str, str], dict[int, int]] = {}

    def set_limits(self, of_device: int, of_all: int) -> None:
        """Go on with other limits; what was counted stays."""
        self._of_device, self._of_all = of_device, of_all

    def exceeded(self, rsu_id: str, vue_id: str, stamp_ns: int) -> bool:
        """Whether another measurement with this stamp is one too many."""
        second, counts = stamp_ns // _NS, self._counts
        of_all = counts.get((rsu_id, ""), _NONE).get(second, 0)
        return of_all >= self._of_all or (
            counts.get((rsu_id, vue_id), _NONE).get(second, 0) >= self._of_device
        )

    def count(self, rsu_id: str, vue_id: str, stamp_ns: int) -> None:
        """Take note of a measurement within the limits."""
        for source in ((rsu_id, ""), (rsu_id, vue_id)):
            self._count(source, stamp_ns // _NS)

    def _count(self, source: tuple[str, str], second: int) -> None:
        seconds = self._counts.get(source)
        if seconds is None:
            if len(self._counts) >= _SOURCES_MAX:
                del self._counts[next(iter(self._counts))]
            seconds = self._counts[source] = {}
        seconds[second] = seconds.get(second, 0) + 1
        if len(seconds) > _WINDOWS:
            del seconds[next(iter(seconds))]
