"""Stamp order and epochs: which measurements belong together and when they may be applied.

Messages of one channel (one topic) arrive in stamp order, those of different channels do not. An
epoch, all items of one stamp, is
released once nothing older or equal can be missing: its RSU measurements are complete and every
live channel has reached its stamp.
What is still missing is waited for until the newest stamp is ``hold`` ahead; from RSUs no longer
than they have been late before. What comes later than that belongs to an epoch already applied: it
is kept apart, for the track to go back to that epoch, unless it is older than the history. The
result depends on stamps alone, never on a clock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from netpos.messages.values import GroundSpeed, InitialPose, RsuMeasurement, Velocity
from netpos.tracking.door.voices import CONFLICT
from netpos.tracking.ordering.clocks import Clocks, Verdict

Item = RsuMeasurement | Velocity | GroundSpeed | InitialPose

RSU = "rsu"
IMU = "imu"
POSE = "initial_pose"  # before RSU in the order of application
_LIVE_NS = 1_000_000_000
_WAITS = "waits"
_REASONS: dict[Verdict, str | None] = {
    Verdict.TAKE: None,
    Verdict.WAIT: _WAITS,
    Verdict.AHEAD: "clock_ahead",
    Verdict.FUTURE: "future_stamp",
    Verdict.LATE: "late",
    Verdict.SET_BACK: "late",
}
_FORGETS = 8  # stamps after which an RSU that is no longer late is taken to be on time
_SET_BACK_AFTER = 10  # stamps in a row from before the history: the device's time was set back


_VALUES = tuple(
    name
    for name in RsuMeasurement.__slots__
    if name not in ("sequence", "expected", "line_of_sight", "rssi_dbm")
)


def says_the_same(one: Item, other: Item) -> bool:
    """Whether an RSU measured the same in both; of other items only one can be of a stamp."""
    return not (isinstance(one, RsuMeasurement) and isinstance(other, RsuMeasurement)) or all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in _VALUES
    )


def channel_and_source(item: Item) -> tuple[str, str]:
    """Channel an item arrived on and who sent it; their order is the order of application within
    an epoch."""
    if isinstance(item, RsuMeasurement):
        pair = item.reference_rsu_id
        return RSU, f"{item.rsu_id}-{pair}" if pair else item.rsu_id
    if isinstance(item, InitialPose):
        return POSE, ""
    return item.source, item.source


@dataclass(slots=True)
class Epoch:
    """All items of one stamp, ordered by channel and source. ``withdrawn``: of whom two items
    contradicted each other; neither is among the items. ``unawaited``: RSUs without which the
    epoch is complete."""

    stamp_ns: int
    items: dict[tuple[str, str], Item] = field(default_factory=dict)
    withdrawn: frozenset[tuple[str, str]] = frozenset()
    unawaited: frozenset[tuple[str, str]] = frozenset()
    _measured: int = 0
    _expected: int = 0
    _poses: int = 0

    def put(self, key: tuple[str, str], item: Item) -> None:
        """Take an item under its channel and source; a second one of an RSU withdraws both."""
        if key[0] == RSU and (key in self.items or key in self.withdrawn):
            self.items.pop(key, None)
            self.withdrawn |= {key}
            return
        self.items[key] = item
        if key[0] == RSU and key not in self.unawaited:
            self._measured += 1
            self._expected = max(self._expected, item.expected)  # type: ignore[union-attr]
        elif key[0] == POSE:
            self._poses += 1

    def sorted(self) -> Iterator[Item]:
        """Items in the order in which they are applied."""
        if len(self.items) == 1:
            return iter(self.items.values())
        return map(self.items.__getitem__, sorted(self.items))

    @property
    def measured(self) -> int:
        """RSU measurements awaited that are here."""
        return self._measured

    def rsu_complete(self, least: int = 0, silenced: int = 0) -> bool:
        """Every RSU measurement announced by ``expected`` is here, but for those of ``silenced``
        RSUs, and at least as many as ``least``; False where the number is not announced, or where
        nobody awaited has spoken yet."""
        if not self._measured:
            return not self.unawaited
        return 0 < self._expected <= self._measured + silenced and least <= self._measured

    def is_late_pose(self) -> bool:
        """Nothing but an initial pose of an older stamp: it came after what else is of this
        one."""
        return self.only_a_pose() and any(i.stamp_ns != self.stamp_ns for i in self.items.values())

    def only_a_pose(self) -> bool:
        """Nothing but an initial pose: measurements of its stamp may be under way."""
        return self._poses == len(self.items)


class _Delays:
    """How the measurements of RSUs usually come: how late, and how many of one stamp where more
    come than are announced."""

    def __init__(self) -> None:
        self.count = 0
        """As many as have come of late where too few were announced; 0 where that is right."""
        self._late: dict[str, tuple[int, int]] = {}  # how late, newest stamp; of late RSUs only

    def arrived(self, source: str, stamp_ns: int, behind_ns: int) -> None:
        """A stamp came when the newest of all RSUs was ``behind_ns`` ahead of it."""
        late, _ = self._late.pop(source, (0, 0))
        late = max(behind_ns, late - (late - behind_ns) // _FORGETS)
        if late > 0:
            self._late[source] = late, stamp_ns

    def late_ns(self, since_ns: int) -> int:
        """How late the latest RSU is, of those heard since a stamp."""
        return max((late for late, at in self._late.values() if at >= since_ns), default=0)

    def announced_too_few(self, came: int) -> None:
        """One more came after an epoch that was complete as announced."""
        self.count = max(self.count, came)

    def released(self, came: int) -> None:
        """An epoch was applied with so many measurements."""
        if 0 < came < self.count:
            self.count = came if came > 1 else 0


class Sequencer:
    """Collects the items of one device and releases epochs in stamp order."""

    def __init__(
        self,
        max_delay_ns: int,
        needs_pose: bool = False,
        history_ns: int = 0,
        future_ns: int = 1 << 62,
        live_ns: int = _LIVE_NS,
        tick_ns: int = 0,
        clocks: Clocks | None = None,
        awaits: Callable[[RsuMeasurement], bool] | None = None,
    ) -> None:
        """``needs_pose``: nothing is complete before an initial pose, so that it is waited for.

        ``history_ns``: how much older than the newest applied epoch an item may be. ``future_ns``:
        an only source this far ahead counts once its next stamp confirms it. ``clocks``: those of
        the device as known before a new start. ``awaits``: whether an epoch waits for the RSU of
        a measurement, and for those that it announces; None: for all. ``live_ns``: a
        channel this far, or ``max_delay_ns``, behind the newest stamp is not waited for.
        ``tick_ns``: once an RSU was heard, an epoch, without items if need be, at every multiple
        of it that the IMU reaches; 0: none.
        """
        self._max_delay_ns = max_delay_ns
        self._needs_pose = needs_pose
        self._awaits = awaits
        self._history_ns = history_ns
        self.clocks = clocks or Clocks(future_ns)
        """Whose clock is right; outlasts a new start."""
        # Between measurements of one a second, and their way here, ticks wait for them.
        self._live_ns = max(live_ns, max_delay_ns) + (max_delay_ns if tick_ns > 0 else 0)
        self._tick_ns = tick_ns
        self._pending: dict[int, Epoch] = {}
        self._applied: dict[int, Epoch] = {}
        self._late: list[tuple[int, Item]] = []
        self._watermark: dict[str, int] = {}
        self.newest_ns = 0
        """Newest stamp heard; 0 before the first."""
        self._released_ns = -1
        self._last_of: dict[tuple[str, str], int] = {}
        self._waiting: list[Item] = []  # ahead of all others, until a second voice
        self._refused: list[tuple[Item, str]] = []
        self._delays = _Delays()
        self._late_in_row = 0
        self.set_back = False
        """The device's time was set back: start anew."""
        self.silenced = 0
        """RSUs that are not heard now, though others announce them."""
        self.idle = False
        """Nothing can be released before the next item: the one epoch there is waits for
        measurements of its stamp."""

    def add(self, item: Item) -> str | None:
        """Take an item; returns the reason when it is refused (``late``, ``future_stamp``,
        ``clock_ahead``, ``duplicate`` or ``conflict``). One that waits for a second voice may be
        refused later (``take_refused``), and so is one that another of its RSU and stamp
        contradicts."""
        self.idle = False
        if isinstance(item, InitialPose):
            late = item.stamp_ns <= self._released_ns
            return self._admit(item, max(self._released_ns, 1) if late else item.stamp_ns)
        fault = self._time_fault(item)
        if fault == _WAITS:
            self._waiting.append(item)
            return None
        if self._waiting:
            self._settle()
        return fault or self._admit(item, item.stamp_ns)

    def _admit(self, item: Item, stamp: int) -> str | None:
        """Put an item into its epoch."""
        key = channel_and_source(item)
        awaited = self._is_awaited(item)
        if awaited:
            behind = max(self._watermark.get(RSU, stamp) - stamp, 0)
            self._delays.arrived(key[1], stamp, behind)
        in_past = stamp <= self._released_ns and not isinstance(item, InitialPose)
        if in_past and self._history_ns > 0:
            self.mark(key[0], stamp)  # first heard of late, it is waited for from now on
            return self._add_late(stamp, key, item)
        if in_past and stamp < self._released_ns:
            return "late"
        epoch = self._pending.get(stamp)
        if self._last_of.get(key) == stamp:
            return "duplicate"
        if epoch is None:
            epoch = self._pending[stamp] = Epoch(stamp)
        fault, withdraws = self._second(epoch, key, item, [])
        if key[0] == RSU and not awaited:
            epoch.unawaited |= {key}
        if fault is None or withdraws:
            epoch.put(key, item)
        if fault is not None:
            return fault
        self.mark(key[0], stamp)
        alone = len(self._pending) == 1 and stamp == self.newest_ns and self._max_delay_ns > 0
        complete = epoch.rsu_complete(self._delays.count, self.silenced)
        self.idle = alone and not complete and not self._waiting
        return None

    def _is_awaited(self, item: Item) -> bool:
        """Whether epochs wait for the RSU of an item."""
        if not isinstance(item, RsuMeasurement):
            return False
        return self._awaits is None or self._awaits(item)

    def mark(self, channel: str, stamp_ns: int) -> None:
        """Note that a channel has reached a stamp."""
        self.idle = False
        if channel == IMU:
            self.clocks.advance(stamp_ns)
        if channel == IMU and self._tick_ns > 0 and RSU in self._watermark:
            self._tick(self._watermark.get(channel, stamp_ns), stamp_ns)
        if stamp_ns > self._watermark.get(channel, -1):
            self._watermark[channel] = stamp_ns
            self.newest_ns = max(stamp_ns, self.newest_ns)

    def _tick(self, from_ns: int, to_ns: int) -> None:
        """Have epochs at the multiples of the tick after ``from_ns``, none older than a second."""
        first = max(from_ns, to_ns - self._live_ns, self._released_ns) // self._tick_ns + 1
        for count in range(first, to_ns // self._tick_ns + 1):
            stamp = count * self._tick_ns
            if stamp not in self._pending:
                self._pending[stamp] = Epoch(stamp)

    def take_late(self) -> list[tuple[int, Item]]:
        """Late items and their stamps, oldest first, to be merged into epochs applied before."""
        if not self._late:
            return []
        late, self._late = self._late, []
        return sorted(late, key=lambda entry: (entry[0], channel_and_source(entry[1])))

    def applied(self, epoch: Epoch) -> None:
        """Note that a late item made a new epoch in the past."""
        self._applied[epoch.stamp_ns] = epoch

    def _time_fault(self, item: Item) -> str | None:
        """What is wrong with the stamp of an item; ``_WAITS`` while that is not known."""
        stamp = item.stamp_ns
        oldest = self._released_ns - self._history_ns if self._released_ns >= 0 else 0
        is_rsu = isinstance(item, RsuMeasurement)
        verdict = self.clocks.hear(channel_and_source(item)[1], stamp, oldest, is_rsu=is_rsu)
        self._late_in_row = self._late_in_row + 1 if verdict is Verdict.LATE else 0
        self.set_back = verdict is Verdict.SET_BACK or self._late_in_row >= _SET_BACK_AFTER
        return _REASONS[verdict]

    def take_refused(self) -> list[tuple[Item, str]]:
        """Items that waited for a second voice and were contradicted, and the reason."""
        refused, self._refused = self._refused, []
        return refused

    def _settle(self) -> None:
        """Take the items that waited and are agreed with by now, refuse those contradicted."""
        waiting, self._waiting = self._waiting, []
        for item in waiting:
            verdict = self.clocks.settled(channel_and_source(item)[1], item.stamp_ns)
            if verdict is Verdict.WAIT:
                self._waiting.append(item)
                continue
            reason = _REASONS[verdict] or self._admit(item, item.stamp_ns)
            if reason is not None:
                self._refused.append((item, reason))

    def _add_late(self, stamp: int, key: tuple[str, str], item: Item) -> str | None:
        epoch = self._applied.get(stamp)
        waiting = [i for s, i in self._late if (s, channel_and_source(i)) == (stamp, key)]
        fault, withdraws = self._second(epoch, key, item, waiting)
        if fault is None or withdraws:
            self._late.append((stamp, item))
        if fault is not None:
            return fault
        if key[0] != RSU or epoch is None:
            return None
        if not self._is_awaited(item):
            epoch.unawaited |= {key}
        elif epoch.rsu_complete():
            more = sum(s == stamp and self._is_awaited(i) for s, i in self._late)
            self._delays.announced_too_few(epoch.measured + more)
        return None

    def _second(
        self, epoch: Epoch | None, key: tuple[str, str], item: Item, waiting: list[Item]
    ) -> tuple[str | None, bool]:
        """What is wrong with an item of a stamp and source of which another is there or waits for
        its epoch, and whether it withdraws that one."""
        if epoch is not None and key in epoch.withdrawn:
            return CONFLICT, False
        known = [epoch.items[key]] if epoch is not None and key in epoch.items else []
        known += waiting
        if not known:
            return None, False
        if any(says_the_same(item, other) for other in known):
            return "duplicate", False
        if len(known) > 1:
            return CONFLICT, False
        self._refused.append((known[0], CONFLICT))
        return CONFLICT, True

    def release(self) -> list[Epoch]:
        """Epochs that may be applied now, in stamp order."""
        released = []
        while self._pending:
            stamp = min(self._pending) if len(self._pending) > 1 else next(iter(self._pending))
            if not self._ready(self._pending[stamp]):
                break
            released.append(self._take(stamp))
        return released

    def flush(self) -> list[Epoch]:
        """All that is pending, in stamp order: the end of a recording, or a silence.

        A pose that nothing has followed stays: it waits for the first measurement, however long
        that takes, so that both are one epoch.
        """
        waiting, self._waiting = self._waiting, []
        for item in waiting:  # nobody has contradicted them
            reason = self._admit(item, item.stamp_ns)
            if reason is not None:
                self._refused.append((item, reason))
        newest = self.newest_ns
        return [
            self._take(stamp)
            for stamp, epoch in sorted(self._pending.items())
            if newest > stamp or not epoch.only_a_pose()
        ]

    def _take(self, stamp: int) -> Epoch:
        epoch = self._pending.pop(stamp)
        self._delays.released(epoch.measured)
        self._released_ns = max(self._released_ns, stamp)
        if self._history_ns > 0:
            if not (stamp in self._applied and epoch.is_late_pose()):
                self._applied[stamp] = epoch
            self._forget_applied(self._released_ns - self._history_ns)
        for key in epoch.items:
            self._last_of[key] = stamp
        return epoch

    def _forget_applied(self, before_ns: int) -> None:
        """Drop epochs older than the history; one that a late item made goes with those that were
        there before it."""
        while self._applied and (oldest := next(iter(self._applied))) < before_ns:
            del self._applied[oldest]

    def _ready(self, epoch: Epoch) -> bool:
        stamp, newest = epoch.stamp_ns, self.newest_ns
        if newest >= stamp + self._max_delay_ns:
            return True
        if self._needs_pose and POSE not in self._watermark:
            return False
        late_ns = self._delays.late_ns(newest - self._live_ns)
        reached = self._watermark.get(RSU, 0) > stamp + late_ns
        if not reached and not epoch.rsu_complete(self._delays.count, self.silenced):
            return False
        for channel, heard in self._watermark.items():
            if heard < stamp and heard >= newest - self._live_ns and channel != POSE:
                return False
        return newest > stamp or not epoch.only_a_pose()
