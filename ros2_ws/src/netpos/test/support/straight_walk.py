"""A straight walk with rests, and dead reckoning run over it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.pdr_output import StepEvent, StepVelocity
from scipy.spatial.transform import Rotation

G = 9.80665
FIELD_MAP = np.array([0.0, 18e-6, -45e-6])
RATE_HZ = 100.0
CADENCE_HZ = 1.8


@dataclass
class Walk:
    stamps: np.ndarray  # (n,)
    rate: np.ndarray  # (n, 3)
    force: np.ndarray  # (n, 3)
    field: np.ndarray  # (n, 3)


def walk(
    heading_deg: float = 0.0,
    turn_deg: float = 0.0,
    walk_s: float = 20.0,
    rest_s: tuple[float, float] = (3.0, 4.0),
    start_ns: int = 10**18,
) -> Walk:
    """Rest, straight walk (after half of it a turn in one second), rest; level body."""
    t = np.arange(0.0, rest_s[0] + walk_s + rest_s[1], 1 / RATE_HZ)
    u = (t - rest_s[0]) * CADENCE_HZ
    ramp = np.clip(np.minimum(u, walk_s * CADENCE_HZ - u) + 0.25, 0.0, 1.0)
    yaw_rate = np.where(np.abs(t - rest_s[0] - walk_s / 2) < 0.5, math.radians(turn_deg), 0.0)
    yaw = math.radians(heading_deg) + np.cumsum(yaw_rate) / RATE_HZ
    force = np.column_stack([0 * t, 0 * t, G - 2.5 * ramp * np.cos(2 * np.pi * u)])
    rng = np.random.default_rng(4)
    return Walk(
        start_ns + np.rint(t * 1e9).astype(np.int64),
        np.column_stack([0 * t, 0 * t, yaw_rate]) + rng.normal(scale=0.01, size=(t.size, 3)),
        force + rng.normal(scale=0.02, size=(t.size, 3)),
        Rotation.from_rotvec(np.outer(yaw, [0.0, 0.0, 1.0])).inv().apply(FIELD_MAP),
    )


def run(
    w: Walk, config: PdrConfig | None = None, magnetic: bool = False
) -> tuple[PedestrianDeadReckoning, list[StepEvent], list[StepVelocity]]:
    core = PedestrianDeadReckoning(config)
    events: list[StepEvent] = []
    velocities: list[StepVelocity] = []
    for i, stamp in enumerate(w.stamps.tolist()):
        out = core.add_imu(stamp, w.rate[i], w.force[i])
        if magnetic:
            core.add_magnetic_field(stamp, w.field[i])
        if out is None:
            continue
        assert all(e.stamp_ns == stamp for e in out.steps)
        events += out.steps
        if out.velocity is not None:
            assert out.velocity.stamp_ns == stamp
            velocities.append(out.velocity)
    return core, events, velocities


def heading_error(event: StepEvent, heading_deg: float) -> float:
    d = event.heading_rad - math.radians(heading_deg)
    return abs(math.atan2(math.sin(d), math.cos(d)))
