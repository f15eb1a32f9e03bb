"""Parts of process noise that several models have. Everything adds to ``cov`` (n, n) in place."""

from __future__ import annotations

from netpos.estimation.compile import inlined
from netpos.estimation.motion.parameters import Parameter, ProcessNoise
from netpos.estimation.state import X
from netpos.messages.values import Array


@inlined
def add_walk(value: int, rate: int, dt: float, q: float, cov: Array) -> None:
    """Noise of a value whose rate does a random walk of density ``q``."""
    cov[value, value] += q * dt**3 / 3.0
    cov[value, rate] += q * dt**2 / 2.0
    cov[rate, value] += q * dt**2 / 2.0
    cov[rate, rate] += q * dt


@inlined
def add_velocity_step(sd: float, time_s: float, position_sd: float, cov: Array) -> None:
    """Add, in place, a velocity step of ``sd`` [m/s] per axis ``time_s`` ago, and the position it
    leads to, known but for ``position_sd`` (sd). Nothing happens for sd 0."""
    if sd == 0.0:
        return
    for p in range(2):
        v = X.VX + p
        cov[p, p] += (sd * time_s) ** 2 + position_sd**2
        cov[p, v] += sd * sd * time_s
        cov[v, p] += sd * sd * time_s
        cov[v, v] += sd * sd


@inlined
def add_acceleration(dt: float, motion: Array, cov: Array) -> None:
    """Noise of position and velocity as the ``ProcessNoise`` of ``motion`` says."""
    if int(motion[Parameter.NOISE]) == ProcessNoise.WERNER:
        step = motion[Parameter.VELOCITY_STEP] ** 2
        cov[X.VX, X.VX] += step
        cov[X.VY, X.VY] += step
    else:
        continuous = int(motion[Parameter.NOISE]) == ProcessNoise.CONTINUOUS
        add_white_acceleration(dt, motion, continuous, cov)


@inlined
def add_white_acceleration(dt: float, motion: Array, continuous: bool, cov: Array) -> None:
    """Noise of position and velocity under white acceleration, continuous or constant in each
    step."""
    q = motion[Parameter.ACCEL] ** 2
    if continuous:
        pp, pv, vv = q * dt**3 / 3.0, q * dt**2 / 2.0, q * dt
    else:
        pp, pv, vv = q * dt**4 / 4.0, q * dt**3 / 2.0, q * dt**2
    for p in range(2):
        v = X.VX + p
        cov[p, p] += pp
        cov[p, v] += pv
        cov[v, p] += pv
        cov[v, v] += vv


@inlined
def add_clock(dt: float, motion: Array, cov: Array) -> None:
    """Noise of the device's clock."""
    if int(motion[Parameter.NOISE]) != ProcessNoise.CONTINUOUS:
        cov[X.DRIFT, X.DRIFT] += motion[Parameter.DRIFT_STEP] ** 2
        return
    cov[X.CLOCK, X.CLOCK] += motion[Parameter.OFFSET_DENSITY] ** 2 * dt
    add_walk(X.CLOCK, X.DRIFT, dt, motion[Parameter.DRIFT_DENSITY] ** 2, cov)
