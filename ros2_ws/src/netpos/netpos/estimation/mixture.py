"""A Gaussian mixture over one state, for a posterior that is not one Gaussian.

A component that is too wide for the tangent of a range is split: the likelihood of a range is a
ring, and the ring is a sum of Gaussians along it, each short enough for the tangent to hold
(Alspach and Sorenson 1972; along the direction of greatest curvature, Tuggle and Zanetti 2018).
Components without weight are dropped; components that are alike become one by the bound of
Runnalls 2007.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.measurement import (
    ORIGIN,
    VARIANCE,
    curvature_variance,
    innovation_row,
    is_range,
    offset_up,
)
from netpos.messages.values import Array

Ints = npt.NDArray[np.int64]

_VELOCITY_END = 4  # position and velocity come first
# A component is split where the second-order variance exceeds this share of the row's,
_WIDE = 0.25
# or where it reaches the RSU within so many sd; narrower components (m) never are.
_REACH_SD, _NARROW_M = 3.0, 1.0
_SPACING_SD = 1.2  # of Gaussians along a ring: their sum is flat to 1e-3 there
_RING_MIN, RING_MAX = 12, 128
_OUTLIERS = 1e-2  # of all values; those of a range lie anywhere within
_OUTLIER_RANGE_M = 100.0
_LEAST_WEIGHT = 1e-8
_LEAST_PIVOT = 1e-300
_COMPONENTS_MAX = 64
_AT_ONCE_MAX = 256  # components that are merged at once
RING_MERGE_COST = 2e-4  # divergence (Runnalls' bound) that merging parts of a ring may cost
_APART2 = 9.0  # squared Mahalanobis distance of means from which components are two modes


class Mixture(NamedTuple):
    """Components: means (K, n), covs (K, n, n), log_weights (K,), the weights of which sum to
    one."""

    means: Array
    covs: Array
    log_weights: Array


@kernel
def _fuse(mean: Array, cov: Array, h: Array, residual: float, variance: float) -> float:
    """Fuse one linearised value in place, in Joseph form; its log likelihood."""
    n = mean.size
    Ph = cov @ h
    hPh = float(h @ Ph)
    s = hPh + variance
    for a in range(n):
        gain = Ph[a] / s
        mean[a] += gain * residual
        left = Ph[a] - gain * hPh - variance * gain  # zero but for rounding
        for b in range(a, n):
            cov[a, b] -= gain * Ph[b] + left * Ph[b] / s
            cov[b, a] = cov[a, b]
    return float(-0.5 * (residual * residual / s + math.log(2.0 * math.pi * s)))


@kernel
def outlier_log(rows: Array) -> float:
    """Log density of the values of one measurement that has nothing to do with the device."""
    total = math.log(_OUTLIERS)
    for i in range(rows.shape[0]):
        total -= math.log(_OUTLIER_RANGE_M if is_range(rows[i]) else 2.0 * math.pi)
    return total


@kernel
def _own_variance(row: Array, cov: Array, h: Array) -> float:
    """Variance of a row without that of position and velocity: noise, clock and slow errors."""
    total = row[VARIANCE]
    for a in range(_VELOCITY_END, cov.shape[0]):
        for b in range(_VELOCITY_END, cov.shape[0]):
            total += h[a] * cov[a, b] * h[b]
    return float(total)


@kernel
def is_wide(row: Array, mean: Array, cov: Array, height_m: float) -> bool:
    """Whether a component is to be split for a row: a range or time of arrival that narrows the
    position, but whose tangent does not hold over the component's width."""
    width2 = cov[0, 0] + cov[1, 1]
    if not is_range(row) or width2 < _NARROW_M * _NARROW_M:
        return False
    h = np.empty(mean.size)
    innovation_row(row, mean, height_m, h)
    own = _own_variance(row, cov, h)
    if own > width2:
        return False
    if curvature_variance(row, mean, cov, height_m) > _WIDE * own:
        return True
    dx, dy = mean[0] - row[ORIGIN], mean[1] - row[ORIGIN + 1]
    return bool(_REACH_SD * _REACH_SD * width2 > dx * dx + dy * dy)


@kernel
def splits(rows: Array, mean: Array, cov: Array, height_m: float) -> bool:
    """Whether the ``rows`` of one measurement split a component: a range alone that ``is_wide``.
    An angle measured with it tells where on the ring the device is."""
    return bool(rows.shape[0] == 1 and is_wide(rows[0], mean, cov, height_m))


@kernel
def split_along_ring(mean: Array, cov: Array, row: Array, height_m: float) -> Mixture:
    """The product of the Gaussian ``mean`` (n,), ``cov`` (n, n) and the likelihood of a range or
    time of arrival: components along the ring, their log weights not normalised."""
    n = mean.size
    h, at, along = np.empty(n), mean.copy(), np.zeros(n)
    residual = innovation_row(row, mean, height_m, h)
    dx, dy = mean[0] - row[ORIGIN], mean[1] - row[ORIGIN + 1]
    dz = offset_up(row, mean, height_m)
    slant = math.sqrt(dx * dx + dy * dy + dz * dz) + residual  # measured, less clock and biases
    own = _own_variance(row, cov, h)
    radius = math.sqrt(max(slant * slant - dz * dz, 0.25 * own, 1e-4))
    sd = math.sqrt(radius * math.sqrt(2.0 * _WIDE * own))  # whose second-order variance is own
    wanted = math.ceil(2.0 * math.pi * radius / (_SPACING_SD * sd))
    count = int(min(max(wanted, _RING_MIN), RING_MAX))
    arc = 2.0 * math.pi * radius / count
    sd = arc / _SPACING_SD
    means, covs, logs = np.empty((count, n)), np.empty((count, n, n)), np.empty(count)
    for k in range(count):
        angle = 2.0 * math.pi * (k + 0.5) / count
        c, s = math.cos(angle), math.sin(angle)
        at[0], at[1] = row[ORIGIN] + radius * c, row[ORIGIN + 1] + radius * s
        means[k], covs[k] = mean, cov
        residual = innovation_row(row, at, height_m, h)
        residual -= h[0] * (mean[0] - at[0]) + h[1] * (mean[1] - at[1])
        logs[k] = math.log(arc) + _fuse(means[k], covs[k], h, residual, row[VARIANCE])
        along[0], along[1] = -s, c
        residual = c * (at[1] - means[k, 1]) - s * (at[0] - means[k, 0])
        logs[k] += _fuse(means[k], covs[k], along, residual, sd * sd)
    return Mixture(means, covs, logs)


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
    kept = np.flatnonzero(logs > math.log(_LEAST_WEIGHT))
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


@kernel
def mode_of(components: Mixture) -> Ints:
    """Number of the mode (K,) each component belongs to, 0 the mode of the most probable one.

    Components belong to one mode where a chain of them leads from one to the other, each within
    3 sd (of both together) of the next.
    """
    means, covs, log_weights = components
    count = log_weights.size
    order = np.argsort(-log_weights)
    modes, found = np.full(count, -1), 0
    waiting = np.empty(count, dtype=np.int64)
    for first in order:
        if modes[first] >= 0:
            continue
        modes[first], waiting[0], left = found, first, 1
        while left > 0:
            left -= 1
            i = waiting[left]
            for j in range(count):
                if modes[j] >= 0:
                    continue
                away = means[j, :2] - means[i, :2]
                cov = covs[i, :2, :2] + covs[j, :2, :2]
                if float(away @ np.linalg.solve(cov, away)) < _APART2:
                    modes[j], waiting[left], left = found, j, left + 1
        found += 1
    return modes
