"""Somebody lies on purpose."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from netpos.evaluation.faults.geometry import measured_from
from netpos.evaluation.faults.stream import NS, Arrival, Hit, Stream, each, in_order
from netpos.messages.values import Array, RsuMeasurement

_MORE_DEVICES = 50
_BEFORE_NS = 1000
_BESIDE = 50  # messages for each of theirs
_PAUSE_NS = 10 * NS  # after which they begin anew


def spoofed_info(stream: Stream, hit: Hit) -> Stream:
    """Another description of the RSUs, ``size`` metres east of the true place; the true one comes
    again at the end."""
    away = np.array([hit.size, 0.0, 0.0])
    lies, ends = [], []
    for name in sorted(hit.rsus):
        info = hit.scene[name]
        lies.append(Arrival(hit.start_ns, replace(info, position=info.position + away)))
        ends.append(Arrival(hit.end_ns, info))
    return in_order([*lies, *ends, *stream])


def colluding(stream: Stream, hit: Hit) -> Stream:
    """RSUs tell the same lie, at once: the device is ``size`` metres north-east of its place."""
    return _ghost(stream, hit, lambda _: 1.0)


def creeping(stream: Stream, hit: Hit) -> Stream:
    """The same lie that grows evenly from nothing to ``size`` metres."""
    return _ghost(stream, hit, lambda t_ns: (t_ns - hit.start_ns) / (hit.end_ns - hit.start_ns))


def _ghost(stream: Stream, hit: Hit, share: Callable[[int], float]) -> Stream:
    def change(m: RsuMeasurement) -> Iterable[RsuMeasurement]:
        ghost = _of_ghost(m, hit, share(m.stamp_ns))
        return (m if ghost is None else ghost,)

    return each(stream, hit, change)


def _of_ghost(m: RsuMeasurement, hit: Hit, share: float) -> RsuMeasurement | None:
    true = hit.place(m.vue_id, m.stamp_ns)
    return None if true is None else measured_from(m, true, true + _away(hit, share), hit.scene)


def _away(hit: Hit, share: float) -> Array:
    return hit.size * share / math.sqrt(2.0) * np.array([1.0, 1.0, 0.0])


def injected(stream: Stream, hit: Hit) -> Stream:
    """Somebody sends in the name of the RSUs, just before them and with their stamps, of a device
    ``size`` metres away."""
    lies = []
    for arrival in stream:
        m = hit.measured(arrival)
        ghost = _of_ghost(m, hit, 1.0) if m is not None else None
        if ghost is not None:
            lies.append(Arrival(arrival.at_ns - _BEFORE_NS, ghost))
    return in_order([*lies, *stream])


def beside(stream: Stream, hit: Hit) -> Stream:
    """Somebody sends fifty messages for each of the RSUs in their names, with stamps of their own,
    of a device ``size`` metres away."""
    lies = []
    for arrival in stream:
        m = hit.measured(arrival)
        if m is None:
            continue
        source = m.rsu_id, m.vue_id, m.reference_rsu_id
        gap_ns = m.stamp_ns - hit.memory.get(source, m.stamp_ns)
        hit.memory[source] = m.stamp_ns
        for k in range(1, _BESIDE) if 0 < gap_ns < _PAUSE_NS else ():
            later_ns = k * gap_ns // _BESIDE
            ghost = _of_ghost(replace(m, stamp_ns=m.stamp_ns + later_ns), hit, 1.0)
            if ghost is not None:
                lies.append(Arrival(arrival.at_ns + later_ns, ghost))
    return in_order([*stream, *lies])


def replayed(stream: Stream, hit: Hit) -> Stream:
    """Messages of ``size`` seconds ago are sent again with new stamps, beside the true ones."""
    later = round(hit.size * NS)
    again = [
        Arrival(a.at_ns + later, replace(a.what, stamp_ns=a.what.stamp_ns + later))
        for a in stream
        if isinstance(a.what, RsuMeasurement)
        and a.what.rsu_id in hit.rsus
        and hit.start_ns <= a.at_ns + later < hit.end_ns
    ]
    return in_order([*stream, *again])


def invented_rsus(stream: Stream, hit: Hit) -> Stream:
    """As many RSUs that nobody built, beside those concerned, agree on a device ``size`` metres
    away."""
    names = {name: f"invented_{name}" for name in hit.rsus}
    infos = [
        Arrival(hit.start_ns, replace(hit.scene[name], rsu_id=other))
        for name, other in sorted(names.items())
    ]
    lies = []
    for arrival in stream:
        m = hit.measured(arrival)
        ghost = _of_ghost(m, hit, 1.0) if m is not None else None
        if ghost is not None:
            lies.append(Arrival(arrival.at_ns, replace(ghost, rsu_id=names[ghost.rsu_id])))
    return in_order([*infos, *stream, *lies])


def invented_devices(stream: Stream, hit: Hit) -> Stream:
    """Each message of the RSUs comes again for ``size`` devices that nobody carries."""
    count = round(hit.size)

    def change(m: RsuMeasurement) -> Iterable[RsuMeasurement]:
        yield m
        for _ in range(min(count, _MORE_DEVICES)):
            yield replace(m, vue_id=f"invented_{hit.rng.integers(count)}")

    return each(stream, hit, change)


def flood(stream: Stream, hit: Hit) -> Stream:
    """The RSUs send ``size`` messages for each of theirs, all of the same stamp and wrong."""

    def change(m: RsuMeasurement) -> Iterable[RsuMeasurement]:
        yield m
        for k in range(round(hit.size)):
            yield replace(m, sequence=m.sequence + k + 1, stamp_ns=m.stamp_ns + k + 1)

    return each(stream, hit, change)
