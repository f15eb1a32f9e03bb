"""Faults of the processes: an RSU or the tracker is gone for a while."""

from __future__ import annotations

from netpos.evaluation.faults.stream import Arrival, Hit, Order, Stream, each, in_order


def rsu_crash(stream: Stream, hit: Hit) -> Stream:
    """The RSUs are silent, then come back and describe themselves again."""
    back = [Arrival(hit.end_ns, hit.scene[name]) for name in sorted(hit.rsus)]
    return in_order([*back, *each(stream, hit, lambda _: ())])


def tracker_crash(stream: Stream, hit: Hit) -> Stream:
    """The tracker is killed; a new one starts at the end."""
    ends = [Arrival(hit.start_ns, Order.CRASH), Arrival(hit.end_ns, Order.START)]
    return in_order([*ends, *stream])
