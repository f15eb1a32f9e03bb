"""Extended Kalman filter: prediction, gating by group, update by decorrelated scalar rows."""

from __future__ import annotations

import numpy as np
from numba import njit

from netpos.filters.measurement import (
    GATE_VARIANCE,
    GROUP,
    VARIANCE,
    curvature_variance,
    linearise,
)
from netpos.messages.values import Array


@njit(cache=True)
def predict(mean: Array, cov: Array, F: Array, Q: Array) -> tuple[Array, Array]:
    """Prior mean (n,) and covariance (n, n): fokin2020:eq.21, 22. The covariance comes back
    symmetric."""
    prior = F @ cov @ F.T + Q
    return F @ mean, (prior + prior.T) / 2.0


@njit(cache=True)
def group_nis(cov: Array, innovation: Array, H: Array, variance: Array) -> float:
    """Squared Mahalanobis distance of one group's innovation (m,), with S = H cov H' +
    diag(variance)."""
    S = H @ cov @ H.T
    for i in range(innovation.size):
        S[i, i] += variance[i]
    return float(innovation @ np.linalg.solve(S, innovation))


@njit(cache=True)
def fuse(
    mean: Array, cov: Array, innovation: Array, H: Array, variance: Array
) -> tuple[Array, Array]:
    """Fuse m scalar rows, all linearised at ``mean``: fokin2020:eq.23-25 with diagonal R, row by
    row in Joseph form.

    mean (n,), cov (n, n), innovation (m,), H (m, n), variance (m,) > 0. The same posterior as one
    update with the full S.
    """
    n = mean.size
    P = cov.copy()
    step = np.zeros(n)
    Ph = np.empty(n)
    K = np.empty(n)
    for i in range(innovation.size):
        h = H[i]
        r = variance[i]
        s = r
        residual = innovation[i]
        for a in range(n):
            total = 0.0
            for b in range(n):
                total += P[a, b] * h[b]
            Ph[a] = total
            s += h[a] * total
            residual -= h[a] * step[a]
        hPh = s - r
        for a in range(n):
            K[a] = Ph[a] / s
            step[a] += K[a] * residual
        for a in range(n):
            left_h = Ph[a] - K[a] * hPh  # (I - K h) P h
            for b in range(a, n):
                value = P[a, b] - K[a] * Ph[b] - left_h * K[b] + r * K[a] * K[b]
                P[a, b] = value
                P[b, a] = value
    return mean + step, P


@njit(cache=True)
def distance2(cov: Array, d: Array) -> float:
    """Squared Mahalanobis distance of ``d`` (n,) by elimination.

    What is known exactly (a pivot of no more than rounding) is left out, so that ``cov`` (n, n)
    may be singular.
    """
    A, y = cov.copy(), d.copy()
    total = 0.0
    for j in range(d.size):
        pivot = A[j, j]
        if pivot <= 1e-14 * cov[j, j]:
            continue
        total += y[j] * y[j] / pivot
        for i in range(j + 1, d.size):
            factor = A[i, j] / pivot
            y[i] -= factor * y[j]
            for k in range(j + 1, d.size):
                A[i, k] -= factor * A[j, k]
    return total


@njit(cache=True)
def misfit(
    mean: Array, cov: Array, rows: Array, variance: Array, height_m: float, x: Array
) -> float:
    """Twice the negative log posterior of ``x`` (n,) but for a constant: prior and measurement
    terms.

    At the most probable ``x`` of a linear model this is the NIS, chi-square with one degree of
    freedom
    per row; unlike the NIS it stays so where the model bends over the width of the prior.
    """
    innovation, _ = linearise(rows, x, height_m)
    return float(distance2(cov, x - mean) + (innovation * innovation / variance).sum())


