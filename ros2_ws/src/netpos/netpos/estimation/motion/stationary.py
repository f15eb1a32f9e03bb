"""A device at rest: the stop model of an interacting set."""

from __future__ import annotations

from netpos.common.parameters import real
from netpos.estimation.compile import inlined
from netpos.estimation.motion.model import MotionModel
from netpos.estimation.motion.parameters import OWN
from netpos.estimation.state import X
from netpos.messages.values import Array

_REST_SPEED = OWN  # sd of its speed per axis [m/s]


@inlined
def propagate(mean: Array, _dt: float, _motion: Array) -> None:
    """It stays where it is."""
    mean[X.VX] = mean[X.VY] = 0.0


@inlined
def transition(_mean: Array, _dt: float, _motion: Array, F: Array) -> None:
    """Whatever the velocity was, it is none now."""
    F[X.VX, X.VX] = F[X.VY, X.VY] = 0.0


@inlined
def add_noise(_mean: Array, dt: float, motion: Array, cov: Array) -> None:
    """A speed, which led half as far as it leads in dt."""
    rest = motion[_REST_SPEED] ** 2
    for p in range(2):
        v = X.VX + p
        cov[p, p] += rest * dt * dt / 4.0
        cov[p, v] += rest * dt / 2.0
        cov[v, p] += rest * dt / 2.0
        cov[v, v] += rest


MODEL = MotionModel(
    name="STATIONARY",
    propagate=propagate,
    transition=transition,
    add_noise=add_noise,
    summary=None,
    parameters={
        "rest_speed_sd_mps": real(0.05, 1e-6, 1e3, "interacting: speed sd of a device at rest")
    },
    own={"rest_speed": "rest_speed_sd_mps"},
)
