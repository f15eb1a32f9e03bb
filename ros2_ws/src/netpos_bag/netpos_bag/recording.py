"""Which log time a received message gets, and what waits until that is known.

In simulated time (a /clock is published) the log time is the latest /clock received: a bag
recorded at ten times real time plays back at its own pace, and messages keep the order in which
they arrived, late ones included. Header stamps would hide lateness, and not every message has one.
Nothing is stamped 0: what arrives before the first /clock waits for it. Without /clock it is the
time of receipt.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from netpos.bags import BagWriter

from netpos_bag.parameters import LogTime

PATIENCE_NS = 1_000_000_000  # auto: no publisher of /clock after so long means system time


@dataclass(slots=True)
class Recording:
    """Messages on their way into a bag. Times are integer nanoseconds, ``wall_ns`` since 1970."""

    writer: BagWriter
    log_time: LogTime
    backward_jumps: int = 0
    _clock_ns: int | None = None
    _since_ns: int | None = None
    _waiting: list[tuple[str, str, bytes, int]] = field(default_factory=list)

    @property
    def waiting(self) -> int:
        """Messages that wait for their log time."""
        return len(self._waiting)

    def clock(self, time_ns: int) -> None:
        """A /clock message arrived: from the first one on it gives the log time."""
        if self.log_time is LogTime.SYSTEM or time_ns <= 0:
            return
        if self._clock_ns is not None and time_ns < self._clock_ns:
            self.backward_jumps += 1
        self._clock_ns = time_ns
        self.log_time = LogTime.CLOCK
        self._release()

    def message(self, topic: str, type_name: str, cdr: bytes, wall_ns: int) -> None:
        """Write a message, or keep it until its log time is known."""
        if self._waiting or (self.log_time is not LogTime.SYSTEM and self._clock_ns is None):
            self._waiting.append((topic, type_name, cdr, wall_ns))
            return
        stamp_ns = wall_ns if self._clock_ns is None else self._clock_ns
        self.writer.write_raw(topic, type_name, cdr, stamp_ns)

    def tick(self, wall_ns: int, clock_is_published: bool) -> None:
        """Call a few times per second: settles ``auto`` and hands the messages to the system."""
        if self.log_time is LogTime.AUTO:
            if clock_is_published or not self._waiting:
                self._since_ns = None
            elif self._since_ns is None:
                self._since_ns = wall_ns
            elif wall_ns - self._since_ns >= PATIENCE_NS:
                self.log_time = LogTime.SYSTEM
                self._release()
        self.writer.flush()

    def close(self) -> None:
        """Finish the bag; what waits for a /clock that never came gets its time of receipt."""
        self._release()
        self.writer.close()

    def _release(self) -> None:
        for topic, type_name, cdr, wall_ns in self._waiting:
            stamp_ns = wall_ns if self._clock_ns is None else self._clock_ns
            self.writer.write_raw(topic, type_name, cdr, stamp_ns)
        self._waiting.clear()