@njit(cache=True)
def iterate(
    mean: Array, cov: Array, rows: Array, variance: Array, height_m: float, iterations: int
) -> tuple[Array, Array]:
    """Posterior of ``rows`` (m, ROW_WIDTH) with ``variance`` (m,); each iteration linearises at
    the last result.

    One iteration is the extended Kalman filter; more are Gauss-Newton steps to the most probable
    state (Bell and Cathey 1993), halved while they overshoot, ended when they move less than 1 %
    of the sd or no longer downhill: the result is never less probable than the prior mean.
    """
    innovation, H = linearise(rows, mean, height_m)
    x, P = fuse(mean, cov, innovation, H, variance)
    if iterations <= 1:
        return x, P
    last, last_cost = mean, (innovation * innovation / variance).sum()
    for remaining in range(iterations - 1, -1, -1):
        cost = misfit(mean, cov, rows, variance, height_m, x)
        halvings = 0
        while cost > last_cost and halvings < 6:
            x = (x + last) / 2.0
            cost = misfit(mean, cov, rows, variance, height_m, x)
            halvings += 1
        if cost > last_cost:
            return last, P
        small = (np.abs(x - last) < 0.01 * np.sqrt(np.diag(P))).all()
        if remaining == 0 or (halvings == 0 and small):
            break
        last, last_cost = x, cost
        innovation, H = linearise(rows, x, height_m)
        x, P = fuse(mean, cov, innovation + H @ (x - mean), H, variance)
    return x, P


@njit(cache=True)
def passes(
    mean: Array, cov: Array, rows: Array, height_m: float, threshold: float, iterations: int
) -> bool:
    """Whether one group lies within ``threshold`` of squared Mahalanobis distance of the
    prediction.

    Where the linear distance says no and iterating is allowed, the misfit of the group's most
    probable
    state decides.
    """
    innovation, H = linearise(rows, mean, height_m)
    variance = rows[:, GATE_VARIANCE]
    if group_nis(cov, innovation, H, variance) <= threshold:
        return True
    if iterations <= 1:
        return False
    x, _ = iterate(mean, cov, rows, variance, height_m, iterations)
    return bool(misfit(mean, cov, rows, variance, height_m, x) <= threshold)


@njit(cache=True)
def update(
    mean: Array, cov: Array, rows: Array, height_m: float, gate_nis: Array, iterations: int
) -> tuple[Array, Array, Array, float, int]:
    """One epoch: gate each group as a whole, fuse what passed.

    rows : (m, ROW_WIDTH), rows of a group adjacent, groups numbered 0, 1, ... in order
    gate_nis : (d + 1,) largest accepted squared Mahalanobis distance for d degrees of freedom
        (inf: no gate)
    iterations : linearisations at most; 1 is the extended Kalman filter

    Returns mean, cov, accepted (groups,) as 0/1, NIS of the accepted rows together, their number.
    """
    rows = rows.copy()
    m = rows.shape[0]
    for i in range(m):
        extra = curvature_variance(rows[i], mean, cov, height_m)
        rows[i, VARIANCE] += extra
        rows[i, GATE_VARIANCE] += extra
    groups = int(rows[m - 1, GROUP]) + 1
    accepted = np.zeros(groups)
    keep = np.zeros(m, dtype=np.bool_)
    start = 0
    for g in range(groups):
        stop = start
        while stop < m and int(rows[stop, GROUP]) == g:
            stop += 1
        threshold = gate_nis[min(stop - start, gate_nis.size - 1)]
        if passes(mean, cov, rows[start:stop], height_m, threshold, iterations):
            accepted[g] = 1.0
            keep[start:stop] = True
        start = stop
    used = int(keep.sum())
    if used == 0:
        return mean, cov, accepted, 0.0, 0
    kept = rows[keep]
    innovation, H = linearise(kept, mean, height_m)
    nis = group_nis(cov, innovation, H, kept[:, GATE_VARIANCE])
    new_mean, new_cov = iterate(mean, cov, kept, kept[:, VARIANCE], height_m, iterations)
    return new_mean, new_cov, accepted, nis, used
