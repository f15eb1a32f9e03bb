"""A device that keeps its velocity but for white acceleration."""

from __future__ import annotations

from netpos.estimation.compile import inlined
from netpos.estimation.motion.model import MotionModel
from netpos.estimation.motion.process_noise import add_acceleration
from netpos.estimation.state import X
from netpos.messages.values import Array


@inlined
def propagate(mean: Array, dt: float, _motion: Array) -> None:
    """The position moves by velocity times dt."""
    mean[X.PX] += dt * mean[X.VX]
    mean[X.PY] += dt * mean[X.VY]


@inlined
def transition(_mean: Array, dt: float, _motion: Array, F: Array) -> None:
    """fokin2020:eq.35."""
    F[X.PX, X.VX] = F[X.PY, X.VY] = dt


@inlined
def add_noise(_mean: Array, dt: float, motion: Array, cov: Array) -> None:
    """White acceleration, or a velocity step of each step."""
    add_acceleration(dt, motion, cov)


MODEL = MotionModel(
    name="CONSTANT_VELOCITY",
    propagate=propagate,
    transition=transition,
    add_noise=add_noise,
    is_straight=True,
)
