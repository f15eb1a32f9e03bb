"""Whose clock is right: agreement of the sources of one device, from stamps and order of arrival.

A source whose stamps run ahead of all others is heard only if no more others contradict it than
agree with it; sources that run behind a single one that was first take the time back. Who is
alone is the stranger, until its stamps are those of the others again. After a silence everybody
is ahead: the first one waits for a second voice, its own next measurement or that of another.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, auto

NS = 1_000_000_000
TOLERANCE_NS = NS
"""Stamps no further apart agree."""
_INTERVALS = 1.5
_LASTS_NS = NS  # for which sources must keep their distance before they take the time back


class Verdict(Enum):
    """What becomes of an item."""

    TAKE = auto()
    WAIT = auto()
    """Nobody has agreed with it or contradicted it yet."""
    AHEAD = auto()
    """Contradicted by others."""
    FUTURE = auto()
    """The only source, too far ahead to be believed at once."""
    LATE = auto()
    SET_BACK = auto()
    """The time that counted was a stranger's: start anew."""


class Side(Enum):
    """Where the last stamp of a source was against the time that counts."""

    WITH = auto()
    AHEAD = auto()
    BEHIND = auto()


@dataclass(slots=True)  # replaced, never changed; frozen ones take four times as long to make
class _Source:
    """stamp_ns and arrival of the last item; interval_ns between the last two that counted; side
    since which arrival, with which stamp and distance from the newest it began; how long it then
    waits."""

    stamp_ns: int
    arrival: int
    interval_ns: int = 0
    side: Side = Side.WITH
    since: int = 0
    first_ns: int = 0
    apart_ns: int = 0
    patience_ns: int = 0


@dataclass(frozen=True, slots=True)
class Stranger:
    """A source that stands against ``others`` with a clock ``offset_s`` ahead of theirs."""

    offset_s: float
    others: int

    def words(self) -> str:
        """For people."""
        side = "ahead of" if self.offset_s > 0.0 else "behind"
        count = {1: "another", 2: "two others", 3: "three others"}.get(
            self.others, f"{self.others} others"
        )
        return f"clock {abs(self.offset_s):.1f} s {side} {count}"


