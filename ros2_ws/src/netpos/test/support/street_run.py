"""A drive along the street of ``conftest.World``, given to a tracker epoch by epoch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from netpos.messages.values import Array, RsuMeasurement
from netpos.tracking import Tracker, TrackOutput
from track_cases import straight


def truth(t_s: float) -> Array:
    """East along the street at 8 m/s, clock 3 km ahead and gaining 5 km/s."""
    return straight(t_s, 3000.0, 5000.0)


def epochs(world: Any, count: int, step_s: float = 0.1) -> list[list[RsuMeasurement]]:
    return [world.measure(step_s * k, truth(step_s * k)) for k in range(count)]


def fed(tracker: Tracker, items: Iterable[Any]) -> list[TrackOutput]:
    """What a tracker says to items it takes."""
    for item in items:
        assert tracker.add(item) is None
    return tracker.process()


def ran(world: Any, batches: Iterable[list[Any]], **config: Any) -> Tracker:
    tracker: Tracker = world.tracker(**config)
    for batch in batches:
        fed(tracker, batch)
    return tracker
