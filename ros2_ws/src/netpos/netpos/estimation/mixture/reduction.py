"""Components without weight are dropped; components that are alike become one, by the bound of
Runnalls 2007."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.mixture.gaussians import Ints, Mixture
from netpos.messages.values import Array

_VELOCITY_END = 4  # position and velocity come first
LEAST_WEIGHT = 1e-8
_LEAST_PIVOT = 1e-300
_COMPONENTS_MAX = 64
_AT_ONCE_MAX = 256  # components that are merged at once


@leaf
def _log_det(P: Array) -> float:
    """Log determinant of a covariance (k, k), which its Cholesky factor replaces; a direction
    without variance counts as one of almost none."""
    total = 0.0
    for i in range(P.shape[0]):
        for j in range(i + 1):
            left = P[i, j]
            for k in range(j):
                left -= P[i, k] * P[j, k]
            if i == j:
                pivot = max(left, _LEAST_PIVOT)
                P[i, i] = math.sqrt(pivot)
                total += math.log(pivot)
            else:
                P[i, j] = left / P[j, j]
    return total


@leaf
def _log_det_of(cov: Array, work: Array) -> float:
    """Log determinant of the covariance of position and velocity in ``cov`` (n, n)."""
    for a in range(_VELOCITY_END):
        for b in range(_VELOCITY_END):
            work[a, b] = cov[a, b]
    return float(_log_det(work))


@leaf
def _merge_cost(
    i: int, j: int, means: Array, covs: Array, weights: Array, log_dets: Array, work: Array
) -> float:
    """Runnalls 2007, eq. 21: what the merging of two components adds to the divergence, at most;
    by position and velocity."""
    total = weights[i] + weights[j]
    u, v = weights[i] / total, weights[j] / total
    for a in range(_VELOCITY_END):
        for b in range(a + 1):
            apart = (means[i, a] - means[j, a]) * (means[i, b] - means[j, b])
            work[a, b] = u * covs[i, a, b] + v * covs[j, a, b] + u * v * apart
    return float(
        0.5 * (total * _log_det(work) - weights[i] * log_dets[i] - weights[j] * log_dets[j])
    )


@leaf
def _merge(i: int, j: int, means: Array, covs: Array, weights: Array) -> None:
    """Put the component ``j`` into ``i``; together they keep their moments."""
    total = weights[i] + weights[j]
    u, v, n = weights[i] / total, weights[j] / total, means.shape[1]
    for a in range(n):
        for b in range(n):
            apart = (means[i, a] - means[j, a]) * (means[i, b] - means[j, b])
            covs[i, a, b] = u * covs[i, a, b] + v * covs[j, a, b] + u * v * apart
    for a in range(n):
        means[i, a] = u * means[i, a] + v * means[j, a]
    weights[i], weights[j] = total, 0.0


@kernel
def _find_partner(
    i: int,
    components: tuple[Array, Array, Array],
    log_dets: Array,
    partner: Ints,
    cost: Array,
    work: Array,
) -> None:
    """Find the component after ``i`` with which merging costs least."""
    means, covs, weights = components
    partner[i], cost[i] = -1, np.inf
    for j in range(i + 1, weights.size):
        if weights[j] > 0.0:
            found = _merge_cost(i, j, means, covs, weights, log_dets, work)
            if found < cost[i]:
                partner[i], cost[i] = j, found


@kernel
def _merge_alike(
    means: Array, covs: Array, weights: Array, merge_cost: float
) -> tuple[Array, Array, Array]:
    """Merge, in place, the two components for which it costs least, again and again while that is
    at most ``merge_cost`` or there are too many; what is left of means (K, n), covs (K, n, n),
    weights (K,)."""
    count = left = weights.size
    cost, log_dets = np.full(count, np.inf), np.empty(count)
    partner, work = np.full(count, -1), np.empty((_VELOCITY_END, _VELOCITY_END))
    for k in range(count):
        log_dets[k] = _log_det_of(covs[k], work)
    for i in range(count):
        _find_partner(i, (means, covs, weights), log_dets, partner, cost, work)
    while left > 1:
        i = int(np.argmin(cost))
        j = partner[i]
        if cost[i] > merge_cost and left <= _COMPONENTS_MAX:
            break
        _merge(i, j, means, covs, weights)
        log_dets[i], cost[j], left = _log_det_of(covs[i], work), np.inf, left - 1
        for k in range(j):
            if weights[k] <= 0.0:
                continue
            if k == i or partner[k] == i or partner[k] == j:
                _find_partner(k, (means, covs, weights), log_dets, partner, cost, work)
            elif k < i:
                merging = _merge_cost(k, i, means, covs, weights, log_dets, work)
                if merging < cost[k]:
                    partner[k], cost[k] = i, merging
    alive = np.flatnonzero(weights > 0.0)
    return means[alive], covs[alive], weights[alive]


@kernel
def reduced(components: Mixture, merge_cost: float) -> Mixture:
    """The mixture normalised, without components of no weight; components are merged while that
    costs at most ``merge_cost`` (Runnalls' bound of the divergence).

    The time is quadratic in the components, so that many are first merged in parts that lie side
    by side from west to east.
    """
    means, covs, log_weights = components
    top = log_weights.max()
    logs = log_weights - (top + math.log(np.exp(log_weights - top).sum()))
    kept = np.flatnonzero(logs > math.log(LEAST_WEIGHT))
    means, covs, weights = means[kept], covs[kept], np.exp(logs[kept])
    while weights.size > _AT_ONCE_MAX:
        order, end = np.argsort(means[:, 0]), 0
        means, covs, weights = means[order], covs[order], weights[order]
        for start in range(0, weights.size, _AT_ONCE_MAX):
            part = slice(start, start + _AT_ONCE_MAX)
            some = _merge_alike(
                means[part].copy(), covs[part].copy(), weights[part].copy(), merge_cost
            )
            size = some[2].size
            means[end : end + size], covs[end : end + size] = some[0], some[1]
            weights[end : end + size] = some[2]
            end += size
        means, covs, weights = means[:end], covs[:end], weights[:end]
    means, covs, weights = _merge_alike(means, covs, weights, merge_cost)
    return Mixture(means, covs, np.log(weights / weights.sum()))
