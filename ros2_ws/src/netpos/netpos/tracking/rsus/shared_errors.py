"""What the devices of one tracker have learned of the same RSUs, for each other.

A device takes over what others had concluded ``settle_s`` before its own stamp, as the health of
the RSUs does: while no measurement comes later than that, it does not depend on the order of
arrival. A track that goes back in time takes back what it concluded since. A track that starts
anew is another one for itself: it takes over what it knew.
"""

from __future__ import annotations

from collections import deque

from netpos.tracking.rsus.learning import Learned, Name


class SharedErrors:
    """What is learned by RSU and quantity, and by who learned it."""

    def __init__(self, settle_s: float) -> None:
        self._settle_ns = round(1e9 * settle_s)
        self._learned: dict[Name, dict[tuple[str, int], deque[tuple[int, Learned]]]] = {}

    def note(self, owner: tuple[str, int], stamp_ns: int, name: Name, learned: Learned) -> None:
        """Take what a device, in its life number ``owner[1]``, has concluded."""
        kept = self._learned.setdefault(name, {}).setdefault(owner, deque())
        kept.append((stamp_ns, learned))
        while len(kept) > 1 and kept[1][0] <= stamp_ns - 2 * self._settle_ns:
            kept.popleft()

    def clear(self) -> None:
        """Forget everything: the clock jumped back."""
        self._learned.clear()

    def rewind(self, vue_id: str, stamp_ns: int) -> None:
        """Take back what a device concluded from ``stamp_ns`` on."""
        for owners in self._learned.values():
            for (vue, _), kept in owners.items():
                while vue == vue_id and kept and kept[-1][0] >= stamp_ns:
                    kept.pop()

    def of_others(self, owner: tuple[str, int], stamp_ns: int, name: Name) -> list[Learned]:
        """What all but ``owner`` had concluded of ``name`` by then."""
        before_ns = stamp_ns - self._settle_ns
        found = []
        for other, kept in sorted(self._learned.get(name, {}).items()):
            if other != owner:
                found += [it for at_ns, it in reversed(kept) if at_ns <= before_ns][:1]
        return found
