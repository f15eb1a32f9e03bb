"""The densities of the process noise, learned on the way by maximum likelihood: of the white
acceleration, and of the walk of the device's clock.

The likelihood of each measurement is derived with respect to theta = ln(density): beside mean and
covariance the derivatives of both are carried (recursive prediction error method; Ljung and
Söderström 1983, section 3.7; Gupta and Mehra 1974 for the derivatives of a Kalman filter). Only
the prediction and the result of an update are needed, so that every form of the filter and a
mixture by its moments will do. With u = P^-1 (x+ - x), the information M = P^-1 (P - P+) P^-1
and A = P+ P^-1 of an update, and derivatives dx, dP of the prediction::

    score        -tr(M dP)/2 + u' dP u/2 + u' dx
    information  tr(M dP M dP)/2 + dx' M dx
    dx+ = A (dx + dP u),  dP+ = A dP A'

theta is a Gauss-Markov process about its prior; the density that the filter takes is one standard
deviation above its mean. Each density is learned as if the other were known.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netpos.estimation.compile import kernel
from netpos.estimation.factor import factor, solve_factored
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS, Parameter, transition
from netpos.estimation.motion.process_noise import add_walk
from netpos.estimation.state import X
from netpos.messages.values import Array


class Density(IntEnum):
    """Which density, as an index."""

    ACCEL = 0  # [m/s^2/sqrt(Hz)]
    CLOCK = 1  # [m/s/sqrt(s)]


# Of each density, in the order of ``Density``.
PARAMETERS = (int(Parameter.ACCEL), int(Parameter.DRIFT_DENSITY))
"""Its index in ``motion``."""
START = (0.5, 5e-7 * SPEED_OF_LIGHT_MPS)
"""What it is before anything is learned."""
LEAST = (0.1, 1e-10 * SPEED_OF_LIGHT_MPS)
"""A change of 0.3 m/s in 10 s, of 2 cm of the clock in a second."""
MOST = (5.0, 5e-6 * SPEED_OF_LIGHT_MPS)
"""The speed of a runner in a second, 0.9 km of the clock in a second."""
SD = (1.0, 2.0)
"""Standard deviation of theta before anything is learned: a factor of e, of 7."""
TIME_S = (60.0, 600.0)
"""Correlation time [s] of theta: a device moves otherwise, a clock gets warmer."""
_FARTHEST_SD = 5.0  # what one measurement may say at most, in standard deviations of its score
_TURNED = 0.5  # an epoch that a manoeuvre explains with this probability says nothing
_KEPT = 0.999  # an epoch that leaves more of the variance of the clock does not inform of it
_STEP_SD = 5.0  # a clock that moves farther by an update has stepped: the gate allows less

HELD, AWAITED, LEARNED = range(3)
"""Phases of a density: not learned; not yet, as no measurement has informed of it; learned."""


def held(declared: float, which: Density) -> float:
    """The density that is not learned: the one ``declared``, or, if that is 0, the one that
    learning starts from."""
    return declared or START[which]


class Densities(NamedTuple):
    """What is known of each theta: ``phase`` (2,); ``theta`` (2, 2), mean and variance;
    derivatives by it of the state's mean (2, n) and covariance (2, n, n). Changed in place."""

    phase: NDArray[np.int64]
    theta: Array
    mean: Array
    cov: Array


@kernel
def unknown_densities(n: int, learns: tuple[bool, bool]) -> Densities:
    """Nothing is learned yet, of a state of ``n`` entries; ``learns``: which are to be."""
    phase, theta, (accel, clock) = np.zeros(2, np.int64), np.empty((2, 2)), learns
    for k in range(2):
        theta[k, 0], theta[k, 1] = math.log(START[k]) - SD[k], SD[k] ** 2
    if accel:
        phase[Density.ACCEL] = LEARNED
    if clock:
        phase[Density.CLOCK] = AWAITED
    return Densities(phase, theta, np.zeros((2, n)), np.zeros((2, n, n)))


def resized(learned: Densities, n: int) -> Densities:
    """A copy for a state of ``n`` entries, the new ones of which depend on no density."""
    old, copy = learned.mean.shape[1], unknown_densities(n, (False, False))
    copy.phase[:], copy.theta[:], copy.mean[:, :old], copy.cov[:, :old, :old] = learned
    return Densities(*copy)


@kernel
def density_of(learned: Densities, k: int) -> float:
    """The ``Density`` k that the filter takes."""
    return math.exp(learned.theta[k, 0] + math.sqrt(learned.theta[k, 1]))


@kernel
def write_densities(learned: Densities, motion: Array) -> None:
    """Let ``motion`` have the densities that are not held."""
    for k in range(2):
        if learned.phase[k] != HELD:
            motion[PARAMETERS[k]] = density_of(learned, k)


