"""A range or time that meets a wide prior: its likelihood is a ring, and the ring is a sum of
Gaussians along it, each short enough for the tangent to hold (Alspach and Sorenson 1972; along the
direction of greatest curvature, Tuggle and Zanetti 2018)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import FilterOptions
from netpos.estimation.measurement import (
    ORIGIN,
    VARIANCE,
    curvature_variance,
    innovation_row,
    is_range,
    offset_up,
)
from netpos.estimation.mixture.gaussians import CURVATURE_SHARE, SPACING_SD, Mixture, fuse_value
from netpos.estimation.sensors.row import group_end
from netpos.messages.values import Array

_VELOCITY_END = 4  # position and velocity come first
# A component is split where it is too long, or reaches the RSU within so many sd; narrower
# components (m) never are.
_REACH_SD, _NARROW_M = 3.0, 1.0
_END_SD = 6.0  # where a component ends along a ring: what lies beyond is pruned
_RING_MIN, RING_MAX = 12, 128
RING_MERGE_COST = 2e-4  # divergence (Runnalls' bound) that merging parts of a ring may cost


@kernel
def _own_variance(row: Array, cov: Array, h: Array) -> float:
    """Variance of a row without that of position and velocity: noise, clock and slow errors."""
    total = row[VARIANCE]
    for a in range(_VELOCITY_END, cov.shape[0]):
        for b in range(_VELOCITY_END, cov.shape[0]):
            total += h[a] * cov[a, b] * h[b]
    return float(total)


@kernel
def is_wide(row: Array, mean: Array, cov: Array, options: FilterOptions) -> bool:
    """Whether a component is to be split for a row: a range or time of arrival that narrows the
    position, but whose tangent does not hold over the component's width."""
    width2 = cov[0, 0] + cov[1, 1]
    if not is_range(row) or width2 < _NARROW_M * _NARROW_M:
        return False
    h = np.empty(mean.size)
    innovation_row(row, mean, options.height_m, h)
    own = _own_variance(row, cov, h)
    if own > width2:
        return False
    if curvature_variance(row, mean, cov, options.height_m) > CURVATURE_SHARE * own:
        return True
    dx, dy = mean[0] - row[ORIGIN], mean[1] - row[ORIGIN + 1]
    return bool(_REACH_SD * _REACH_SD * width2 > dx * dx + dy * dy)


@kernel
def splits(rows: Array, mean: Array, cov: Array, options: FilterOptions) -> bool:
    """Whether the ``rows`` of one measurement split a component: a range alone that ``is_wide``.
    An angle measured with it tells where on the ring the device is."""
    return bool(rows.shape[0] == 1 and is_wide(rows[0], mean, cov, options))


@leaf
def _half_angle(distance_m: float, cov: Array) -> float:
    """Half of the angle in which a component of ``cov`` (n, n) is seen from an RSU
    ``distance_m`` from its mean; all around where it reaches the RSU."""
    reach = _END_SD * math.sqrt(cov[0, 0] + cov[1, 1])
    return math.asin(reach / distance_m) if reach < distance_m else math.pi


class Pieces(NamedTuple):
    """A component cut along the ring of a range: what it says of each piece before the range is
    fused, the log weights not normalised; Jacobian (K, n) and innovation (K,) of the range at the
    piece, linearised on the ring."""

    components: Mixture
    H: Array
    innovation: Array


@kernel
def cut_along_ring(mean: Array, cov: Array, row: Array, height_m: float) -> Pieces:
    """The Gaussian ``mean`` (n,), ``cov`` (n, n) times Gaussians along the ring of a range or time
    of arrival, side by side as far as it reaches."""
    n = mean.size
    h, at, along = np.empty(n), mean.copy(), np.zeros(n)
    residual = innovation_row(row, mean, height_m, h)
    dx, dy = mean[0] - row[ORIGIN], mean[1] - row[ORIGIN + 1]
    dz = offset_up(row, mean, height_m)
    slant = math.sqrt(dx * dx + dy * dy + dz * dz) + residual  # measured, less clock and biases
    own = _own_variance(row, cov, h)
    radius = math.sqrt(max(slant * slant - dz * dz, 0.25 * own, 1e-4))
    towards, half = math.atan2(dy, dx), _half_angle(math.hypot(dx, dy), cov)
    sd = math.sqrt(radius * math.sqrt(2.0 * CURVATURE_SHARE * own))  # no longer than that
    wanted = math.ceil(2.0 * half * radius / (SPACING_SD * sd))
    count = int(min(max(wanted, _RING_MIN), RING_MAX))
    arc = 2.0 * half * radius / count
    sd = arc / SPACING_SD
    bend = 0.5 * sd * sd / math.hypot(radius, dz)
    means, covs, logs = np.empty((count, n)), np.empty((count, n, n)), np.empty(count)
    H, innovation = np.empty((count, n)), np.empty(count)
    for k in range(count):
        angle = towards + half * ((2.0 * k + 1.0) / count - 1.0)
        c, s = math.cos(angle), math.sin(angle)
        at[0], at[1] = row[ORIGIN] + radius * c, row[ORIGIN + 1] + radius * s
        means[k], covs[k] = mean, cov
        along[0], along[1] = -s, c
        residual = c * (at[1] - mean[1]) - s * (at[0] - mean[0])
        logs[k] = math.log(arc) + fuse_value(means[k], covs[k], along, residual, sd * sd)
        # A Gaussian along the tangent is outside of the ring.
        innovation[k] = innovation_row(row, at, height_m, H[k]) - bend
        innovation[k] -= H[k] @ (means[k] - at)
    return Pieces(Mixture(means, covs, logs), H, innovation)


@kernel
def any_splits(components: Mixture, rows: Array, options: FilterOptions) -> bool:
    """Whether a range of ``rows`` splits a component along its ring."""
    start = 0
    while start < rows.shape[0]:
        stop = group_end(rows, start)
        for k in range(components.log_weights.size):
            mean, cov = components.means[k], components.covs[k]
            if splits(rows[start:stop], mean, cov, options):
                return True
        start = stop
    return False
