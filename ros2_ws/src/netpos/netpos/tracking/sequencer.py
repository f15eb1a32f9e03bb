"""Stamp order and epochs: which measurements belong together and when they may be applied.

Messages of one channel (one topic) arrive in stamp order, those of different channels do not. An
epoch, all items of one stamp, is
released once nothing older or equal can be missing: its RSU measurements are complete and every
live channel has reached its stamp.
What is still missing is waited for until the newest stamp is ``hold`` ahead. The result depends on
stamps alone, never on a clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from netpos.messages.values import GroundSpeed, InitialPose, RsuMeasurement, Velocity

Item = RsuMeasurement | Velocity | GroundSpeed | InitialPose

RSU = "rsu"
POSE = "initial_pose"  # before RSU in the order of application
_LIVE_NS = 1_000_000_000


def channel_and_source(item: Item) -> tuple[str, str]:
    """Channel an item arrived on and who sent it; their order is the order of application within
    an epoch."""
    match item:
        case InitialPose():
            return POSE, ""
        case RsuMeasurement():
            return RSU, item.rsu_id
        case _:
            return item.source, item.source


@dataclass(slots=True)
class Epoch:
    """All items of one stamp, ordered by channel and source."""

    stamp_ns: int
    items: dict[tuple[str, str], Item] = field(default_factory=dict)

    def sorted(self) -> Iterator[Item]:
        """Items in the order in which they are applied."""
        return (self.items[key] for key in sorted(self.items))

    def rsu_complete(self) -> bool:
        """Every RSU measurement announced by ``expected`` is here; False where the number is not
        announced."""
        measured = [i for i in self.items.values() if isinstance(i, RsuMeasurement)]
        if not measured:
            return True
        expected = max(m.expected for m in measured)
        return 0 < expected <= len(measured)

    def only_a_pose(self) -> bool:
        """Nothing but an initial pose: measurements of its stamp may be under way."""
        return all(isinstance(item, InitialPose) for item in self.items.values())


class Sequencer:
    """Collects the items of one device and releases epochs in stamp order."""

    def __init__(self, hold_ns: int, needs_pose: bool = False) -> None:
        """``needs_pose``: nothing is complete before an initial pose, so that it is waited for."""
        self._hold_ns = hold_ns
        self._needs_pose = needs_pose
        self._pending: dict[int, Epoch] = {}
        self._watermark: dict[str, int] = {}
        self._released_ns = -1
        self._last_of: dict[tuple[str, str], int] = {}

    def add(self, item: Item) -> str | None:
        """Take an item; returns the reason when it is refused (``late`` or ``duplicate``)."""
        stamp = item.stamp_ns
        key = channel_and_source(item)
        channel = key[0]
        if isinstance(item, InitialPose) and stamp <= self._released_ns:
            stamp = max(self._released_ns, 1)
        elif stamp < self._released_ns:
            return "late"
        epoch = self._pending.get(stamp)
        if self._last_of.get(key) == stamp or (epoch is not None and key in epoch.items):
            return "duplicate"
        if epoch is None:
            epoch = self._pending[stamp] = Epoch(stamp)
        epoch.items[key] = item
        self._watermark[channel] = max(stamp, self._watermark.get(channel, stamp))
        return None

    def release(self) -> list[Epoch]:
        """Epochs that may be applied now, in stamp order."""
        released = []
        while self._pending:
            stamp = min(self._pending)
            if not self._ready(self._pending[stamp]):
                break
            released.append(self._take(stamp))
        return released

    def flush(self) -> list[Epoch]:
        """All that is pending, in stamp order: the end of a recording, or a silence.

        A pose that nothing has followed stays: it waits for the first measurement, however long
        that takes, so that both are one epoch.
        """
        newest = max(self._watermark.values(), default=0)
        return [
            self._take(stamp)
            for stamp, epoch in sorted(self._pending.items())
            if newest > stamp or not epoch.only_a_pose()
        ]

    def _take(self, stamp: int) -> Epoch:
        epoch = self._pending.pop(stamp)
        self._released_ns = max(self._released_ns, stamp)
        for key in epoch.items:
            self._last_of[key] = stamp
        return epoch

    def _ready(self, epoch: Epoch) -> bool:
        if self._needs_pose and POSE not in self._watermark:
            return max(self._watermark.values()) >= epoch.stamp_ns + self._hold_ns
        newest = max(self._watermark.values())
        if newest >= epoch.stamp_ns + self._hold_ns:
            return True
        live = [c for c, w in self._watermark.items() if w >= newest - _LIVE_NS]
        reached = all(self._watermark[c] >= epoch.stamp_ns for c in live if c != POSE)
        closed = epoch.rsu_complete() or self._watermark.get(RSU, 0) > epoch.stamp_ns
        return reached and closed and (newest > epoch.stamp_ns or not epoch.only_a_pose())
