"""Faults on the way from the RSUs to the tracker."""

from __future__ import annotations

from dataclasses import replace

from netpos.bags import codec
from netpos.bags.types import require_type
from netpos.evaluation.faults.stream import NS, Arrival, Hit, Stream, each, held, in_order
from netpos.messages.values import RsuMeasurement

_MEASUREMENT = "netpos_msgs/msg/RsuMeasurement"
_AFTER_NS = NS // 100


def drop(stream: Stream, hit: Hit) -> Stream:
    """Each message is lost with probability ``size``."""
    return each(stream, hit, lambda m: () if hit.rng.random() < hit.size else (m,))


def silence(stream: Stream, hit: Hit) -> Stream:
    """Nothing arrives at all, of RSUs or of the device."""
    return [arrival for arrival in stream if not hit.during(arrival)]


def delay(stream: Stream, hit: Hit) -> Stream:
    """Every message arrives ``size`` seconds late."""
    return held(stream, hit, lambda _: round(hit.size * NS))


def reorder(stream: Stream, hit: Hit) -> Stream:
    """Every message is delayed by its own draw, up to ``size`` seconds."""
    return held(stream, hit, lambda _: round(hit.rng.uniform(0.0, hit.size) * NS))


def partition(stream: Stream, hit: Hit) -> Stream:
    """What is sent arrives together once the network is back, as a reliable writer sends it."""
    return held(stream, hit, lambda arrival: hit.end_ns - arrival.at_ns)


def duplicate(stream: Stream, hit: Hit) -> Stream:
    """Each message comes a second time, 10 ms later, with probability ``size``."""
    copies = [
        replace(arrival, at_ns=arrival.at_ns + _AFTER_NS)
        for arrival in stream
        if hit.measured(arrival) is not None and hit.rng.random() < hit.size
    ]
    return in_order([*stream, *copies])


def corrupt(stream: Stream, hit: Hit) -> Stream:
    """Three bytes of each message are others, with probability ``size``."""

    def change(cdr: bytes) -> bytes:
        spoilt = bytearray(cdr)
        for at in hit.rng.integers(4, len(spoilt), 3):
            spoilt[at] ^= int(hit.rng.integers(1, 256))
        return bytes(spoilt)

    return [_on_the_wire(a, hit, change) for a in stream]


def truncate(stream: Stream, hit: Hit) -> Stream:
    """Each message ends early, with probability ``size``."""
    return [
        _on_the_wire(a, hit, lambda cdr: cdr[: int(hit.rng.integers(4, len(cdr)))]) for a in stream
    ]


def _on_the_wire(arrival: Arrival, hit: Hit, change: object) -> Arrival:
    m = hit.measured(arrival)
    if m is None or hit.rng.random() >= hit.size:
        return arrival
    assert callable(change)
    return Arrival(arrival.at_ns, change(as_bytes(m)))


def as_bytes(m: RsuMeasurement) -> bytes:
    """A measurement as it travels."""
    message = codec().measurement_to_msg(m)
    return bytes(require_type(_MEASUREMENT).serialize_cdr(message, _MEASUREMENT))


def of_bytes(cdr: bytes) -> RsuMeasurement:
    """The measurement in bytes of the wire; raises whatever the bytes cause."""
    message = require_type(_MEASUREMENT).deserialize_cdr(cdr, _MEASUREMENT)
    return codec().measurement_from_msg(message)
