"""Streams of gated innovations as a tracker would make them, with liars in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from netpos.tracking.health import HealthConfig, RsuHealth

GATE = 18.42  # chi2.ppf(0.9999, 2)
SD = {"azimuth": math.radians(1.5), "toa": 0.6, "range": 0.5}
NS_PER_M = 1e9 / 299_792_458.0
Errors = Mapping[str, float]
Behaviour = Callable[[float, str], Errors | None]  # extra error by kind; None: not heard


def honest(_t: float, _vue: str) -> Errors:
    return {}


def liar(start: float, stop: float = math.inf, **errors: float) -> Behaviour:
    return lambda t, _: errors if start <= t < stop else {}


def ns(t: float) -> int:
    return round(t * 1e9)


class Stream:
    """Observations as a tracker with a chi-square gate would make them; the truth is known."""

    def __init__(self, seed: int = 1, kinds: tuple[str, ...] = ("azimuth", "toa"), **config: Any):
        self.health = RsuHealth(HealthConfig(**config))
        self.rng = np.random.default_rng(seed)
        self.kinds = kinds

    def run(
        self,
        start: float,
        stop: float,
        rsus: Mapping[str, Behaviour],
        vues: Iterable[str] = ("v",),
        rate: float = 10.0,
    ) -> RsuHealth:
        for k in range(round(start * rate), round(stop * rate)):
            for vue in vues:
                for name, behaviour in rsus.items():
                    errors = behaviour(k / rate, vue)
                    if errors is not None:
                        self.observe(name, vue, k / rate, errors)
        return self.health

    def observe(self, name: str, vue: str, t: float, errors: Errors) -> None:
        values = {
            kind: (self.rng.normal(0, SD[kind]) + errors.get(kind, 0.0), SD[kind])
            for kind in self.kinds
        }
        accepted = sum((v / sd) ** 2 for v, sd in values.values()) <= GATE
        self.health.observe(name, vue, ns(t), accepted, values)


def isolated(health: RsuHealth, t: float, names: Iterable[str] = "abcdef") -> set[str]:
    return {name for name in names if health.excluded(name, ns(t))}


def first_isolated(stream: Stream, rsus: Mapping[str, Behaviour], stop: float, **kw: Any) -> float:
    """First second at which anything is isolated; inf where nothing is."""
    for t in range(int(stop)):
        stream.run(t, t + 1, rsus, **kw)
        if isolated(stream.health, t + 1):
            return t + 1
    return math.inf