@dataclass(slots=True)
class Clocks:
    """The clocks of all sources of one device. ``future_ns``: how far ahead an only source is
    believed at once."""

    future_ns: int = 60 * NS
    newest_ns: int = 0
    """The newest stamp that counts; 0: none."""
    _sources: dict[str, _Source] = field(default_factory=dict)
    _rsus: set[str] = field(default_factory=set)
    _arrivals: int = 0

    def hear(
        self, name: str, stamp_ns: int, late_before_ns: int, *, is_rsu: bool = True
    ) -> Verdict:
        """Judge an item of a source; stamps older than ``late_before_ns`` are late. Only RSUs
        wait, and only for each other."""
        self._arrivals += 1
        if is_rsu:
            self._rsus.add(name)
        before = self._sources.get(name)
        if self.newest_ns > 0 and stamp_ns > self.newest_ns + self._reach_ns(before):
            return self._ahead(name, before, stamp_ns)
        if stamp_ns < late_before_ns:
            return self._behind(name, before, stamp_ns)
        self._take(name, before, stamp_ns)
        return Verdict.TAKE

    def advance(self, stamp_ns: int) -> None:
        """Note that the device itself, by its IMU, has reached a stamp."""
        self.newest_ns = max(self.newest_ns, stamp_ns)

    def settled(self, name: str, stamp_ns: int) -> Verdict:
        """What has become of an item that waited: TAKE, AHEAD, or still WAIT."""
        if self._sources[name].side is not Side.AHEAD:
            return Verdict.TAKE if stamp_ns <= self.newest_ns else Verdict.AHEAD
        agree, against = self._sides(name, Side.AHEAD)
        return Verdict.AHEAD if 0 < len(against) >= len(agree) else Verdict.WAIT

    def strangers(self) -> dict[str, Stranger]:
        """Sources whose clocks are not those of the others."""
        found = {}
        for name, source in self._sources.items():
            if source.side is Side.WITH:
                continue
            _, against = self._sides(name, source.side)
            if against:
                found[name] = Stranger(source.apart_ns / NS, len(against))
        return found

    def _reach_ns(self, before: _Source | None) -> int:
        usual = 0 if before is None else round(_INTERVALS * before.interval_ns)
        return max(TOLERANCE_NS, usual)

    def _take(self, name: str, before: _Source | None, stamp_ns: int) -> None:
        interval_ns = 0
        if before is not None:
            together = before.side is Side.WITH and stamp_ns - before.stamp_ns > 0
            interval_ns = stamp_ns - before.stamp_ns if together else before.interval_ns
        self._sources[name] = _Source(stamp_ns, self._arrivals, interval_ns)
        self.newest_ns = max(self.newest_ns, stamp_ns)

    def _beside(self, name: str, before: _Source | None, stamp_ns: int, side: Side) -> _Source:
        """The source with its side noted."""
        apart_ns = stamp_ns - self.newest_ns
        if before is None or before.side is not side:
            interval_ns = 0 if before is None else before.interval_ns
            source = _Source(
                stamp_ns, self._arrivals, interval_ns, side, self._arrivals, stamp_ns, apart_ns
            )
            if side is Side.AHEAD:
                previous = -1 if before is None else before.arrival
                source = replace(source, patience_ns=self._patience_ns(name, previous))
            self._sources[name] = source
            return source
        source = replace(before, stamp_ns=stamp_ns, arrival=self._arrivals)
        self._sources[name] = source
        return source

    def _patience_ns(self, name: str, previous: int) -> int:
        """How long an RSU that is ahead waits for a second voice, by its own stamps: until the
        others should have spoken; 0 where none has since its ``previous`` arrival."""
        others = [self._sources[other] for other in self._rsus - {name}]
        if name not in self._rsus or not any(s.arrival > previous for s in others):
            return 0
        usual_ns = max(source.interval_ns for source in others)
        return min(round(_INTERVALS * usual_ns) or TOLERANCE_NS, TOLERANCE_NS)

    def _sides(self, name: str, side: Side) -> tuple[list[str], list[str]]:
        """Sources on this side that agree with ``name``, and those that have spoken with the time
        that counts since the first of these began."""
        stamp_ns = self._sources[name].stamp_ns
        agree = [
            other
            for other, source in self._sources.items()
            if source.side is side and abs(source.stamp_ns - stamp_ns) <= TOLERANCE_NS
        ]
        began = min(self._sources[other].since for other in agree)
        against = [
            other
            for other, source in self._sources.items()
            if source.side is not side and source.arrival > began
        ]
        return agree, against

    def _ahead(self, name: str, before: _Source | None, stamp_ns: int) -> Verdict:
        suspect_ns = before.stamp_ns if before and before.side is Side.AHEAD else None
        source = self._beside(name, before, stamp_ns, Side.AHEAD)
        agree, against = self._sides(name, Side.AHEAD)
        if against and len(agree) <= len(against):
            return Verdict.AHEAD
        alone = len(agree) == 1 and not against
        if alone and stamp_ns - source.first_ns < source.patience_ns:
            return Verdict.WAIT
        far = stamp_ns > self.newest_ns + self.future_ns
        unheard_of = suspect_ns is None or abs(stamp_ns - suspect_ns) > self.future_ns
        if alone and far and unheard_of:
            return Verdict.FUTURE
        for other in agree:
            self._sources[other] = replace(self._sources[other], side=Side.WITH)
        self._sources[name] = replace(self._sources[name], side=Side.WITH)
        self.newest_ns = stamp_ns
        return Verdict.TAKE

    def _behind(self, name: str, before: _Source | None, stamp_ns: int) -> Verdict:
        self._beside(name, before, stamp_ns, Side.BEHIND)
        agree, against = self._sides(name, Side.BEHIND)
        if len(agree) < 2 or len(agree) <= len(against):
            return Verdict.LATE
        if not all(self._keeps_away(self._sources[other]) for other in agree):
            return Verdict.LATE
        self.newest_ns = max(self._sources[other].stamp_ns for other in agree)
        for other, source in self._sources.items():
            if other in agree:
                self._sources[other] = replace(source, side=Side.WITH)
            else:
                self._sources[other] = replace(
                    source,
                    side=Side.AHEAD,
                    since=0,
                    apart_ns=source.stamp_ns - self.newest_ns,
                )
        return Verdict.SET_BACK

    def _keeps_away(self, source: _Source) -> bool:
        """Whether a source that is behind stays as far behind: it does not catch up, as one does
        whose messages were delayed."""
        apart_ns = source.stamp_ns - self.newest_ns
        lasts = source.stamp_ns - source.first_ns >= _LASTS_NS
        return lasts and abs(apart_ns - source.apart_ns) <= TOLERANCE_NS
