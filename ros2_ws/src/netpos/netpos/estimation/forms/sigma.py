"""Sigma points of the unscented filters, and what both filters take from them.

Merwe's scaled points with alpha = 1, beta = 2, kappa = 3 - n: the points lie sqrt(3) sd from the
mean on every axis whatever n is, the distance at which a Gaussian's fourth moment is met. So a
bias appended to the state does not change what a range or an angle does to the rest. A small alpha
would make tangents of the secants: passing an RSU at 10 m with a prior of 20 m sd, the first NEES
is 17 per state for alpha = 0.1, 1.6 for alpha = 1.

The central weight 1 - n/3 is negative beyond three states. All sums are taken about the central
point, where it drops out. With d_i = y_i - y_0, W = 1/(2 * 3) and shift = sum W d_i

    mean = y_0 + shift,    cov = sum W d_i d_i' + (beta - alpha^2) shift shift'

is identical to Merwe's weighted sums, holds no negative term for beta >= alpha^2 and does not
cancel: it is positive semidefinite for every n, and no down-date is needed for the central point.
Angles need no other mean: the d_i are wrapped. The direction of the weighted sum of unit vectors
(atan2), the same for narrow spreads, may turn around where a weight is negative.
"""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.measurement import VALUE, is_angle, is_cyclic, predict_row, wrap
from netpos.estimation.motion import propagate
from netpos.messages.values import Array

ALPHA, BETA = 1.0, 2.0
REACH2 = 3.0  # alpha^2 (n + kappa)
REACH = math.sqrt(REACH2)
_SHIFT_WEIGHT = math.sqrt(BETA - ALPHA * ALPHA)
_WEIGHT = math.sqrt(0.5 / REACH2)


def kappa(n: int) -> float:
    """Merwe's secondary scaling for ``n`` states."""
    return REACH2 / ALPHA**2 - n


@kernel
def move(mean: Array, L: Array, dt: float, motion: Array, bias: Array) -> Array:
    """Sigma points of ``mean`` (n,) and factor ``L`` (n, n) through ``motion.propagate``.

    ``mean`` becomes the mean of the moved points in place. Returns D (2n + 1, n): their covariance
    is D'D.
    """
    n = mean.size
    D, shift = np.empty((2 * n + 1, n)), np.zeros(n)
    _move(mean, L, dt, motion, bias, D, shift)
    return D


@leaf
def _move(
    mean: Array, L: Array, dt: float, motion: Array, bias: Array, D: Array, shift: Array
) -> None:
    n = mean.size
    for j in range(n):
        for a in range(n):
            D[j, a] = mean[a] + REACH * L[a, j]
            D[n + j, a] = mean[a] - REACH * L[a, j]
    propagate(mean, dt, motion, bias)
    for j in range(2 * n):
        propagate(D[j], dt, motion, bias)
        for a in range(n):
            D[j, a] = _WEIGHT * (D[j, a] - mean[a])
            shift[a] += _WEIGHT * D[j, a]
    for a in range(n):
        mean[a] += shift[a]
        D[2 * n, a] = _SHIFT_WEIGHT * shift[a]


@kernel
def regress(mean: Array, L: Array, rows: Array, height_m: float) -> tuple[Array, Array, Array]:
    """Statistical linear regression of ``rows`` (m, ROW_WIDTH) over the sigma points.

    With the state as mean + L u, u of unit covariance, a measurement is

        z = h + G u + E v + noise,    v of unit covariance

    Returns innovation z - h (m,), G (m, n) and E (m, n + 1), what is not linear. Covariance with
    the state: L G'; of the innovation: G G' + E E' + noise.
    """
    n, m = mean.size, rows.shape[0]
    innovation, G, E = np.empty(m), np.empty((m, n)), np.empty((m, n + 1))
    _regress(mean, L, rows, height_m, innovation, G, E, np.empty((3, n)))
    return innovation, G, E


@leaf
def _regress(
    mean: Array,
    L: Array,
    rows: Array,
    height_m: float,
    innovation: Array,
    G: Array,
    E: Array,
    work: Array,
) -> None:
    n, m = mean.size, rows.shape[0]
    high, low, h = work[0], work[1], work[2]
    for i in range(m):
        innovation[i] = predict_row(rows[i], mean, height_m, h)
        E[i, n] = 0.0
    for j in range(n):
        for a in range(n):
            high[a] = mean[a] + REACH * L[a, j]
            low[a] = mean[a] - REACH * L[a, j]
        for i in range(m):
            up = predict_row(rows[i], high, height_m, h) - innovation[i]
            down = predict_row(rows[i], low, height_m, h) - innovation[i]
            if is_angle(rows[i]):
                up, down = wrap(up), wrap(down)
            G[i, j] = (up - down) / (2.0 * REACH)
            E[i, j] = (up + down) / (2.0 * REACH)
            E[i, n] += (up + down) / (2.0 * REACH2)
    for i in range(m):
        innovation[i] = rows[i, VALUE] - innovation[i] - E[i, n]
        if is_cyclic(rows[i]):
            innovation[i] = wrap(innovation[i])
        E[i, n] *= _SHIFT_WEIGHT


@kernel
def innovation_cov(G: Array, E: Array, variance: Array) -> Array:
    """S = G G' + E E' + diag(variance), (m, m)."""
    m = G.shape[0]
    S = np.empty((m, m))
    for i in range(m):
        for j in range(i + 1):
            total = variance[i] if i == j else 0.0
            for a in range(G.shape[1]):
                total += G[i, a] * G[j, a]
            for a in range(E.shape[1]):
                total += E[i, a] * E[j, a]
            S[i, j] = S[j, i] = total
    return S
