"""Streams of gated innovations as a tracker would make them, with liars in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from netpos.estimation.measurement import KIND, ROW_WIDTH, Kind
from netpos.messages.values import RsuMeasurement
from netpos.tracking.health.health import HealthConfig, RsuHealth
from netpos.tracking.health.observations import FittedEpoch

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


def observe(
    health: RsuHealth,
    rsu_id: str,
    vue_id: str,
    stamp_ns: int,
    accepted: bool,
    innovations: Mapping[str, tuple[float, float]],
) -> None:
    """Have ``health`` hear of one measurement; innovation and sd by name of a ``Kind``. Without
    any it is a position."""
    kinds = [Kind[name.upper()] for name in innovations] or [Kind.LINEAR]
    rows = np.zeros((len(kinds), ROW_WIDTH))
    rows[:, KIND] = kinds
    fits = np.array(list(innovations.values()) or [(0.0, 1.0)])
    item = RsuMeasurement(stamp_ns=stamp_ns, rsu_id=rsu_id, vue_id=vue_id)
    health.hear(FittedEpoch(stamp_ns, vue_id, (item,), rows, fits, [float(accepted)]))


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
        observe(self.health, name, vue, ns(t), accepted, values)


def isolated(health: RsuHealth, t: float, names: Iterable[str] = "abcdef") -> set[str]:
    return {name for name in names if health.excluded(name, ns(t))}


def first_isolated(stream: Stream, rsus: Mapping[str, Behaviour], stop: float, **kw: Any) -> float:
    """First second at which anything is isolated; inf where nothing is."""
    for t in range(int(stop)):
        stream.run(t, t + 1, rsus, **kw)
        if isolated(stream.health, t + 1):
            return t + 1
    return math.inf
