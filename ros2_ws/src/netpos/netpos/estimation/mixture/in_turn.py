"""The measurements of an epoch one after the other: where a range is a ring to a component, or its
path may be blocked, each measurement makes components of its own."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.engine import EpochInput, FilterOptions
from netpos.estimation.fusion import predicted_in, workspace
from netpos.estimation.measurement import BLOCKED, GROUP, VALUE, VARIANCE, linearise
from netpos.estimation.mixture.candidates import (
    Candidates,
    Update,
    apply,
    candidates,
    first_of,
    mixture_of,
    outlier_log,
)
from netpos.estimation.mixture.gaussians import Mixture, together
from netpos.estimation.mixture.paths import (
    add_both_paths,
    fuse_by,
    late_row,
    paths_in,
    paths_of,
    reweight_by_best,
)
from netpos.estimation.mixture.reduction import reduced
from netpos.estimation.mixture.ring import RING_MAX, RING_MERGE_COST, cut_along_ring, splits
from netpos.estimation.mixture.turns import TURNS_MAX, add_explanations, may_turn, turned
from netpos.estimation.predicted import predict_rows, predicted_rows
from netpos.estimation.sensors.row import group_end
from netpos.messages.values import Array

_DIRECT, _BLOCKED, _EITHER = range(3)  # ways of a range
_CANDIDATES = 3 + TURNS_MAX  # of a component that no ring splits: two paths, explanations


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
def _add_ring(
    k: int, end: int, prior: Mixture, rows: Array, options: FilterOptions, found: Candidates
) -> int:
    """Add the candidates of the component ``k`` along the ring of a range, those along that of a
    blocked path, or one for both where that costs nothing, and the component itself, to which the
    range is an outlier; the number of candidates then."""
    row, mean, cov, log_weight = rows[0], prior.means[k], prior.covs[k], prior.log_weights[k]
    predicted = predicted_rows(mean, cov, rows, options.height_m)
    paths = paths_in(0, rows, predicted, options.robust)
    if math.exp(log_weight) * paths.cost > RING_MERGE_COST:
        late_m = paths.blocked.excess
        end = _add_pieces(prior, k, row, _DIRECT, 0.0, end, options, found)
        end = _add_pieces(prior, k, row, _BLOCKED, late_m, end, options, found)
    else:
        end = _add_pieces(prior, k, row, _EITHER, 0.0, end, options, found)
    found.means[end], found.covs[end] = mean, cov
    found.log_weights[end] = log_weight + paths.direct.log + outlier_log(rows, predicted, 0, 1)
    return int(end + 1)


@kernel
def _add_candidates(
    k: int, end: int, prior: Mixture, epoch: EpochInput, options: FilterOptions, found: Candidates
) -> int:
    """Add the candidates of the component ``k``, which no ring splits, for one measurement; the
    number of candidates then."""
    rows, first, work = epoch.rows, end, workspace(prior.means.shape[1], epoch.rows.shape[0])
    mean, cov = prior.means[k], prior.covs[k]
    late = late_row(rows) if options.robust.nlos_probability > 0.0 else -1
    if late >= 0:
        end = add_both_paths(k, end, late, prior, rows, options, found)
    else:
        found.means[end], found.covs[end] = mean, cov
        apply(end, prior.log_weights[k], rows, options, found, work)
        end += 1
    if found.accepted[first, 0] == 0.0 and options.manoeuvre_speed_sd > 0.0:
        if late >= 0:
            predicted = predicted_in(work, mean.size, rows.shape[0])
            predict_rows(mean, cov, rows, options.height_m, predicted)
        end = add_explanations(k, first, end, prior, epoch, options, found, work)
    return int(end)


@kernel
def _explained(
    prior: Mixture, count: int, single: EpochInput, within_s: float, options: FilterOptions
) -> Candidates:
    """The candidates of one measurement: of the first ``count`` components of ``prior``, and of
    the others, which turned in the last ``within_s`` seconds."""
    rows, parts = single.rows, prior.log_weights.size
    rings = np.zeros(parts, dtype=np.bool_)
    for k in range(parts):
        rings[k] = splits(rows, prior.means[k], prior.covs[k], options)
    size = _CANDIDATES * parts + 2 * RING_MAX * int(rings.sum())
    found = candidates(size, prior.means.shape[1], 1)
    end = np.int64(0)  # no literal: it would make another version of each kernel below
    for k in range(parts):
        first = end
        if rings[k]:
            end = _add_ring(k, end, prior, rows, options, found)
        else:
            end = _add_candidates(k, end, prior, single, options, found)
        if k >= count:
            found.within_s[first:end] = within_s
    trimmed: Candidates = first_of(found, end)
    return trimmed


@kernel
def in_turn(
    components: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    open_s: float,
    accepted: Array,
) -> Update:
    """The epoch, measurement by measurement; each is ``accepted`` where most of the mixture does.
    Where paths may be blocked the rows of the epoch are re-weighted in place as the most probable
    component predicts them, for who reads them later; BLOCKED becomes the probability that the
    mixture gives."""
    raw, nis, used, start = epoch.rows.copy(), 0.0, 0, 0
    has_turned, longest_s, may_be_blocked = 0.0, 0.0, options.robust.nlos_probability > 0.0
    if may_be_blocked:
        reweight_by_best(components, epoch.rows, options.height_m, options.robust)
    best, groups = int(np.argmax(components.log_weights)), int(raw[raw.shape[0] - 1, GROUP]) + 1
    _, H = linearise(raw, components.means[best], options.height_m)
    begins, within_s = may_turn(H, groups, open_s, options), max(open_s, epoch.unheard_s)
    while start < raw.shape[0]:
        group, stop = int(raw[start, GROUP]), group_end(raw, start)
        alone = raw[start:stop].copy()
        alone[:, GROUP] = 0.0
        single = EpochInput(epoch.dt_s, epoch.unheard_s, epoch.rejected_in_row, alone)
        prior, count = components, components.log_weights.size
        if begins and stop == raw.shape[0]:
            best = int(np.argmax(components.log_weights))
            prior = together(components, turned(components, best, within_s, options))
        found = _explained(prior, count, single, within_s, options)
        top, taken = found.log_weights.max(), found.accepted[:, 0]
        accepted[group] = 0.0
        if math.isfinite(top):
            weights = np.exp(found.log_weights - top)
            weights /= weights.sum()
            accepted[group] = 1.0 if 2.0 * (weights * taken).sum() > 1.0 else 0.0
            best = int(np.argmax(np.where(taken == accepted[group], weights, -1.0)))
            nis, used = nis + found.nis[best], used + int(found.used[best])
            has_turned = max(has_turned, weights[found.within_s > 0.0].sum())
            longest_s = max(longest_s, found.within_s.max())
            late = late_row(alone) if may_be_blocked else -1
            if late >= 0:
                epoch.rows[start + late, BLOCKED] = (weights * found.blocked).sum()
            components = reduced(mixture_of(found), RING_MERGE_COST)
        start = stop
    return Update(components, nis, used, has_turned, longest_s, begins)
