"""Which devices are tracked: names come from anybody who is heard, tracks and topics cost."""

from __future__ import annotations

import re
from collections import Counter

NOT_ALLOWED, TOO_MANY = "not_allowed", "too_many_devices"
_NEVER = -1


class Admission:
    """At most ``limit`` devices, of names that ``pattern`` matches as a whole (empty: any).

    Where all places are taken, a device of which nothing sound has come, or else the one that is
    silent longest and for longer than ``silence_ns``, makes room for one of which something sound
    comes. By stamps alone, so that a replay admits the same.
    """

    def __init__(self, limit: int, pattern: str, silence_ns: int) -> None:
        self.set_limits(limit, pattern, silence_ns)
        self._sound_ns: dict[str, int] = {}  # stamp of the newest sound item, by device
        self._refused: Counter[str] = Counter()
        self._last_refused = ""

    def set_limits(self, limit: int, pattern: str, silence_ns: int) -> None:
        """Go on with other limits; who is admitted stays."""
        self._limit = limit
        self._pattern = re.compile(pattern) if pattern else None
        self._silence_ns = silence_ns

    def admit(self, vue_id: str, stamp_ns: int, *, sound: bool) -> tuple[str | None, str | None]:
        """Take note of an item of a device; the reason why the device is not admitted, and the
        device that makes room for it, None each."""
        if vue_id in self._sound_ns:
            if sound:
                self._sound_ns[vue_id] = max(stamp_ns, self._sound_ns[vue_id])
            return None, None
        if self._pattern is not None and not self._pattern.fullmatch(vue_id):
            return self._turn_away(vue_id, NOT_ALLOWED), None
        leaves = None
        if len(self._sound_ns) >= self._limit:
            leaves = self._who_leaves(stamp_ns) if sound else None
            if leaves is None:
                return self._turn_away(vue_id, TOO_MANY), None
            del self._sound_ns[leaves]
        self._sound_ns[vue_id] = stamp_ns if sound else _NEVER
        return None, leaves

    def _who_leaves(self, stamp_ns: int) -> str | None:
        silent, last_ns = min(self._sound_ns.items(), key=lambda entry: (entry[1], entry[0]))
        return silent if last_ns == _NEVER or stamp_ns - last_ns > self._silence_ns else None

    def _turn_away(self, vue_id: str, reason: str) -> str:
        self._refused[reason] += 1
        self._last_refused = vue_id
        return reason

    def warnings(self) -> list[str]:
        """What an operator is told of devices that were not admitted."""
        remedies = {
            TOO_MANY: f"max_devices is {self._limit}; raise it, or say with allowed_devices whose "
            "names count",
            NOT_ALLOWED: "allowed_devices does not match",
        }
        return [
            f"{count} messages of devices not admitted ({reason}; the last: "
            f"{self._last_refused!r}): {remedies[reason]}"
            for reason, count in sorted(self._refused.items())
        ]
