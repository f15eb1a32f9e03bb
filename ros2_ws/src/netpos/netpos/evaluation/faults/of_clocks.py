"""Faults of the clocks that make the stamps."""

from __future__ import annotations

from dataclasses import replace

from netpos.evaluation.faults.stream import NS, Arrival, Hit, Order, Stream, each, in_order


def clock_step(stream: Stream, hit: Hit) -> Stream:
    """Stamps are ``size`` seconds ahead of the time, or behind it."""
    return each(stream, hit, lambda m: (replace(m, stamp_ns=m.stamp_ns + round(hit.size * NS)),))


def clock_drift(stream: Stream, hit: Hit) -> Stream:
    """Stamps gain ``size`` seconds every second."""
    return each(
        stream,
        hit,
        lambda m: (
            replace(m, stamp_ns=m.stamp_ns + round(hit.size * (m.stamp_ns - hit.start_ns))),
        ),
    )


def no_stamp(stream: Stream, hit: Hit) -> Stream:
    """Stamps are 0."""
    return each(stream, hit, lambda m: (replace(m, stamp_ns=0),))


def clock_back(stream: Stream, hit: Hit) -> Stream:
    """``/clock`` jumps back once, as at the start of another recording."""
    return in_order([*stream, Arrival(hit.start_ns, Order.CLOCK_BACK)])
