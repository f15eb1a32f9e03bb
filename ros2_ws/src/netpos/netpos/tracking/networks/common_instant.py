"""Asynchronous tracks at one common instant: constant acceleration, dvornikov2017:eq.9."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from netpos.estimation.motion import NO_BIAS, Model, motion_parameters, noise, transition
from netpos.estimation.state import X
from netpos.messages.values import Array, NetworkTrack

# Entries of the state of ``filters.motion`` that a network's track has.
TRACK_STATES = np.array([X.PX, X.PY, X.VX, X.VY, X.AX, X.AY])


@dataclass(frozen=True, slots=True)
class Moved:
    """Tracks at one instant: mean (k, 6), cov (k, 6, 6), own_cov (k, 6, 6)."""

    mean: Array
    cov: Array
    own_cov: Array


@lru_cache(maxsize=256)
def step_matrices(dt_ns: int, jerk_density: float) -> tuple[Array, Array]:
    """F and Q (6, 6) over ``dt_ns`` of a state x, y, vx, vy, ax, ay under white jerk."""
    motion = motion_parameters(Model.CONSTANT_ACCELERATION, jerk=jerk_density)
    n = X.AY + 1
    mean, F, Q = np.zeros(n), np.empty((n, n)), np.empty((n, n))
    dt_s = dt_ns * 1e-9
    transition(mean, dt_s, motion, NO_BIAS, F)
    noise(mean, dt_s, motion, NO_BIAS, Q)
    kept = np.ix_(TRACK_STATES, TRACK_STATES)
    return F[kept], Q[kept]


def at_common_instant(tracks: Sequence[NetworkTrack], stamp_ns: int, jerk_density: float) -> Moved:
    """Tracks moved on to ``stamp_ns``, which none of them is beyond.

    The noise of the way is that of the device's motion, so it is no network's own.
    """
    steps = [step_matrices(stamp_ns - track.stamp_ns, jerk_density) for track in tracks]
    F = np.array([step[0] for step in steps])
    Q = np.array([step[1] for step in steps])
    turned = F.transpose(0, 2, 1)
    return Moved(
        np.einsum("kij,kj->ki", F, np.array([track.mean for track in tracks])),
        F @ np.array([track.cov for track in tracks]) @ turned + Q,
        F @ np.array([track.own_cov for track in tracks]) @ turned,
    )