@kernel
def move(learned: Densities, mean: Array, dt: float, motion: Array, bias: Array) -> None:
    """Move what is learned with the state ``mean`` (n,) by ``dt`` seconds. ``motion`` may have a
    smaller density than ``density_of``, by what steps say: it does not depend on theta."""
    for k in range(2):
        if learned.phase[k] != LEARNED:
            learned.mean[k], learned.cov[k] = 0.0, 0.0
    if dt <= 0.0 or learned.phase.max() < LEARNED:
        return
    F = np.empty_like(learned.cov[0])
    transition(mean, dt, motion, bias, F)
    for k in range(2):
        if learned.phase[k] != LEARNED:
            continue
        dx, dP, theta = learned.mean[k], learned.cov[k], learned.theta[k]
        dx[:] = F @ dx
        dP[:] = F @ dP @ F.T
        density = density_of(learned, k)
        if motion[PARAMETERS[k]] >= density:
            twice = (math.sqrt(2.0) * density) ** 2  # dQ/dtheta = 2 Q
            if k == Density.ACCEL:
                add_walk(X.PX, X.VX, dt, twice, dP)
                add_walk(X.PY, X.VY, dt, twice, dP)
            else:
                add_walk(X.CLOCK, X.DRIFT, dt, twice, dP)
        at_first, kept = math.log(START[k]) - SD[k], math.exp(-dt / TIME_S[k])
        theta[0] = at_first + kept * (theta[0] - at_first)
        theta[1] = kept * kept * theta[1] + (1.0 - kept * kept) * SD[k] ** 2


@kernel
def clock_has_stepped(prior_mean: Array, prior_cov: Array, mean: Array) -> bool:
    """Whether an update of the prediction ``prior_mean`` (n,), ``prior_cov`` (n, n) to ``mean``
    (n,) moves the clock farther than its prediction allows."""
    moved = mean[X.CLOCK] - prior_mean[X.CLOCK]
    return bool(moved * moved > _STEP_SD * _STEP_SD * prior_cov[X.CLOCK, X.CLOCK])


@kernel
def learn(
    learned: Densities,
    prior_mean: Array,
    prior_cov: Array,
    mean: Array,
    cov: Array,
    turned: float,
) -> None:
    """Learn from an update of the prediction ``prior_mean`` (n,), ``prior_cov`` (n, n) to mean
    (n,), cov (n, n); ``turned``: the probability that a manoeuvre explains it. An update that a
    manoeuvre or a step of the clock explains says nothing: the derivatives begin anew."""
    if turned > _TURNED or clock_has_stepped(prior_mean, prior_cov, mean):
        learned.mean[:], learned.cov[:] = 0.0, 0.0
    elif learned.phase.max() == LEARNED:
        n = mean.size
        B = np.empty((n, n + 1))
        B[:, :n], B[:, n] = cov.T, mean - prior_mean
        L = factor(prior_cov)
        solve_factored(L, B)
        A, u = B[:, :n].T.copy(), B[:, n].copy()
        M = np.eye(n) - A
        solve_factored(L, M)
        for k in range(2):
            if learned.phase[k] == LEARNED:
                _learn_one(learned, k, A, M, u)
    if learned.phase[Density.CLOCK] == AWAITED:
        informs = cov[X.CLOCK, X.CLOCK] < _KEPT * prior_cov[X.CLOCK, X.CLOCK]
        learned.phase[Density.CLOCK] = LEARNED if informs else AWAITED


@kernel
def _learn_one(learned: Densities, k: int, A: Array, M: Array, u: Array) -> None:
    """Of an update with ``A`` and ``M`` (n, n), ``u`` (n,) the ``Density`` k."""
    dx, dP, theta = learned.mean[k], learned.cov[k], learned.theta[k]
    gained, pulled = M @ dP, dP @ u
    score = u @ dx + 0.5 * (u @ pulled - np.trace(gained))
    information = dx @ (M @ dx) + 0.5 * np.sum(gained * gained.T)
    if not (information >= 0.0 and math.isfinite(score)):
        dx[:], dP[:] = 0.0, 0.0
        return
    farthest = _FARTHEST_SD * math.sqrt(information)
    theta[1] = theta[1] / (1.0 + theta[1] * information)
    found = theta[0] + theta[1] * min(max(score, -farthest), farthest)
    sd = math.sqrt(theta[1])
    theta[0] = min(max(found, math.log(LEAST[k]) - sd), math.log(MOST[k]) - sd)
    dx[:] = A @ (dx + pulled)
    moved = A @ dP @ A.T
    dP[:] = (moved + moved.T) / 2.0
