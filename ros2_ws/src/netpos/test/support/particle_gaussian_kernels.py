"""Compiled parts of the particle filter of narrow Gaussians."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

N = 6  # x, y, vx, vy, clock offset, drift
NEAREST_M = 0.2  # nearer to an RSU particles are not shorter
_PARTS_MAX = 32


@njit(cache=True)
def _predict(x, P, dt, noise):  # type: ignore[no-untyped-def]
    for a, b, q in ((0, 2, noise[0]), (1, 3, noise[0]), (4, 5, noise[2])):
        x[a] += dt * x[b]
        for i in range(N):
            P[a, i] += dt * P[b, i]
        for i in range(N):
            P[i, a] += dt * P[i, b]
        P[a, a] += q * dt**3 / 3.0
        P[a, b] += q * dt**2 / 2.0
        P[b, a] += q * dt**2 / 2.0
        P[b, b] += q * dt
    P[4, 4] += noise[1] * dt


@njit(cache=True)
def _linearise(row, x):  # type: ignore[no-untyped-def]
    """Innovation of a bearing (kind 3) or time of arrival (kind 4), gradient by x and y, and by
    the clock offset."""
    dx, dy = x[0] - row[3], x[1] - row[4]
    rho2 = max(dx * dx + dy * dy, 1e-6)
    if int(row[0]) == 3:
        e = row[1] - math.atan2(dy, dx)
        return (
            e - 2.0 * math.pi * math.floor(e / (2.0 * math.pi) + 0.5),
            -dy / rho2,
            dx / rho2,
            0.0,
        )
    r = math.sqrt(rho2 + row[5] * row[5])
    return row[1] - r - x[4], dx / r, dy / r, 1.0


@njit(cache=True)
def follow(means, covs, log_weights, times, rows, noise):  # type: ignore[no-untyped-def]
    """Move every particle (K, 6), (K, 6, 6) from row to row, fuse it and weigh the particle by it.

    rows (m, WIDTH) at ``times`` (m,); noise (3,): squared densities of acceleration, clock offset
    and clock drift.
    """
    Ph = np.empty(N)
    for k in range(means.shape[0]):
        x, P, now, gain = means[k], covs[k], 0.0, 0.0
        for j in range(rows.shape[0]):
            if times[j] > now:
                _predict(x, P, times[j] - now, noise)
                now = times[j]
            e, a, b, c = _linearise(rows[j], x)
            for i in range(N):
                Ph[i] = P[i, 0] * a + P[i, 1] * b + P[i, 4] * c
            s = a * Ph[0] + b * Ph[1] + c * Ph[4] + rows[j, 2] ** 2
            gain -= 0.5 * (e * e / s + math.log(s))
            for i in range(N):
                x[i] += Ph[i] * e / s
                for m in range(i + 1):
                    P[i, m] -= Ph[i] * Ph[m] / s
                    P[m, i] = P[i, m]
        log_weights[k] += gain


@njit(cache=True)
def _axis(P):  # type: ignore[no-untyped-def]
    """Variance and direction along which a position is widest."""
    half = 0.5 * math.atan2(2.0 * P[0, 1], P[0, 0] - P[1, 1])
    c, s = math.cos(half), math.sin(half)
    return c * c * P[0, 0] + 2.0 * c * s * P[0, 1] + s * s * P[1, 1], c, s


@njit(cache=True)
def shortened(rng, means, covs, probability, count, origin, longest):  # type: ignore[no-untyped-def]
    """Particles no longer than ``longest`` times their distance from ``origin`` (2,) along their
    longest axis: means, covs, the parent and the share of its weight of each. One that is longer
    becomes as many draws as its weight is worth among ``count`` particles."""
    K = means.shape[0]
    parts, limits = np.ones(K, dtype=np.int64), np.zeros(K)
    total = 0
    for k in range(K):
        r = math.hypot(means[k, 0] - origin[0], means[k, 1] - origin[1])
        limit = longest * max(r, NEAREST_M)
        variance, _, _ = _axis(covs[k])
        if variance > limit * limit:
            limits[k] = 0.5 * limit * limit
            most = int(count) if K == 1 else _PARTS_MAX
            parts[k] = min(max(math.ceil(count * probability[k]), 1), most)
        total += parts[k]
    x, P = np.empty((total, N)), np.empty((total, N, N))
    parent, share, end, Pu = np.empty(total, np.int64), np.empty(total), 0, np.empty(N)
    for k in range(K):
        for _ in range(parts[k]):
            x[end], P[end] = means[k], covs[k]
            parent[end], share[end] = k, 1.0 / parts[k]
            if limits[k] > 0.0:
                variance, c, s = _axis(covs[k])
                taken = variance - limits[k]
                away = math.sqrt(taken) * rng.standard_normal()
                for i in range(N):
                    Pu[i] = (covs[k, i, 0] * c + covs[k, i, 1] * s) / variance
                for i in range(N):
                    x[end, i] += Pu[i] * away
                    for m in range(N):
                        P[end, i, m] -= Pu[i] * Pu[m] * taken
            end += 1
    return x, P, parent, share, limits.max() > 0.0


@njit(cache=True)
def chosen(rng, p, count):  # type: ignore[no-untyped-def]
    """Index and weight of at most about ``count`` of the particles with weights ``p``: those
    above a threshold stay as they are, of the others so many are drawn that each weighs as much
    as the threshold (Fearnhead and Clifford 2003)."""
    order = np.argsort(-p)
    left, threshold, above = p.sum(), 0.0, 0
    for above in range(count):
        threshold = left / (count - above)
        if p[order[above]] <= threshold:
            break
        left -= p[order[above]]
    index, weight = np.empty(p.size, np.int64), np.empty(p.size)
    end, sum_, at = 0, 0.0, rng.random()
    for i in range(p.size):
        k = order[i]
        if i < above:
            index[end], weight[end] = k, p[k]
            end += 1
            continue
        sum_ += p[k] / threshold
        if sum_ > at:
            index[end], weight[end] = k, threshold
            end, at = end + 1, at + 1.0
    return index[:end], weight[:end]
