"""A device that turns at a rate of its own: state turn rate [rad/s], a random walk."""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined, leaf
from netpos.estimation.motion.model import MotionModel
from netpos.estimation.motion.parameters import OWN, TURN_RATE
from netpos.estimation.motion.process_noise import add_acceleration
from netpos.estimation.state import X
from netpos.messages.values import Array

_RATE_WALK = OWN  # walk of the turn rate [rad/s/sqrt(s)]


@leaf
def arc(rate: float, dt: float) -> tuple[float, float, float, float]:
    """sin(rate dt)/rate, (1 - cos(rate dt))/rate and their derivatives with respect to rate."""
    angle = rate * dt
    if abs(angle) < 1e-4:
        along = dt * (1.0 - angle * angle / 6.0)
        across = dt * angle / 2.0
        return along, across, -dt * dt * angle / 3.0, dt * dt * (0.5 - angle * angle / 8.0)
    s, c = math.sin(angle), math.cos(angle)
    along, across = s / rate, (1.0 - c) / rate
    return along, across, (dt * c - along) / rate, (dt * s - across) / rate


@inlined
def propagate(mean: Array, dt: float, _motion: Array) -> None:
    """Along an arc."""
    vx, vy = mean[X.VX], mean[X.VY]
    along, across, _, _ = arc(mean[X.TURN_RATE], dt)
    angle = mean[X.TURN_RATE] * dt
    c, s = math.cos(angle), math.sin(angle)
    mean[X.PX] += along * vx - across * vy
    mean[X.PY] += across * vx + along * vy
    mean[X.VX] = c * vx - s * vy
    mean[X.VY] = s * vx + c * vy


@leaf
def transition(mean: Array, dt: float, _motion: Array, F: Array) -> None:
    """Derivatives of the arc."""
    vx, vy, rate = mean[X.VX], mean[X.VY], mean[X.TURN_RATE]
    along, across, d_along, d_across = arc(rate, dt)
    c, s = math.cos(rate * dt), math.sin(rate * dt)
    F[X.PX, X.VX], F[X.PX, X.VY], F[X.PX, X.TURN_RATE] = (
        along,
        -across,
        d_along * vx - d_across * vy,
    )
    F[X.PY, X.VX], F[X.PY, X.VY], F[X.PY, X.TURN_RATE] = (
        across,
        along,
        d_across * vx + d_along * vy,
    )
    F[X.VX, X.VX], F[X.VX, X.VY], F[X.VX, X.TURN_RATE] = c, -s, dt * (-s * vx - c * vy)
    F[X.VY, X.VX], F[X.VY, X.VY], F[X.VY, X.TURN_RATE] = s, c, dt * (c * vx - s * vy)


@inlined
def add_noise(_mean: Array, dt: float, motion: Array, cov: Array) -> None:
    """White acceleration and the walk of the turn rate."""
    add_acceleration(dt, motion, cov)
    cov[X.TURN_RATE, X.TURN_RATE] += motion[_RATE_WALK] ** 2 * dt


MODEL = MotionModel(
    name="CONSTANT_TURN",
    propagate=propagate,
    transition=transition,
    add_noise=add_noise,
    states=("TURN_RATE",),
    initial_sd=lambda config: (config.turn_rate_density,),
    parameters=TURN_RATE,
    own={"turn_rate": "turn_rate_density"},
)
