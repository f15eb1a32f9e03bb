"""Watches the room that is left on the disk of a recording."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

MEGABYTE = 1_000_000
_WARN_FACTOR = 10.0
_WARN_S = 60.0  # also told when the recording fills the disk within this time


class Level(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


def _free_bytes(path: Path) -> int:
    return shutil.disk_usage(path).free


@dataclass(slots=True)
class Room:
    """Free bytes where ``folder`` is; a recording ends, whole, at ``min_free_mb``.

    It warns below ten times that, and when the room that is left lasts for less than a minute at
    the rate of the last look. Time is an argument, in seconds.
    """

    folder: Path
    min_free_mb: float
    free_bytes: Callable[[Path], int] = _free_bytes
    level: Level = Level.OK
    sentence: str = ""
    _last: tuple[float, int] | None = None

    def look(self, now_s: float) -> Level:
        """Look again; ``sentence`` says what is wrong, with values and remedy."""
        free = self.free_bytes(self.folder)
        least = self.min_free_mb * MEGABYTE
        lasts_s = self._lasts_s(now_s, free - least)
        said = f"{free / MEGABYTE:.1f} MB are free for {self.folder}"
        if free < least:
            self.level = Level.ERROR
            self.sentence = (
                f"{said}, less than {self.min_free_mb:g} (--min-free-mb); make room there, or "
                "record to another disk"
            )
        elif free < _WARN_FACTOR * least or lasts_s < _WARN_S:
            self.level = Level.WARN
            soon = f", full in {lasts_s:.0f} s" if lasts_s < _WARN_S else ""
            self.sentence = f"{said}{soon}; recording ends at {self.min_free_mb:g} MB: make room"
        else:
            self.level, self.sentence = Level.OK, ""
        return self.level

    def _lasts_s(self, now_s: float, left: float) -> float:
        last, self._last = self._last, (now_s, self.free_bytes(self.folder))
        if last is None or last[1] <= self._last[1] or now_s <= last[0]:
            return float("inf")
        return left * (now_s - last[0]) / (last[1] - self._last[1])
