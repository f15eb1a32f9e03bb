"""A device that keeps its acceleration but for white jerk: states acceleration x, y [m/s^2]."""

from __future__ import annotations

from netpos.common.parameters import real
from netpos.estimation.compile import inlined, leaf
from netpos.estimation.motion.model import MotionModel
from netpos.estimation.motion.parameters import OWN
from netpos.estimation.state import X
from netpos.messages.values import Array

_JERK = OWN  # density [m/s^3/sqrt(Hz)]


@inlined
def propagate(mean: Array, dt: float, _motion: Array) -> None:
    """Each axis along a parabola."""
    vx, vy = mean[X.VX], mean[X.VY]
    mean[X.PX] += dt * vx
    mean[X.PY] += dt * vy
    for axis in range(2):
        mean[X.PX + axis] += dt * dt / 2.0 * mean[X.AX + axis]
        mean[X.VX + axis] += dt * mean[X.AX + axis]


@inlined
def transition(_mean: Array, dt: float, _motion: Array, F: Array) -> None:
    """Powers of dt."""
    F[X.PX, X.VX] = F[X.PY, X.VY] = dt
    for axis in range(2):
        F[X.PX + axis, X.AX + axis] = dt * dt / 2.0
        F[X.VX + axis, X.AX + axis] = dt


@leaf
def add_noise(_mean: Array, dt: float, motion: Array, cov: Array) -> None:
    """White jerk, whatever the ``ProcessNoise``."""
    q = motion[_JERK] ** 2
    for p in range(2):
        v, a = X.VX + p, X.AX + p
        cov[p, p] += q * dt**5 / 20.0
        cov[v, v] += q * dt**3 / 3.0
        cov[a, a] += q * dt
        for i, j, value in (
            (p, v, q * dt**4 / 8.0),
            (p, a, q * dt**3 / 6.0),
            (v, a, q * dt**2 / 2.0),
        ):
            cov[i, j] += value
            cov[j, i] += value


MODEL = MotionModel(
    name="CONSTANT_ACCELERATION",
    propagate=propagate,
    transition=transition,
    add_noise=add_noise,
    states=("AX", "AY"),
    initial_sd=lambda config: (config.accel_state_sd_mps2, config.accel_state_sd_mps2),
    parameters={
        "jerk_density": real(
            1.0, 0.0, 1e4, "constant_acceleration: density of the white jerk [m/s^3/sqrt(Hz)]"
        ),
        "accel_state_sd_mps2": real(
            2.0, 1e-6, 1e3, "constant_acceleration: initial acceleration sd per axis"
        ),
    },
    own={"jerk": "jerk_density"},
    is_driven_by_white_acceleration=False,
)
