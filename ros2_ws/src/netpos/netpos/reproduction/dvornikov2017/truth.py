"""How the objects of the network experiments move: states (n, 6) under a seed at stamps (n,)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from netpos.messages.values import Array
from netpos.radio.noise import generator, normals, stream_key
from netpos.scenario.schema import NS
from netpos.tracking.networks.common_instant import step_matrices
from netpos.world.quadratic import QuadraticMotion

Ints = npt.NDArray[np.int64]
Vector2 = tuple[float, float]

START_NS = NS
_GRID_NS = NS // 10


@dataclass(frozen=True, slots=True)
class Quadratic:
    """The same curves of the second order under every seed; ``stretches``: duration [s] and
    acceleration [m/s^2]."""

    start_m: Vector2
    velocity_mps: Vector2
    stretches: tuple[tuple[float, Vector2], ...]

    def __call__(self, seed: int, stamps_ns: Ints) -> Array:
        """States (n, 6)."""
        durations, accelerations = zip(*self.stretches, strict=True)
        motion = QuadraticMotion(self.start_m, self.velocity_mps, durations, accelerations)
        state = motion.at((stamps_ns - START_NS) / NS)
        return np.hstack([state.position, state.velocity, state.acceleration])


@dataclass(frozen=True, slots=True)
class Jerky:
    """Acceleration that walks at random: white jerk of a density [m/s^3/sqrt(Hz)], exactly what a
    filter of the same density takes the motion for. Stamps lie on a grid of 0.1 s."""

    velocity_mps: Vector2
    jerk_density: float
    duration_s: float

    def __call__(self, seed: int, stamps_ns: Ints) -> Array:
        """States (n, 6)."""
        path = _walk(self, seed)
        return np.take(path, (stamps_ns - START_NS) // _GRID_NS, axis=0)


@lru_cache(maxsize=2)
def _walk(truth: Jerky, seed: int) -> Array:
    F, Q = step_matrices(_GRID_NS, truth.jerk_density)
    count = round(truth.duration_s * NS) // _GRID_NS + 1
    shocks = normals(np.arange(count), 6, stream_key(seed, "jerk")) @ np.linalg.cholesky(Q).T
    path = np.zeros((count, 6))
    path[0, 2:4] = truth.velocity_mps
    for k in range(1, count):
        path[k] = F @ path[k - 1] + shocks[k]
    return path


def crossing(
    seed: int, count: int, meeting_s: float, fan_deg: float, speed_mps: tuple[float, float]
) -> list[Quadratic]:
    """Straight ways of ``count`` objects that all pass within some metres of one place within a
    second or two of ``meeting_s``, in directions spread over ``fan_deg``, drawn anew for each
    seed."""
    rng = generator(seed, "crossing")
    ways = []
    for number in range(count):
        angle = np.radians(fan_deg / count * (number + rng.uniform(-0.25, 0.25)))
        speed = rng.uniform(*speed_mps)
        velocity = speed * np.array([np.cos(angle), np.sin(angle)])
        miss = rng.normal(scale=5.0, size=2)
        when_s = meeting_s + rng.normal(scale=1.0)
        start = miss - when_s * velocity
        ways.append(
            Quadratic(
                (float(start[0]), float(start[1])),
                (float(velocity[0]), float(velocity[1])),
                ((10.0 * meeting_s, (0.0, 0.0)),),
            )
        )
    return ways
