"""What arrives at a tracker and when: the stream that a fault changes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

from netpos.evaluation.pairing import Trajectory
from netpos.messages.values import Array, ImuSample, RsuInfo, RsuMeasurement
from netpos.tracking.ordering.sequencer import Item

NS = 1_000_000_000


class Order(Enum):
    """What happens to the tracker itself."""

    CRASH = "crash"
    """The process is gone; what arrives is lost."""
    START = "start"
    """A new process, which hears the latched descriptions of all RSUs."""
    CLOCK_BACK = "clock back"
    """/clock jumped back: the node forgets its tracks."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """``what`` reaches the tracker at ``at_ns`` of network time; bytes: a measurement as it was on
    the wire."""

    at_ns: int
    what: Item | ImuSample | RsuInfo | bytes | Order


Stream = list[Arrival]


@dataclass(frozen=True, slots=True, kw_only=True)
class Hit:
    """Where a fault strikes.

    start_ns, end_ns : when, ``end_ns`` not included; rsus : names of the RSUs it concerns;
    size : how strong, in the unit of the fault; rng : draws of this fault alone;
    scene : descriptions of all RSUs; truth : trajectories by device; memory : what a fault keeps
    from one message to the next
    """

    start_ns: int
    end_ns: int
    rsus: frozenset[str]
    size: float
    rng: np.random.Generator
    scene: Mapping[str, RsuInfo]
    truth: Mapping[str, Trajectory]
    memory: dict[Any, Any] = field(default_factory=dict)

    def during(self, arrival: Arrival) -> bool:
        """Whether something arrives while the fault lasts."""
        return self.start_ns <= arrival.at_ns < self.end_ns

    def measured(self, arrival: Arrival) -> RsuMeasurement | None:
        """The measurement of a concerned RSU that arrives while the fault lasts, else None."""
        what = arrival.what
        if not isinstance(what, RsuMeasurement) or what.rsu_id not in self.rsus:
            return None
        return what if self.during(arrival) else None

    def place(self, vue_id: str, stamp_ns: int) -> Array | None:
        """True position (3,) m of a device; None where it is not known."""
        track = self.truth.get(vue_id)
        if track is None or not len(track):
            return None
        stamps = track.stamp_ns
        return np.array([np.interp(stamp_ns, stamps, track.position[:, k]) for k in range(3)])


Changed = Callable[[RsuMeasurement], Iterable[RsuMeasurement]]


def each(stream: Stream, hit: Hit, change: Changed) -> Stream:
    """The stream with every measurement concerned replaced by what ``change`` makes of it."""
    found: Stream = []
    for arrival in stream:
        m = hit.measured(arrival)
        if m is None:
            found.append(arrival)
        else:
            found += [Arrival(arrival.at_ns, other) for other in change(m)]
    return found


def held(stream: Stream, hit: Hit, later_ns: Callable[[Arrival], int]) -> Stream:
    """The stream with every measurement concerned arriving ``later_ns`` later."""
    return in_order(
        replace(a, at_ns=a.at_ns + later_ns(a)) if hit.measured(a) is not None else a
        for a in stream
    )


def in_order(stream: Iterable[Arrival]) -> Stream:
    """By the time of arrival; what arrives at the same time stays in its order."""
    return sorted(stream, key=lambda arrival: arrival.at_ns)
