"""A weighted sum of Gaussians over one state."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import kernel, leaf
from netpos.messages.values import Array

Ints = npt.NDArray[np.int64]

CURVATURE_SHARE = 0.05
"""A component is too long where its second-order variance is more than this share of the variance
across it."""
SPACING_SD = 1.2
"""Of equal Gaussians side by side: their sum is flat to 1e-3."""
LEAST_DENSITY_LOG = -4.5
"""Log density of a Gaussian at 3 sd, over that at its mean."""
_APART2 = -2.0 * LEAST_DENSITY_LOG  # squared Mahalanobis distance there
# Added to each variance, m^2 and as a share of both: one that is nothing cannot be inverted.
_LEAST_VARIANCE = 1e-12
_NOTHING_LOG = 40.0  # what is smaller by that is nothing beside it


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
def together(first: Mixture, second: Mixture) -> Mixture:
    """The components of both, with the weights they have."""
    return Mixture(
        np.concatenate((first.means, second.means)),
        np.concatenate((first.covs, second.covs)),
        np.concatenate((first.log_weights, second.log_weights)),
    )


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


@leaf
def _log_sum(terms: Array) -> float:
    """Log of the sum of values given by their logs."""
    top, total = -math.inf, 0.0
    for term in terms:
        top = max(top, term)
    for term in terms:
        if term > top - _NOTHING_LOG:
            total += math.exp(term - top)
    return float(top + math.log(total))


@kernel
def log_densities(components: Mixture, at: Array) -> Array:
    """Log density (P,) [1/m^2] of the mixture at positions ``at`` (P, 2) [m], without the term
    -log(2 pi)."""
    means, covs, log_weights = components
    count = log_weights.size
    inverses, tops = np.empty((count, 3)), np.empty(count)
    for k in range(count):
        xx, xy, yy = covs[k, 0, 0], covs[k, 0, 1], covs[k, 1, 1]
        least = _LEAST_VARIANCE * (1.0 + xx + yy)
        xx, yy = xx + least, yy + least
        det = xx * yy - xy * xy
        inverses[k, 0], inverses[k, 1], inverses[k, 2] = yy / det, -xy / det, xx / det
        tops[k] = log_weights[k] - 0.5 * math.log(det)
    found, terms = np.empty(at.shape[0]), np.empty(count)
    for i in range(at.shape[0]):
        for k in range(count):
            dx, dy = at[i, 0] - means[k, 0], at[i, 1] - means[k, 1]
            along, cross, across = inverses[k]
            away2 = along * dx * dx + 2.0 * cross * dx * dy + across * dy * dy
            terms[k] = tops[k] - 0.5 * away2
        found[i] = _log_sum(terms)
    return found


@leaf
def _are_near(i: int, j: int, means: Array, covs: Array) -> bool:
    """Whether two components lie within 3 sd, of both together, of one another."""
    dx, dy = means[j, 0] - means[i, 0], means[j, 1] - means[i, 1]
    xx, yy = covs[i, 0, 0] + covs[j, 0, 0], covs[i, 1, 1] + covs[j, 1, 1]
    xy, least = covs[i, 0, 1] + covs[j, 0, 1], _LEAST_VARIANCE * (1.0 + xx + yy)
    xx, yy = xx + least, yy + least
    away2 = yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy
    return bool(away2 < _APART2 * (xx * yy - xy * xy))


@kernel
def _peak_of(components: Mixture) -> Ints:
    """Component (K,) at which the mode that each belongs to has its peak."""
    means, covs = components.means, components.covs
    density = log_densities(components, means[:, :2])
    peaks = np.full(density.size, -1)
    for i in np.argsort(-density):
        own = i
        for j in range(density.size):
            higher = peaks[j] >= 0 and (own == i or density[peaks[j]] > density[own])
            if higher and _are_near(i, j, means, covs):
                own = peaks[j]
        peaks[i] = own
        for j in range(density.size):
            other = peaks[j]
            if other < 0 or other == own or density[other] - density[i] > -LEAST_DENSITY_LOG:
                continue
            if _are_near(i, j, means, covs):
                peaks[peaks == other] = own
    return peaks


@kernel
def mode_of(components: Mixture) -> Ints:
    """Number of the mode (K,) each component belongs to, 0 the mode of the most probable one.

    Components within 3 sd (of both together) of one another belong to one mode, unless they join
    two peaks over a valley: the density there, over that at the lower peak, is less than what a
    Gaussian has at 3 sd (Chazal, Guibas, Oudot and Skraba 2013: clusters by their prominence).
    """
    peaks = _peak_of(components)
    modes, found = np.full(peaks.size, -1), 0
    for first in np.argsort(-components.log_weights):
        if modes[first] < 0:
            modes[peaks == peaks[first]] = found
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
