"""Which devices are tracked: names come from anybody who is heard, tracks and topics cost."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

NOT_ALLOWED, TOO_MANY = "not_allowed", "too_many_devices"


@dataclass(slots=True)
class _Device:
    """Sound items of a device: stamps of the first and the newest, and how many; whether it had a
    fix."""

    first_ns: int = 0
    newest_ns: int = 0
    sound: int = 0
    fixed: bool = False

    def hear(self, stamp_ns: int) -> None:
        """Note a sound item."""
        self.first_ns = min(self.first_ns, stamp_ns) if self.sound else stamp_ns
        self.newest_ns = max(self.newest_ns, stamp_ns)
        self.sound += 1


class Admission:
    """At most ``limit`` devices, of names that ``pattern`` matches as a whole (empty: any).

    A device without a fix is a candidate. Where all places are taken, the candidate of which the
    fewest sound items have come makes room for a new device of which something sound comes. So
    candidates never displace a device that had a fix, and names that are made up, each heard once,
    displace each other. A device that had a fix makes room where it is silent for longer than
    ``silence_ns``. By stamps and the order of the items alone, so that a replay admits the same.
    """

    def __init__(self, limit: int, pattern: str, silence_ns: int) -> None:
        self.set_limits(limit, pattern, silence_ns)
        self._devices: dict[str, _Device] = {}
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
        known = self._devices.get(vue_id)
        if known is not None:
            if sound:
                known.hear(stamp_ns)
            return None, None
        if self._pattern is not None and not self._pattern.fullmatch(vue_id):
            return self._turn_away(vue_id, NOT_ALLOWED), None
        leaves = None
        if len(self._devices) >= self._limit:
            leaves = self._who_leaves(stamp_ns) if sound else None
            if leaves is None:
                return self._turn_away(vue_id, TOO_MANY), None
            del self._devices[leaves]
        device = self._devices[vue_id] = _Device()
        if sound:
            device.hear(stamp_ns)
        return None, leaves

    def note_fix(self, vue_id: str) -> None:
        """A device has a fix: it is a candidate no more."""
        device = self._devices.get(vue_id)
        if device is not None:
            device.fixed = True

    def waits_ns(self, vue_id: str) -> int:
        """For how long, by its stamps, something sound came of a candidate; 0 of others."""
        device = self._devices.get(vue_id)
        return 0 if device is None or device.fixed else device.newest_ns - device.first_ns

    def _who_leaves(self, stamp_ns: int) -> str | None:
        def order(entry: tuple[str, _Device]) -> tuple[bool, int, int, str]:
            name, device = entry
            return device.fixed, 0 if device.fixed else device.sound, device.newest_ns, name

        name, device = min(self._devices.items(), key=order)
        silent = stamp_ns - device.newest_ns > self._silence_ns
        return name if silent or not device.fixed else None

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
