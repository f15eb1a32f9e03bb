"""Components without weight are dropped; components that are alike become one, by the bound of
Runnalls 2007."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.mixture.gaussians import Ints, Mixture, mode_of
from netpos.messages.values import Array

_VELOCITY_END = 4  # position and velocity come first
PART_MERGE_COST = 2e-4
"""Divergence (Runnalls' bound) that merging parts of a component may cost."""
LEAST_WEIGHT = 1e-8
_LEAST_PIVOT = 1e-300
_COMPONENTS_MAX = 64
_LEAST_MODE_WEIGHT = 1e-3  # modes of less are merged as if they had that
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


class _Parts(NamedTuple):
    """Components that are merged: means (K, n), covs (K, n, n), weights (K,), 0 of one that has
    gone into another; the weights of the modes they belong to, and the log determinants (K,) of
    their covariances of position and velocity."""

    means: Array
    covs: Array
    weights: Array
    mode_weights: Array
    log_dets: Array


@kernel
def _parts(means: Array, covs: Array, weights: Array) -> _Parts:
    """Copies of components before anything is merged."""
    log_dets, work = np.empty(weights.size), np.empty((_VELOCITY_END, _VELOCITY_END))
    for k in range(weights.size):
        log_dets[k] = _log_det_of(covs[k], work)
    modes = mode_of(Mixture(means, covs, np.log(weights)))
    sums = np.zeros(modes.max() + 1)
    for k in range(weights.size):
        sums[modes[k]] += weights[k]
    mode_weights = np.maximum(sums[modes], _LEAST_MODE_WEIGHT)
    return _Parts(means.copy(), covs.copy(), weights.copy(), mode_weights, log_dets)


@leaf
def _merge_cost(i: int, j: int, parts: _Parts, work: Array) -> float:
    """Runnalls 2007, eq. 21, by position and velocity: what the merging of two components adds to
    the divergence, at most; of the mode they belong to, not of the whole mixture."""
    means, covs, weights, mode_weights, log_dets = parts
    total = weights[i] + weights[j]
    u, v = weights[i] / total, weights[j] / total
    for a in range(_VELOCITY_END):
        for b in range(a + 1):
            apart = (means[i, a] - means[j, a]) * (means[i, b] - means[j, b])
            work[a, b] = u * covs[i, a, b] + v * covs[j, a, b] + u * v * apart
    cost = total * _log_det(work) - weights[i] * log_dets[i] - weights[j] * log_dets[j]
    return float(0.5 * cost / max(mode_weights[i], mode_weights[j]))


@leaf
def _merge(i: int, j: int, parts: _Parts, work: Array) -> None:
    """Put the component ``j`` into ``i``; together they keep their moments."""
    means, covs, weights, mode_weights, log_dets = parts
    total = weights[i] + weights[j]
    u, v, n = weights[i] / total, weights[j] / total, means.shape[1]
    for a in range(n):
        for b in range(n):
            apart = (means[i, a] - means[j, a]) * (means[i, b] - means[j, b])
            covs[i, a, b] = u * covs[i, a, b] + v * covs[j, a, b] + u * v * apart
    for a in range(n):
        means[i, a] = u * means[i, a] + v * means[j, a]
    weights[i], weights[j] = total, 0.0
    mode_weights[i] = max(mode_weights[i], mode_weights[j])
    log_dets[i] = _log_det_of(covs[i], work)


@kernel
def _find_partner(i: int, parts: _Parts, partner: Ints, cost: Array, work: Array) -> None:
    """Find the component after ``i`` with which merging costs least."""
    partner[i], cost[i] = -1, np.inf
    for j in range(i + 1, partner.size):
        if parts.weights[j] > 0.0:
            found = _merge_cost(i, j, parts, work)
            if found < cost[i]:
                partner[i], cost[i] = j, found


@kernel
def _merge_alike(
    means: Array, covs: Array, weights: Array, merge_cost: float
) -> tuple[Array, Array, Array]:
    """Merge the two components for which it costs least, again and again while that is at most
    ``merge_cost`` or there are too many; what is left of means (K, n), covs (K, n, n), weights
    (K,)."""
    parts = _parts(means, covs, weights)
    count = left = weights.size
    cost, partner = np.full(count, np.inf), np.full(count, -1)
    work = np.empty((_VELOCITY_END, _VELOCITY_END))
    for i in range(count):
        _find_partner(i, parts, partner, cost, work)
    while left > 1:
        i = int(np.argmin(cost))
        j = partner[i]
        if cost[i] > merge_cost and left <= _COMPONENTS_MAX:
            break
        _merge(i, j, parts, work)
        cost[j], left = np.inf, left - 1
        for k in range(j):
            if parts.weights[k] <= 0.0:
                continue
            if k == i or partner[k] == i or partner[k] == j:
                _find_partner(k, parts, partner, cost, work)
            elif k < i:
                merging = _merge_cost(k, i, parts, work)
                if merging < cost[k]:
                    partner[k], cost[k] = i, merging
    alive = np.flatnonzero(parts.weights > 0.0)
    return parts.means[alive], parts.covs[alive], parts.weights[alive]


@kernel
def reduced(components: Mixture, merge_cost: float) -> Mixture:
    """The mixture normalised, without components of no weight; components are merged while that
    costs at most ``merge_cost`` (Runnalls' bound of the divergence of the mode they belong to:
    of two places that nothing tells apart none is described more coarsely, which would make it
    less and less probable).

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
            some = _merge_alike(means[part], covs[part], weights[part], merge_cost)
            size = some[2].size
            means[end : end + size], covs[end : end + size] = some[0], some[1]
            weights[end : end + size] = some[2]
            end += size
        means, covs, weights = means[:end], covs[:end], weights[:end]
    means, covs, weights = _merge_alike(means, covs, weights, merge_cost)
    return Mixture(means, covs, np.log(weights / weights.sum()))
