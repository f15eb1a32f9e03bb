"""A device that keeps its velocity and has a heading of its own: states yaw [rad], yaw rate
[rad/s], a random walk."""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined
from netpos.estimation.motion import constant_velocity
from netpos.estimation.motion.model import MotionModel
from netpos.estimation.motion.parameters import OWN, TURN_RATE
from netpos.estimation.motion.process_noise import add_acceleration, add_walk
from netpos.estimation.state import X
from netpos.messages.values import Array

_RATE_WALK = OWN  # walk of the yaw rate [rad/s/sqrt(s)]


@inlined
def propagate(mean: Array, dt: float, motion: Array) -> None:
    """Velocity and yaw rate are kept."""
    constant_velocity.propagate(mean, dt, motion)
    mean[X.YAW] += dt * mean[X.YAW_RATE]


@inlined
def transition(mean: Array, dt: float, motion: Array, F: Array) -> None:
    """That of two constant rates."""
    constant_velocity.transition(mean, dt, motion, F)
    F[X.YAW, X.YAW_RATE] = dt


@inlined
def add_noise(_mean: Array, dt: float, motion: Array, cov: Array) -> None:
    """White acceleration and the walk of the yaw rate."""
    add_acceleration(dt, motion, cov)
    add_walk(X.YAW, X.YAW_RATE, dt, motion[_RATE_WALK] ** 2, cov)


MODEL = MotionModel(
    name="RIGID_BODY",
    propagate=propagate,
    transition=transition,
    add_noise=add_noise,
    summary="several antennas give a heading of its own",
    states=("YAW", "YAW_RATE"),
    initial_sd=lambda config: (math.pi / math.sqrt(3.0), config.turn_rate_density),
    parameters=TURN_RATE,
    own={"turn_rate": "turn_rate_density"},
    heading=int(X.YAW),
)
