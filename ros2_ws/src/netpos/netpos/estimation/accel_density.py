"""The density of the white acceleration, learned on the way by maximum likelihood.

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
deviation above its mean.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.factor import factor, solve_factored
from netpos.estimation.motion import Parameter, transition
from netpos.estimation.motion.process_noise import add_white_acceleration
from netpos.messages.values import Array

START = 0.5
"""Density [m/s^2/sqrt(Hz)] before anything is learned."""
LEAST, MOST = 0.1, 5.0
"""[m/s^2/sqrt(Hz)]: 0.3 m/s in 10 s; the speed of a runner in a second."""
SD = 1.0  # of theta before anything is learned: a factor of e
TIME_S = 60.0  # after which a device may move otherwise
_FARTHEST_SD = 5.0  # what one measurement may say at most, in standard deviations of its score
_TURNED = 0.5  # an epoch that a manoeuvre explains with this probability says nothing


class AccelDensity(NamedTuple):
    """What is known of theta: ``theta`` (2,), mean and variance; derivatives by it of the state's
    mean (n,) and covariance (n, n). Changed in place."""

    theta: Array
    mean: Array
    cov: Array


@kernel
def unknown_density(n: int) -> AccelDensity:
    """Nothing is learned yet, of a state of ``n`` entries."""
    theta = np.array([math.log(START) - SD, SD * SD])
    return AccelDensity(theta, np.zeros(n), np.zeros((n, n)))


def resized(learned: AccelDensity, n: int) -> AccelDensity:
    """A copy for a state of ``n`` entries, the new ones of which do not depend on theta."""
    old, copy = learned.mean.size, unknown_density(n)
    copy.theta[:], copy.mean[:old], copy.cov[:old, :old] = learned
    return AccelDensity(*copy)


@kernel
def density_of(learned: AccelDensity) -> float:
    """Density [m/s^2/sqrt(Hz)] that the filter takes."""
    return math.exp(learned.theta[0] + math.sqrt(learned.theta[1]))


@kernel
def move(learned: AccelDensity, mean: Array, dt: float, motion: Array, bias: Array) -> None:
    """Move what is learned with the state ``mean`` (n,) by ``dt`` seconds. ``motion`` may have a
    smaller density than ``density_of``, by what steps say: it does not depend on theta."""
    if dt <= 0.0:
        return
    F = np.empty_like(learned.cov)
    transition(mean, dt, motion, bias, F)
    learned.mean[:] = F @ learned.mean
    learned.cov[:] = F @ learned.cov @ F.T
    density = density_of(learned)
    if motion[Parameter.ACCEL] >= density:
        twice = motion.copy()
        twice[Parameter.ACCEL] = math.sqrt(2.0) * density  # dQ/dtheta = 2 Q
        add_white_acceleration(dt, twice, True, learned.cov)
    theta, kept = learned.theta, math.exp(-dt / TIME_S)
    theta[0] = math.log(START) - SD + kept * (theta[0] - math.log(START) + SD)
    theta[1] = kept * kept * theta[1] + (1.0 - kept * kept) * SD * SD


@kernel
def learn(
    learned: AccelDensity,
    prior_mean: Array,
    prior_cov: Array,
    mean: Array,
    cov: Array,
    turned: float,
) -> None:
    """Learn from an update of the prediction ``prior_mean`` (n,), ``prior_cov`` (n, n) to mean
    (n,), cov (n, n); ``turned``: the probability that a manoeuvre explains it."""
    dx, dP, theta = learned.mean, learned.cov, learned.theta
    n = mean.size
    B = np.empty((n, n + 1))
    B[:, :n], B[:, n] = cov.T, mean - prior_mean
    L = factor(prior_cov)
    solve_factored(L, B)
    A, u = B[:, :n].T.copy(), B[:, n].copy()
    M = np.eye(n) - A
    solve_factored(L, M)
    gained, pulled = M @ dP, dP @ u
    score = u @ dx + 0.5 * (u @ pulled - np.trace(gained))
    information = dx @ (M @ dx) + 0.5 * np.sum(gained * gained.T)
    if turned > _TURNED or not (information >= 0.0 and math.isfinite(score)):
        dx[:], dP[:] = 0.0, 0.0
        return
    farthest = _FARTHEST_SD * math.sqrt(information)
    theta[1] = theta[1] / (1.0 + theta[1] * information)
    found = theta[0] + theta[1] * min(max(score, -farthest), farthest)
    sd = math.sqrt(theta[1])
    theta[0] = min(max(found, math.log(LEAST) - sd), math.log(MOST) - sd)
    dx[:] = A @ (dx + pulled)
    moved = A @ dP @ A.T
    dP[:] = (moved + moved.T) / 2.0
