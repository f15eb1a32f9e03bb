"""A range or time that meets a wide prior: its likelihood is a ring, and the ring is a sum of
Gaussians along it, each short enough for the tangent to hold (Alspach and Sorenson 1972; along the
direction of greatest curvature, Tuggle and Zanetti 2018)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import EpochInput, FilterOptions
from netpos.estimation.measurement import (
    ORIGIN,
    VALUE,
    VARIANCE,
    curvature_variance,
    innovation_row,
    is_range,
    offset_up,
)
from netpos.estimation.mixture.candidates import Candidates
from netpos.estimation.mixture.gaussians import CURVATURE_SHARE, SPACING_SD, Mixture, fuse_value
from netpos.estimation.mixture.outliers import outlier_log
from netpos.estimation.mixture.reduction import PART_MERGE_COST
from netpos.estimation.mixture.splits.paths import fuse_by, paths_in, paths_of
from netpos.estimation.mixture.splits.split import Split
from netpos.estimation.update.predicted import PredictedRows, predicted_rows
from netpos.messages.values import Array

_VELOCITY_END = 4  # position and velocity come first
# A component is split where it is too long, or reaches the RSU within so many sd; narrower
# components (m) never are.
_REACH_SD, _NARROW_M = 3.0, 1.0
_DIRECT, _BLOCKED, _EITHER = range(3)  # ways of a range
_END_SD = 6.0  # where a component ends along a ring: what lies beyond is pruned
_RING_MIN, _RING_MAX = 12, 128


@leaf
def _own_variance(row: Array, cov: Array, h: Array) -> float:
    """Variance of a row without that of position and velocity: noise, clock and slow errors."""
    total = row[VARIANCE]
    for a in range(_VELOCITY_END, cov.shape[0]):
        for b in range(_VELOCITY_END, cov.shape[0]):
            total += h[a] * cov[a, b] * h[b]
    return float(total)


@leaf
def is_wide(row: Array, h: Array, mean: Array, cov: Array, options: FilterOptions) -> bool:
    """Whether a component is to be split for the row of a range or time of arrival, with the
    Jacobian ``h`` (n,): it narrows the position, but its tangent does not hold over the
    component's width."""
    width2 = cov[0, 0] + cov[1, 1]
    if width2 < _NARROW_M * _NARROW_M:
        return False
    own = _own_variance(row, cov, h)
    if own > width2:
        return False
    if curvature_variance(row, mean, cov, options.height_m) > CURVATURE_SHARE * own:
        return True
    dx, dy = mean[0] - row[ORIGIN], mean[1] - row[ORIGIN + 1]
    return bool(_REACH_SD * _REACH_SD * width2 > dx * dx + dy * dy)


@leaf
def _is_range_alone(rows: Array) -> bool:
    """Whether the ``rows`` of one measurement are a range or a time alone: an angle measured with
    it tells where on the ring the device is."""
    return rows.shape[0] == 1 and bool(is_range(rows[0]))


@kernel
def divides(rows: Array, mean: Array, cov: Array, options: FilterOptions) -> bool:
    """Whether the ``rows`` of one measurement are a range alone that ``is_wide``."""
    if not _is_range_alone(rows):
        return False
    h = np.empty(mean.size)
    innovation_row(rows[0], mean, options.height_m, h)
    return bool(is_wide(rows[0], h, mean, cov, options))


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
    count = int(min(max(wanted, _RING_MIN), _RING_MAX))
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
def _add_pieces(
    prior: Mixture,
    k: int,
    row: Array,
    way: int,
    excess: float,
    end: int,
    options: FilterOptions,
    found: Candidates,
) -> int:
    """Add the component ``k`` of ``prior``, cut along the ring of a range that is ``excess`` [m]
    too long, with the range fused as one that came this ``way``; the number of candidates then."""
    shorter, log_weight = row.copy(), prior.log_weights[k]
    shorter[VALUE] -= excess
    pieces = cut_along_ring(prior.means[k], prior.covs[k], shorter, options.height_m)
    for i in range(pieces.innovation.size):
        mean, cov, h = found.means[end], found.covs[end], pieces.H[i]
        mean[:], cov[:] = pieces.components.means[i], pieces.components.covs[i]
        innovation, known_var = pieces.innovation[i] + excess, float(h @ cov @ h)
        paths = paths_of(row, innovation, known_var, options.robust)
        path = paths.direct
        if way != _DIRECT:
            path = paths.blocked if way == _BLOCKED else paths.either
        variance = known_var + row[VARIANCE]
        fits = -0.5 * (innovation**2 / variance + math.log(2.0 * math.pi * variance))
        own_log = log_weight + pieces.components.log_weights[i]
        found.log_weights[end] = own_log + fits + path.log
        found.nis[end] = fuse_by(path, mean, cov, h, innovation, row[VARIANCE])
        found.accepted[end], found.used[end], found.blocked[end] = 1.0, 1.0, path.blocked
        end += 1
    return int(end)


@kernel
def add(
    k: int, end: int, prior: Mixture, rows: Array, options: FilterOptions, found: Candidates
) -> int:
    """Add the candidates of the component ``k`` along the ring of a range, those along that of a
    blocked path, or one for both where that costs nothing, and the component itself, to which the
    range is an outlier; the number of candidates then."""
    row, mean, cov, log_weight = rows[0], prior.means[k], prior.covs[k], prior.log_weights[k]
    predicted = predicted_rows(mean, cov, rows, options.height_m)
    paths = paths_in(0, rows, predicted, options.robust)
    if math.exp(log_weight) * paths.cost > PART_MERGE_COST:
        late_m = paths.blocked.excess
        end = _add_pieces(prior, k, row, _DIRECT, 0.0, end, options, found)
        end = _add_pieces(prior, k, row, _BLOCKED, late_m, end, options, found)
    else:
        end = _add_pieces(prior, k, row, _EITHER, 0.0, end, options, found)
    found.means[end], found.covs[end] = mean, cov
    found.log_weights[end] = log_weight + paths.direct.log + outlier_log(rows, predicted, 0, 1)
    return int(end + 1)


@leaf
def begins(
    start: int,
    stop: int,
    epoch: EpochInput,
    predicted: PredictedRows,
    mean: Array,
    cov: Array,
    options: FilterOptions,
) -> bool:
    """Whether the measurement in the rows ``start`` to ``stop`` of ``epoch`` divides the track:
    after a silence, or a turn that opened a direction that ranges hardly measure."""
    rows = epoch.rows[start:stop]
    if not _is_range_alone(rows):
        return False
    return bool(is_wide(rows[0], predicted.H[start], mean, cov, options))


SPLIT = Split(divides=divides, add=add, most=2 * _RING_MAX + 1, begins=begins)
