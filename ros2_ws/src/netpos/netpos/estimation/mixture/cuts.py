"""A component over whose width a measurement bends: it is cut into a row of shorter ones."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import innovation_row, is_range, second_order_variance
from netpos.estimation.mixture.gaussians import Mixture, fuse_value, one_component
from netpos.estimation.mixture.ring import NARROW_M, SPACING_SD, WIDE
from netpos.messages.values import Array

# An azimuth: to where the sd along its ray is a tenth of the distance (Peach 1995), once that is
# so much more that the parts do not exceed it at once.
_RAY, _RAY_MARGIN = 0.02, 0.5
_CUTS_MAX = 64
_LEAST_WEIGHT = 1e-8  # of a component at the ends
_CUT_WEIGHT = 1e-3  # components of less are not cut: their parts would merge again


@kernel
def _bend(row: Array, mean: Array, cov: Array, height_m: float) -> float:
    """Second-order variance of a row over the largest that is straight enough: a share of the
    variance that the position has along the row's gradient. Above 1 the tangent does not hold
    over the component's width, however exact the measurement."""
    if cov[0, 0] + cov[1, 1] < NARROW_M * NARROW_M:
        return 0.0
    h = np.empty(mean.size)
    innovation_row(row, mean, height_m, h)
    straight = 0.0
    for a in range(2):
        for b in range(2):
            straight += h[a] * cov[a, b] * h[b]
    share = WIDE if is_range(row) else _RAY
    return float(second_order_variance(row, mean, cov, height_m) / max(share * straight, 1e-300))


@kernel
def cut_length(rows: Array, mean: Array, cov: Array, height_m: float) -> float:
    """Share of its sd along its widest axis to which a component is to be cut for ``rows`` to be
    straight over its parts; 1 where they are."""
    share = 1.0
    for i in range(rows.shape[0]):
        bend = _bend(rows[i], mean, cov, height_m)
        if bend > 1.0:  # in a range the width counts to the fourth power, in an azimuth squared
            share = min(share, bend**-0.25 if is_range(rows[i]) else (bend / _RAY_MARGIN) ** -0.5)
    return max(share, 0.1)


@kernel
def cut(mean: Array, cov: Array, share: float) -> Mixture:
    """The Gaussian mean (n,), cov (n, n) as a row of Gaussians along the axis along which its
    position is widest, each of ``share`` < 1 of the sd: its products with Gaussians that add up
    to a constant."""
    n, along = mean.size, np.zeros(mean.size)
    half = 0.5 * math.atan2(2.0 * cov[0, 1], cov[0, 0] - cov[1, 1])
    along[0], along[1] = math.cos(half), math.sin(half)
    variance = float(along @ cov @ along)
    sd = math.sqrt(variance / (1.0 / (share * share) - 1.0))
    reach = math.sqrt(-2.0 * math.log(_LEAST_WEIGHT) * (variance + sd * sd))
    side = int(min(math.ceil(reach / (SPACING_SD * sd)), _CUTS_MAX))
    count = 2 * side + 1
    means, covs, logs = np.empty((count, n)), np.empty((count, n, n)), np.empty(count)
    for k in range(count):
        means[k], covs[k] = mean, cov
        away = (k - side) * SPACING_SD * sd
        logs[k] = math.log(SPACING_SD * sd) + fuse_value(means[k], covs[k], along, away, sd * sd)
    return Mixture(means, covs, logs)


@kernel
def is_bent(rows: Array, mean: Array, cov: Array, height_m: float) -> bool:
    """Whether one of ``rows`` (m, ROW_WIDTH) bends over the Gaussian mean (n,), cov (n, n)."""
    return bool(cut_length(rows, mean, cov, height_m) < 1.0)


@kernel
def straightened(components: Mixture, rows: Array, height_m: float) -> Mixture:
    """The components, those that weigh something cut so short that ``rows`` (m, ROW_WIDTH) are
    straight over each (``cut``)."""
    count, n = components.means.shape
    least_log_weight = math.log(_CUT_WEIGHT)
    parts = np.empty(count)
    for k in range(count):
        parts[k] = 1.0
        if components.log_weights[k] >= least_log_weight:
            mean, cov = components.means[k], components.covs[k]
            parts[k] = cut_length(rows, mean, cov, height_m)
    if parts.min() == 1.0:
        return components
    means, covs, logs = np.empty((0, n)), np.empty((0, n, n)), np.empty(0)
    for k in range(count):
        piece = one_component(components.means[k], components.covs[k])
        if parts[k] < 1.0:
            piece = cut(components.means[k], components.covs[k], parts[k])
        means = np.concatenate((means, piece.means))
        covs = np.concatenate((covs, piece.covs))
        logs = np.concatenate((logs, piece.log_weights + components.log_weights[k]))
    return Mixture(means, covs, logs)
