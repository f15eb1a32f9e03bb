"""Faults of what RSUs and IMUs measure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from netpos.evaluation.faults.geometry import SCALARS, shifted
from netpos.evaluation.faults.stream import NS, Arrival, Hit, Stream, each
from netpos.messages.values import ImuSample, RsuMeasurement, Velocity


def bias(stream: Stream, hit: Hit) -> Stream:
    """Every quantity is ``size`` standard deviations too large."""
    return each(stream, hit, lambda m: (shifted(m, hit.size),))


def drift(stream: Stream, hit: Hit) -> Stream:
    """An error that grows evenly to ``size`` standard deviations."""
    lasts = hit.end_ns - hit.start_ns
    return each(
        stream, hit, lambda m: (shifted(m, hit.size * (m.stamp_ns - hit.start_ns) / lasts),)
    )


def freeze(stream: Stream, hit: Hit) -> Stream:
    """Stamps go on, values stay those of the first message of each RSU and device."""

    def change(m: RsuMeasurement) -> tuple[RsuMeasurement]:
        old = hit.memory.setdefault((m.rsu_id, m.vue_id, m.reference_rsu_id), m)
        return (replace(old, stamp_ns=m.stamp_ns, sequence=m.sequence, expected=m.expected),)

    return each(stream, hit, change)


def noise(stream: Stream, hit: Hit) -> Stream:
    """Noise of ``size`` standard deviations more than is stated."""
    return each(stream, hit, lambda m: (shifted(m, float(hit.rng.normal(0.0, hit.size))),))


def outliers(stream: Stream, hit: Hit) -> Stream:
    """A share ``size`` of the messages is wrong by up to 100 standard deviations."""
    return each(
        stream,
        hit,
        lambda m: (
            shifted(m, float(hit.rng.uniform(-100.0, 100.0)))
            if hit.rng.random() < hit.size
            else m,
        ),
    )


def blocked(stream: Stream, hit: Hit) -> Stream:
    """Half of the messages take a way that is up to ``size`` metres longer."""

    def change(m: RsuMeasurement) -> tuple[RsuMeasurement]:
        longer_m = float(hit.rng.uniform(0.0, hit.size)) * (hit.rng.random() < 0.5)
        later_s = longer_m / 299_792_458.0
        longer: dict[str, float] = {"range_m": longer_m, "toa_s": later_s, "tdoa_s": later_s}
        values: dict[str, Any] = {n: getattr(m, n) + more for n, more in longer.items()}
        return (replace(m, **values),)

    return each(stream, hit, change)


def overconfident(stream: Stream, hit: Hit) -> Stream:
    """Stated variances are ``size`` times too small."""
    return each(stream, hit, lambda m: (replace(m, **_variances(m, lambda v: v / hit.size)),))


def not_finite(stream: Stream, hit: Hit) -> Stream:
    """Values are not numbers, in a share ``size`` of the messages."""

    def change(m: RsuMeasurement) -> tuple[RsuMeasurement]:
        if hit.rng.random() >= hit.size:
            return (m,)
        names = [value for field, (value, _) in SCALARS.items() if m.fields & field]
        values: dict[str, Any] = dict.fromkeys(names, float("nan"))
        return (replace(m, **values),)

    return each(stream, hit, change)


def no_variance(stream: Stream, hit: Hit) -> Stream:
    """Variances are 0."""
    return each(stream, hit, lambda m: (replace(m, **_variances(m, lambda _: 0.0)),))


def _variances(m: RsuMeasurement, change: Callable[[float], float]) -> dict[str, Any]:
    return {
        variance: change(getattr(m, variance))
        for field, (_, variance) in SCALARS.items()
        if m.fields & field
    }


def device_silent(stream: Stream, hit: Hit) -> Stream:
    """The device sends no IMU samples and no step velocities."""
    return [a for a in stream if not (hit.during(a) and isinstance(a.what, ImuSample | Velocity))]


def device_turned(stream: Stream, hit: Hit) -> Stream:
    """IMU and step velocities are turned by ``size`` radians about the vertical: the phone was put
    into another pocket."""
    cos, sin = np.cos(hit.size), np.sin(hit.size)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def change(what: object) -> object:
        if isinstance(what, ImuSample):
            return replace(what, specific_force=turn @ what.specific_force)
        if isinstance(what, Velocity):
            return replace(what, velocity=turn[:2, :2] @ what.velocity)
        return what

    return _of_device(stream, hit, change)


def device_frozen(stream: Stream, hit: Hit) -> Stream:
    """IMU samples and step velocities repeat the first values."""

    def change(what: object) -> object:
        if not isinstance(what, ImuSample | Velocity):
            return what
        old = hit.memory.setdefault((type(what), what.vue_id), what)
        return replace(old, stamp_ns=what.stamp_ns)

    return _of_device(stream, hit, change)


def device_biased(stream: Stream, hit: Hit) -> Stream:
    """The gyro turns ``size`` rad/s too fast about every axis; a walker's heading drifts so."""

    def change(what: object) -> object:
        if isinstance(what, ImuSample):
            return replace(what, angular_velocity=what.angular_velocity + hit.size)
        if isinstance(what, Velocity):
            angle = hit.size * (what.stamp_ns - hit.start_ns) / NS
            cos, sin = np.cos(angle), np.sin(angle)
            return replace(what, velocity=np.array([[cos, -sin], [sin, cos]]) @ what.velocity)
        return what

    return _of_device(stream, hit, change)


def _of_device(stream: Stream, hit: Hit, change: Callable[[object], object]) -> Stream:
    return [
        Arrival(a.at_ns, change(a.what)) if hit.during(a) else a  # type: ignore[arg-type]
        for a in stream
    ]
