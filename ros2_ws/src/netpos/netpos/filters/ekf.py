"""Extended Kalman filter: prediction, gating by group, update by decorrelated scalar rows."""

from __future__ import annotations

import numpy as np
from numba import njit

from netpos.filters.measurement import GATE_VARIANCE, GROUP, VARIANCE, linearise
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
def update(
    mean: Array, cov: Array, rows: Array, height_m: float, gate_nis: Array
) -> tuple[Array, Array, Array, float, int]:
    """One epoch: linearise at the prior, gate each group as a whole, fuse what passed.

    rows : (m, ROW_WIDTH), rows of a group adjacent, groups numbered 0, 1, ... in order
    gate_nis : (d + 1,) largest accepted squared Mahalanobis distance for d degrees of freedom
        (inf: no gate)

    Returns mean, cov, accepted (groups,) as 0/1, NIS of the accepted rows together, their number.
    """
    innovation, H = linearise(rows, mean, height_m)
    m = rows.shape[0]
    groups = int(rows[m - 1, GROUP]) + 1
    accepted = np.zeros(groups)
    keep = np.zeros(m, dtype=np.bool_)
    start = 0
    for g in range(groups):
        stop = start
        while stop < m and int(rows[stop, GROUP]) == g:
            stop += 1
        nis = group_nis(
            cov, innovation[start:stop], H[start:stop], rows[start:stop, GATE_VARIANCE]
        )
        if nis <= gate_nis[min(stop - start, gate_nis.size - 1)]:
            accepted[g] = 1.0
            keep[start:stop] = True
        start = stop
    used = int(keep.sum())
    if used == 0:
        return mean, cov, accepted, 0.0, 0
    nu, Hk = innovation[keep], H[keep]
    nis = group_nis(cov, nu, Hk, rows[keep, GATE_VARIANCE])
    new_mean, new_cov = fuse(mean, cov, nu, Hk, rows[keep, VARIANCE])
    return new_mean, new_cov, accepted, nis, used
