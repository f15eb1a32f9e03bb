"""What the health of the RSUs remembers of them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from netpos.tracking.observations import Observation


@dataclass(slots=True)
class Run:
    """Verdicts of one sign in a row: first and last stamp and number of their measurements."""

    first_ns: int
    last_ns: int
    count: int

    def reaches(self, duration_s: float, count: int) -> bool:
        """Whether it is long enough, in time and measurements."""
        return self.last_ns - self.first_ns >= duration_s * 1e9 and self.count >= count


@dataclass(slots=True)
class RsuMemory:
    """One RSU: what was found of it lately, and the verdicts so far."""

    window: deque[Observation]
    last_ns: int = -1
    last_vue: str = ""
    measurements: int = 0
    late: int = 0
    excluded: bool = False
    cause: str = ""
    against: Run | None = None
    agrees: Run | None = None
    changes: deque[tuple[int, bool]] = field(default_factory=lambda: deque(maxlen=16))


@dataclass(slots=True)
class Vote:
    """What one device says of one RSU in one slot."""

    entries: list[Observation]
    ratio: float
    mean_nis: float
    witnesses: frozenset[str] = frozenset()
