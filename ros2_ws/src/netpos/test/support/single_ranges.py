"""Anchors that are heard one after the other: a tracker that knows them, and their ranges."""

from __future__ import annotations

from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig


def tracker_of(config: TrackerConfig, anchors: Array) -> Tracker:
    """A tracker that knows the ``anchors`` (n, 3) m, named a0, a1 and so on."""
    tracker = Tracker(config)
    for i, anchor in enumerate(anchors):
        tracker.add_rsu(RsuInfo(rsu_id=f"a{i}", position=anchor))
    return tracker


def single_range(
    number: int, anchor: int, at_s: float, range_m: float, sd_m: float
) -> RsuMeasurement:
    """The beacon ``number``, which one anchor alone has heard: its range, ``at_s`` after 1 s."""
    return RsuMeasurement(
        stamp_ns=round(1e9 * (1.0 + at_s)),
        rsu_id=f"a{anchor}",
        vue_id="vue_1",
        sequence=number,
        expected=1,
        fields=Field.RANGE,
        range_m=range_m,
        range_var=sd_m**2,
    )
