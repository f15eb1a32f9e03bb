"""Tracks of networks for the tests of their fusion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import NetworkTrack

T0 = 1_000_000_000
NS = 1_000_000_000


def make_track(
    network: str,
    t_s: float,
    x: float = 0.0,
    y: float = 0.0,
    *,
    vue: str = "vue_1",
    velocity: tuple[float, float] = (0.0, 0.0),
    var: float = 1.0,
    **change: Any,
) -> NetworkTrack:
    """A track ``t_s`` after the start with variances var, var/4 and var/16 of position, velocity
    and acceleration, all of it own noise."""
    cov = np.diag([var, var, var / 4, var / 4, var / 16, var / 16])
    values = {
        "stamp_ns": T0 + round(t_s * NS),
        "network": network,
        "vue_id": vue,
        "mean": np.array([x, y, *velocity, 0.0, 0.0]),
        "cov": cov,
        "own_cov": cov.copy(),
    }
    return NetworkTrack(**(values | change))


@pytest.fixture
def track() -> Callable[..., NetworkTrack]:
    return make_track
