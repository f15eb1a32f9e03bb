"""A Gaussian mixture over one state, for a posterior that is not one Gaussian.

A mixture is (means (K, n), covs (K, n, n), log_weights (K,)); the weights sum to one. An epoch
updates each component as an extended Kalman filter does. A component that is too wide for the
tangent of a range is split first: the likelihood of a range is a ring, and the ring is a sum of
Gaussians along it, each short enough for the tangent to hold (Alspach and Sorenson 1972; along the
direction of greatest curvature, Tuggle and Zanetti 2018). Components without weight are dropped;
components that are alike become one by the bound of Runnalls 2007.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from netpos.filters import ekf
from netpos.filters.compile import kernel
from netpos.filters.measurement import (
    GROUP,
    KIND,
    LEVER,
    ORIGIN,
    VARIANCE,
    Kind,
    curvature_variance,
    innovation_row,
    innovation_variance,
)
from netpos.filters.motion import Parameter
from netpos.messages.values import Array

Mixture = tuple[Array, Array, Array]
Ints = npt.NDArray[np.int64]

_VELOCITY_END = 4  # position and velocity come first
# A component is split where the second-order variance exceeds this share of the row's,
_WIDE = 0.25
# or where it reaches the RSU within so many sd; narrower components (m) never are.
_REACH_SD, _NARROW_M = 3.0, 1.0
_SPACING_SD = 1.2  # of Gaussians along a ring: their sum is flat to 1e-3 there
_RING_MIN, _RING_MAX = 12, 128
_OUTLIERS = 1e-2  # of all values; those of a range lie anywhere within
_OUTLIER_RANGE_M = 100.0
_LEAST_WEIGHT = 1e-8
_COMPONENTS_MAX = 64
_ALIKE = 2e-4  # divergence (Runnalls' bound) below which two components become one
_APART2 = 9.0  # squared Mahalanobis distance of means from which components are two modes


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
def _is_ranged(row: Array) -> bool:
    return bool(int(row[KIND]) == Kind.RANGE or int(row[KIND]) == Kind.TOA)


@kernel
def _outlier_log(rows: Array) -> float:
    """Log density of the values of one measurement that has nothing to do with the device."""
    total = math.log(_OUTLIERS)
    for i in range(rows.shape[0]):
        total -= math.log(_OUTLIER_RANGE_M if _is_ranged(rows[i]) else 2.0 * math.pi)
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
    if not _is_ranged(row) or width2 < _NARROW_M * _NARROW_M:
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
def will_split(
    mean: Array, cov: Array, dt: float, motion: Array, bias: Array, rows: Array, height_m: float
) -> bool:
    """Whether one of ``rows`` finds the Gaussian too wide once it is moved by ``dt`` seconds;
    arguments as for ``ekf.predict``, nothing is changed."""
    moved, P, straight = mean.copy(), cov.copy(), motion.copy()
    straight[Parameter.VELOCITY_STEP_SD] = 0.0
    ekf.predict(moved, P, dt, straight, bias)
    start = 0
    while start < rows.shape[0]:
        stop = start + 1
        while stop < rows.shape[0] and rows[stop, GROUP] == rows[start, GROUP]:
            stop += 1
        if splits(rows[start:stop], moved, P, height_m):
            return True
        start = stop
    return False


@kernel
def _update_component(
    mean: Array, cov: Array, rows: Array, height_m: float, gate_nis: Array
) -> tuple[float, float, bool]:
    """Fuse one measurement's rows in place if the gate takes them: log likelihood (that of an
    outlier if it does not), NIS, whether it was taken."""
    n, m = mean.size, rows.shape[0]
    H, innovation, variance = np.empty((m, n)), np.empty(m), np.empty(m)
    for i in range(m):
        innovation[i] = innovation_row(rows[i], mean, height_m, H[i])
        variance[i] = rows[i, VARIANCE] + curvature_variance(rows[i], mean, cov, height_m)
    S = H @ cov @ H.T
    for i in range(m):
        S[i, i] += variance[i]
    nis = float(innovation @ np.linalg.solve(S, innovation))
    if nis > gate_nis[min(m, gate_nis.size - 1)]:
        return _outlier_log(rows), nis, False
    start, log_likelihood = mean.copy(), 0.0
    for i in range(m):
        residual = innovation[i] - float(H[i] @ (mean - start))
        log_likelihood += _fuse(mean, cov, H[i], residual, variance[i])
    return log_likelihood, nis, True


@kernel
def split_along_ring(mean: Array, cov: Array, row: Array, height_m: float) -> Mixture:
    """The product of the Gaussian ``mean`` (n,), ``cov`` (n, n) and the likelihood of a range or
    time of arrival: components along the ring, their log weights not normalised."""
    n = mean.size
    h, at, along = np.empty(n), mean.copy(), np.zeros(n)
    residual = innovation_row(row, mean, height_m, h)
    dx, dy = mean[0] - row[ORIGIN], mean[1] - row[ORIGIN + 1]
    dz = height_m + row[LEVER + 2] - row[ORIGIN + 2]
    slant = math.sqrt(dx * dx + dy * dy + dz * dz) + residual  # measured, less clock and biases
    own = _own_variance(row, cov, h)
    radius = math.sqrt(max(slant * slant - dz * dz, 0.25 * own, 1e-4))
    sd = math.sqrt(radius * math.sqrt(2.0 * _WIDE * own))  # whose second-order variance is own
    wanted = math.ceil(2.0 * math.pi * radius / (_SPACING_SD * sd))
    count = int(min(max(wanted, _RING_MIN), _RING_MAX))
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
    return means, covs, logs


@kernel
def _log_det(cov: Array) -> float:
    """Log determinant of the covariance of position and velocity."""
    end = _VELOCITY_END
    return float(2.0 * np.log(np.diag(np.linalg.cholesky(cov[:end, :end].copy()))).sum())


@kernel
def _merged(
    i: int, j: int, means: Array, covs: Array, weights: Array
) -> tuple[float, Array, Array]:
    """Weight, mean and covariance of two components as one, which keeps their moments."""
    total = weights[i] + weights[j]
    a, b = weights[i] / total, weights[j] / total
    away = means[i] - means[j]
    mean = a * means[i] + b * means[j]
    return total, mean, a * covs[i] + b * covs[j] + a * b * np.outer(away, away)


@kernel
def _merge_cost(
    i: int, j: int, means: Array, covs: Array, weights: Array, log_dets: Array
) -> float:
    """Runnalls 2007, eq. 21: what the merging of two components adds to the divergence, at most;
    by position and velocity."""
    end = _VELOCITY_END
    total, _, cov = _merged(i, j, means[:, :end], covs[:, :end, :end], weights)
    parts = weights[i] * log_dets[i] + weights[j] * log_dets[j]
    return float(0.5 * (total * _log_det(cov) - parts))


@kernel
def reduced(means: Array, covs: Array, log_weights: Array) -> Mixture:
    """The mixture normalised, without components of no weight, and with merged what is alike."""
    top = log_weights.max()
    logs = log_weights - (top + math.log(np.exp(log_weights - top).sum()))
    kept = np.flatnonzero(logs > math.log(_LEAST_WEIGHT))
    means, covs, weights = means[kept], covs[kept], np.exp(logs[kept])
    count = left = kept.size
    costs, log_dets = np.full((count, count), np.inf), np.empty(count)
    for k in range(count):
        log_dets[k] = _log_det(covs[k])
    for i in range(count):
        for j in range(i + 1, count):
            costs[i, j] = _merge_cost(i, j, means, covs, weights, log_dets)
    while left > 1:
        i, j = divmod(int(np.argmin(costs)), count)
        if costs[i, j] > _ALIKE and left <= _COMPONENTS_MAX:
            break
        weights[i], means[i], covs[i] = _merged(i, j, means, covs, weights)
        weights[j], log_dets[i], left = 0.0, _log_det(covs[i]), left - 1
        costs[j, :] = costs[:, j] = np.inf
        for k in range(count):
            if weights[k] > 0.0 and k != i:
                low, high = min(i, k), max(i, k)
                costs[low, high] = _merge_cost(low, high, means, covs, weights, log_dets)
    alive = np.flatnonzero(weights > 0.0)
    weights = weights[alive] / weights[alive].sum()
    return means[alive], covs[alive], np.log(weights)


@kernel
def _update_group(
    means: Array, covs: Array, log_weights: Array, rows: Array, height_m: float, gate_nis: Array
) -> tuple[Array, Array, Array, float, bool]:
    """The mixture after one measurement, the NIS of its most probable component, and whether the
    measurement was taken by most of the mixture."""
    count, n = means.shape
    size = 0
    split = np.empty(count, dtype=np.bool_)
    for k in range(count):
        split[k] = splits(rows, means[k], covs[k], height_m)
        size += _RING_MAX + 1 if split[k] else 1
    new_means, new_covs, new_logs = np.empty((size, n)), np.empty((size, n, n)), np.empty(size)
    h = np.empty(n)
    end, taken_weight, refused_weight, nis, best = 0, 0.0, 0.0, 0.0, -math.inf
    top = log_weights.max()
    for k in range(count):
        first = end
        if split[k]:
            row = rows[0]
            value = innovation_row(row, means[k], height_m, h)
            one = (
                value
                * value
                / innovation_variance(row, means[k], covs[k], height_m, row[VARIANCE], h)
            )
            ring = split_along_ring(means[k], covs[k], row, height_m)
            end += ring[2].size
            new_means[first:end], new_covs[first:end], new_logs[first:end] = ring
            taken = True
        else:
            new_means[end], new_covs[end] = means[k], covs[k]
            new_logs[end], one, taken = _update_component(
                new_means[end], new_covs[end], rows, height_m, gate_nis
            )
            end += 1
        for c in range(first, end):
            new_logs[c] += log_weights[k]
            if not taken:
                refused_weight += math.exp(new_logs[c] - top)
                continue
            taken_weight += math.exp(new_logs[c] - top)
            if new_logs[c] > best:
                best, nis = new_logs[c], one
        if split[k]:  # the component itself, to which the measurement is an outlier
            new_means[end], new_covs[end] = means[k], covs[k]
            new_logs[end] = log_weights[k] + _outlier_log(rows)
            refused_weight += math.exp(new_logs[end] - top)
            end += 1
    means, covs, logs = reduced(new_means[:end], new_covs[:end], new_logs[:end])
    return means, covs, logs, nis, bool(taken_weight > refused_weight)


@kernel
def update(
    means: Array,
    covs: Array,
    log_weights: Array,
    rows: Array,
    height_m: float,
    gate_nis: Array,
    accepted: Array,
) -> tuple[Array, Array, Array, float, int]:
    """One epoch, measurement by measurement: the mixture after it, the NIS of what was accepted
    and its degrees of freedom.

    rows : (m, ROW_WIDTH), groups numbered 0, 1, ...
    gate_nis : as for ``ekf.update``, for each component alone
    accepted : (groups,), filled with 1 where most of the mixture takes the group, else 0
    """
    nis, dof, start = 0.0, 0, 0
    logs = log_weights
    while start < rows.shape[0]:
        group = int(rows[start, GROUP])
        stop = start + 1
        while stop < rows.shape[0] and int(rows[stop, GROUP]) == group:
            stop += 1
        means, covs, logs, one, taken = _update_group(
            means, covs, logs, rows[start:stop], height_m, gate_nis
        )
        accepted[group] = 1.0 if taken else 0.0
        if taken:
            nis, dof = nis + one, dof + stop - start
        start = stop
    return means, covs, logs, nis, dof


@kernel
def predict(means: Array, covs: Array, dt: float, motion: Array, bias: Array) -> None:
    """Move every component by ``dt`` seconds in place; arguments as for ``ekf.predict``."""
    for k in range(means.shape[0]):
        ekf.predict(means[k], covs[k], dt, motion, bias)


@kernel
def mode_of(means: Array, covs: Array, log_weights: Array) -> Ints:
    """Number of the mode (K,) each component belongs to, 0 the mode of the most probable one.

    Components belong to one mode where a chain of them leads from one to the other, each within
    3 sd (of both together) of the next.
    """
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
