"""A weighted sum of Gaussians over one state."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import kernel
from netpos.messages.values import Array

Ints = npt.NDArray[np.int64]

CURVATURE_SHARE = 0.05
"""A component is too long where its second-order variance is more than this share of the variance
across it."""
CURVATURE_SHARE_BLOCKED = 0.25
"""The same where a path may be blocked: components along a ring take one Gaussian for a direct and
a blocked path, which loses more than a shorter arc gains."""
SPACING_SD = 1.2
"""Of equal Gaussians side by side: their sum is flat to 1e-3."""
_APART2 = 9.0  # squared Mahalanobis distance of means from which components are two modes


class Mixture(NamedTuple):
    """Components: means (K, n), covs (K, n, n), log_weights (K,), the weights of which sum to
    one."""

    means: Array
    covs: Array
    log_weights: Array


@kernel
def one_component(mean: Array, cov: Array) -> Mixture:
    """A mixture of one component."""
    means, covs = np.empty((1, mean.size)), np.empty((1, mean.size, mean.size))
    means[0], covs[0] = mean, cov
    return Mixture(means, covs, np.zeros(1))


@kernel
def combine(means: Array, covs: Array, weights: Array, mean: Array, cov: Array) -> None:
    """Mean and covariance of the mixture, the spread of the means included: eq. 11.6.6-14, 15;
    written to ``mean`` (n,) and ``cov`` (n, n)."""
    count, n = means.shape
    mean[:] = 0.0
    cov[:] = 0.0
    for k in range(count):
        for a in range(n):
            mean[a] += weights[k] * means[k, a]
    for k in range(count):
        for a in range(n):
            for b in range(a + 1):
                away = (means[k, a] - mean[a]) * (means[k, b] - mean[b])
                cov[a, b] += weights[k] * (covs[k, a, b] + away)
    for a in range(n):
        for b in range(a):
            cov[b, a] = cov[a, b]


@kernel
def moments(components: Mixture) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of the mixture."""
    mean, cov = np.empty_like(components.means[0]), np.empty_like(components.covs[0])
    weights = np.exp(components.log_weights)
    combine(components.means, components.covs, weights / weights.sum(), mean, cov)
    return mean, cov


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


@kernel
def leaders(components: Mixture) -> Ints:
    """Index of the most probable component of each mode (M,), the most probable first."""
    modes = mode_of(components)
    first = np.full(modes.max() + 1, -1)
    for k in np.argsort(-components.log_weights):
        if first[modes[k]] < 0:
            first[modes[k]] = k
    return first


@kernel
def fuse_value(mean: Array, cov: Array, h: Array, residual: float, variance: float) -> float:
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
