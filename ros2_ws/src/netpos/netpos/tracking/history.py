"""What a track has applied lately, so that it can go back when a measurement comes late."""

from __future__ import annotations

from collections import deque
from typing import Generic, Protocol, TypeVar

from netpos.tracking.sequencer import Epoch, Item, channel_and_source

_SNAPSHOTS = 2  # states kept per length of the history


class _Copied(Protocol):
    def copy(self) -> _Copied:
        """An independent copy."""


State = TypeVar("State", bound=_Copied)


class History(Generic[State]):
    """The epochs of the last ``length_ns`` and states from which all of them can be applied
    again; nothing for 0."""

    def __init__(self, length_ns: int) -> None:
        self._length_ns = length_ns
        self._epochs: deque[Epoch] = deque()
        self._snapshots: deque[tuple[int, State]] = deque()
        self._mark_ns = 0

    def clear(self) -> None:
        """Forget all."""
        self._epochs.clear()
        self._snapshots.clear()

    def states(self) -> list[State]:
        """The states that are kept."""
        return [state for _, state in self._snapshots]

    def mark(self, state: State) -> None:
        """Keep the ``state`` after the newest epoch: what comes late but is newer than that never
        goes back further."""
        if self._epochs:
            self._mark_ns = self._epochs[-1].stamp_ns + 1
            self._snapshots.append((self._mark_ns, state.copy()))  # type: ignore[arg-type]

    def remember(self, epoch: Epoch, state: State) -> None:
        """Keep the epoch about to be applied and, from time to time, a copy of the ``state``
        before it."""
        if self._length_ns == 0:
            return
        stamp = epoch.stamp_ns
        self._epochs.append(epoch)
        due = not self._snapshots or (
            stamp - self._snapshots[-1][0] >= self._length_ns // _SNAPSHOTS
        )
        if self._snapshots and self._snapshots[-1][0] < self._mark_ns <= stamp:
            self._snapshots.append((self._mark_ns, state.copy()))  # type: ignore[arg-type]
        elif due:
            self._snapshots.append((stamp, state.copy()))  # type: ignore[arg-type]
        while len(self._snapshots) > 1 and self._snapshots[1][0] <= stamp - self._length_ns:
            self._snapshots.popleft()
        while self._epochs[0].stamp_ns < self._snapshots[0][0]:
            self._epochs.popleft()

    def go_back(self, stamp_ns: int) -> tuple[list[Epoch], State | None]:
        """The newest state kept from before ``stamp_ns`` and the epochs applied since, in their
        order; both are forgotten here."""
        while len(self._snapshots) > 1 and self._snapshots[-1][0] > stamp_ns:
            self._snapshots.pop()
        if not self._snapshots:
            return [], None
        first_ns, state = self._snapshots.pop()
        epochs: list[Epoch] = []
        while self._epochs and self._epochs[-1].stamp_ns >= first_ns:
            epochs.append(self._epochs.pop())
        return epochs[::-1], state


def merge(epochs: list[Epoch], stamp_ns: int, item: Item) -> Epoch | None:
    """Put a late item into the epoch of its stamp; returns the epoch where that is a new one,
    inserted in its place. A pose that came late stays what it is: the item comes before it."""
    place = 0
    for epoch in epochs:
        if epoch.stamp_ns == stamp_ns and not epoch.is_late_pose():
            epoch.put(channel_and_source(item), item)
            return None
        if epoch.stamp_ns < stamp_ns:
            place += 1
    new = Epoch(stamp_ns)
    new.put(channel_and_source(item), item)
    epochs.insert(place, new)
    return new
