"""Which devices are tracked: names come from anybody who is heard, tracks and topics cost."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

NOT_ALLOWED, TOO_MANY = "not_allowed", "too_many_devices"
_NS = 1_000_000_000
_SECONDS = 100  # of which newcomers are counted
_WAITING = 1000  # names


@dataclass(slots=True)
class _Device:
    """Sound items of a device: stamps of the first and the newest, and how many; stamp of its
    first fix, and whether a later epoch agreed with it. posed: somebody said where it is."""

    first_ns: int = 0
    newest_ns: int = 0
    sound: int = 0
    fix_ns: int | None = None
    fixed: bool = False
    posed: bool = False

    @property
    def seeks_fix(self) -> bool:
        """Whether a first fix is sought for it."""
        return self.sound > 0 and not self.fixed and not self.posed

    def hear(self, stamp_ns: int) -> None:
        """Note a sound item."""
        self.first_ns = min(self.first_ns, stamp_ns) if self.sound else stamp_ns
        self.newest_ns = max(self.newest_ns, stamp_ns)
        self.sound += 1


class Admission:
    """At most ``limit`` devices, of names that ``pattern`` matches as a whole (empty: any).

    A device is a candidate until it has a plausible fix: one that a later epoch agrees with. A
    first fix takes time of the others. So where a tenth of ``limit`` are candidates of which
    something sound has come, a new one must have been heard at an earlier stamp as well, and no
    more than this tenth enter in a second of the stamps: names that are made up and heard once
    cost no track. A device that is given a pose needs no such fix: it enters at once, and is none
    of this tenth. Where all places are taken, one makes room for a new device with something
    sound, the first that there is of these:

    - a device of which nothing sound has come;
    - the candidate of which the fewest sound items have come, under the same condition;
    - a device that had a fix and is silent for longer than ``silence_ns``.

    By stamps and the order of the items alone, so that a replay admits the same.
    """

    def __init__(self, limit: int, pattern: str, silence_ns: int) -> None:
        self.set_limits(limit, pattern, silence_ns)
        self._devices: dict[str, _Device] = {}
        self._waiting: dict[str, int] = {}  # stamp at which a name was first heard in vain
        self._entered: dict[int, int] = {}  # of those that had to wait, by second of the stamps
        self._refused: Counter[str] = Counter()
        self._last_refused = ""

    def set_limits(self, limit: int, pattern: str, silence_ns: int) -> None:
        """Go on with other limits; who is admitted stays."""
        self._limit = limit
        self._pattern = re.compile(pattern) if pattern else None
        self._silence_ns = silence_ns

    def admit(
        self, vue_id: str, stamp_ns: int, *, sound: bool, pose: bool = False
    ) -> tuple[str | None, str | None]:
        """Take note of an item of a device, ``pose``: of a pose that it is given; the reason why
        the device is not admitted, and the device that makes room for it, None each."""
        posed = sound and pose
        known = self._devices.get(vue_id)
        if known is not None:
            known.posed |= posed
            if sound:
                known.hear(stamp_ns)
            return None, None
        if self._pattern is not None and not self._pattern.fullmatch(vue_id):
            return self._turn_away(vue_id, NOT_ALLOWED), None
        leaves = None
        if len(self._devices) < self._limit:
            waits = sound and not posed and self._is_crowded()
            if waits and not self._may_enter(vue_id, stamp_ns):
                return self._turn_away(vue_id, TOO_MANY), None
        else:
            leaves = self._who_leaves(vue_id, stamp_ns) if sound else None
            if leaves is None:
                return self._turn_away(vue_id, TOO_MANY), None
            del self._devices[leaves]
            self._waiting.pop(vue_id, None)
        device = self._devices[vue_id] = _Device(posed=posed)
        if sound:
            device.hear(stamp_ns)
        return None, leaves

    def note_fix(self, vue_id: str, stamp_ns: int) -> None:
        """Something was accepted of a device, with or after its first fix."""
        device = self._devices.get(vue_id)
        if device is not None and not device.fixed:
            if device.fix_ns is None:
                device.fix_ns = stamp_ns
            device.fixed = stamp_ns > device.fix_ns

    def is_fixed(self, vue_id: str) -> bool:
        """Whether a device had a plausible fix."""
        device = self._devices.get(vue_id)
        return device is not None and device.fixed

    def waits_ns(self, vue_id: str) -> int:
        """For how long, by its stamps, something sound came of a candidate; 0 of others."""
        device = self._devices.get(vue_id)
        return 0 if device is None or device.fixed else device.newest_ns - device.first_ns

    def _who_leaves(self, vue_id: str, stamp_ns: int) -> str | None:
        """The device that makes room for a new one; None: nobody does."""

        def order(entry: tuple[str, _Device]) -> tuple[bool, int, int, str]:
            name, device = entry
            return device.fixed, 0 if device.fixed else device.sound, device.newest_ns, name

        name, device = min(self._devices.items(), key=order)
        if device.fixed:
            return name if stamp_ns - device.newest_ns > self._silence_ns else None
        if device.sound and not self._may_enter(vue_id, stamp_ns):
            return None
        return name

    def _is_crowded(self) -> bool:
        """Whether there are so many candidates that a new one must wait."""
        return sum(d.seeks_fix for d in self._devices.values()) >= self._tenth

    def _may_enter(self, vue_id: str, stamp_ns: int) -> bool:
        """Whether a name was heard at an earlier stamp, and few others entered in this second of
        the stamps; noted."""
        first_ns = self._waiting.setdefault(vue_id, stamp_ns)
        if len(self._waiting) > _WAITING:
            del self._waiting[next(iter(self._waiting))]
        if first_ns >= stamp_ns:
            return False
        second = stamp_ns // _NS
        self._entered[second] = self._entered.get(second, 0) + 1
        if len(self._entered) > _SECONDS:
            del self._entered[next(iter(self._entered))]
        return self._entered[second] <= self._tenth

    @property
    def _tenth(self) -> int:
        return max(self._limit // 10, 1)

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
