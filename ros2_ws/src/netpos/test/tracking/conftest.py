"""A small street with RSUs, noise-free or noisy measurements of a device on it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from scipy.constants import speed_of_light

T0_NS = 1_000_000_000
ALL = Field.AZIMUTH | Field.TOA


@dataclass
class World:
    """RSUs and how they measure; noise only where ``rng`` is given."""

    rsus: dict[str, RsuInfo]
    angle_sd: float = math.radians(1.0)
    range_sd: float = 0.3
    rng: np.random.Generator | None = None
    biases: dict[str, float] = field(default_factory=dict)

    def tracker(self, **config: Any) -> Tracker:
        tracker = Tracker(TrackerConfig(**({"hold_s": 0.0} | config)))
        for info in self.rsus.values():
            tracker.add_rsu(info)
        return tracker

    def measure(
        self,
        t_s: float,
        state: Array,
        fields: Field = ALL,
        names: Iterable[str] | None = None,
        vue_id: str = "vue_1",
        **change: Any,
    ) -> list[RsuMeasurement]:
        """What the RSUs measure of [x, y, vx, vy, clock m, drift m/s] ``t_s`` after the start."""
        out = []
        chosen = list(names or self.rsus)
        for name in chosen:
            noise = self.rng.normal(size=5) if self.rng is not None else np.zeros(5)
            d = state[POSITION] - self.rsus[name].position[:2]
            r = math.hypot(*d) + self.biases.get(name, 0.0)
            values: dict[str, Any] = {
                "stamp_ns": T0_NS + round(t_s * 1e9),
                "rsu_id": name,
                "vue_id": vue_id,
                "expected": len(chosen),
                "fields": fields,
                "azimuth_rad": math.atan2(d[1], d[0]) + self.angle_sd * noise[0],
                "azimuth_var": self.angle_sd**2,
                "toa_s": (r + state[X.CLOCK] + self.range_sd * noise[1]) / speed_of_light,
                "toa_var": (self.range_sd / speed_of_light) ** 2,
                "range_m": abs(r + self.range_sd * noise[2]),
                "range_var": self.range_sd**2,
                "position": np.array([*(state[POSITION] + self.range_sd * noise[3:]), 0.0]),
                "position_cov": np.eye(3) * self.range_sd**2,
            }
            out.append(RsuMeasurement(**(values | change)))
        return out


def feed(tracker: Tracker, items: Iterable[Any]) -> list[TrackOutput]:
    """Add all, apply all; nothing may be refused."""
    for item in items:
        assert tracker.add(item) is None
    return tracker.process() + tracker.flush()


def matrices(
    kind: str,
    dt: float,
    accel: float,
    velocity_step: float,
    offset_density: float,
    drift_density: float,
    drift_step: float,
) -> tuple[Array, Array]:
    """F and Q of a constant velocity and a two-state clock in metres, written out (6, 6)."""
    F, Q = np.eye(6), np.zeros((6, 6))
    pairs = {"x": [0, 2], "y": [1, 3], "clock": [4, 5]}
    integrated = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    for name, (i, j) in pairs.items():
        F[i, j] = dt
        block = np.ix_([i, j], [i, j])
        if kind == "continuous":
            Q[block] = integrated * (drift_density if name == "clock" else accel) ** 2
        elif name == "clock":
            Q[j, j] = drift_step**2
        elif kind == "werner":
            Q[j, j] = velocity_step**2
        else:
            g = np.array([dt**2 / 2.0, dt])
            Q[block] = accel**2 * np.outer(g, g)
    if kind == "continuous":
        Q[4, 4] += offset_density**2 * dt
    return F, Q


@pytest.fixture
def world() -> World:
    """Three RSUs along a street."""
    places = {"a": (0.0, 10.0), "b": (60.0, -10.0), "c": (120.0, 10.0)}
    return World(
        {n: RsuInfo(rsu_id=n, position=np.array([x, y, 0.0])) for n, (x, y) in places.items()}
    )


@pytest.fixture(name="feed")
def feed_fixture() -> Any:
    return feed


@pytest.fixture(name="matrices")
def matrices_fixture() -> Any:
    return matrices
