"""The measurements of an epoch one after the other: where one divides a component
(``mixture.splits``), each measurement makes components of its own."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.engine import EpochInput, FilterOptions
from netpos.estimation.measurement import BLOCKED, GROUP, linearise
from netpos.estimation.mixture.candidates import (
    Candidates,
    Update,
    apply,
    candidates,
    first_of,
    mixture_of,
)
from netpos.estimation.mixture.common_error import add_common_errors, most_common_errors
from netpos.estimation.mixture.gaussians import Mixture, together
from netpos.estimation.mixture.reduction import PART_MERGE_COST, reduced
from netpos.estimation.mixture.splits.choice import (
    WHOLE,
    add_candidates,
    most_candidates,
    split_of,
)
from netpos.estimation.mixture.splits.paths import late_row, reweight_by_best
from netpos.estimation.mixture.turns import (
    EXPLANATIONS_MAX,
    add_explanations,
    may_turn,
    open_time_s,
    turned,
)
from netpos.estimation.sensors.row import group_count, group_end
from netpos.estimation.update.conditioning import by_path
from netpos.estimation.update.fusion import predicted_in, workspace
from netpos.estimation.update.predicted import predict_rows
from netpos.messages.values import Array


@kernel
def _add_candidates(
    split: int,
    k: int,
    end: int,
    prior: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    found: Candidates,
) -> int:
    """Add the candidates of the component ``k`` for one measurement, and explanations where the
    first of them refuses it; the number of candidates then."""
    rows, first, work = epoch.rows, end, workspace(prior.means.shape[1], epoch.rows.shape[0])
    mean, cov = prior.means[k], prior.covs[k]
    if split == WHOLE:
        found.means[end], found.covs[end] = mean, cov
        apply(end, prior.log_weights[k], rows, options, found, work)
        end += 1
    else:
        end = add_candidates(split, k, end, prior, rows, options, found)
    if found.accepted[first, 0] == 0.0 and options.manoeuvre_speed_sd > 0.0:
        predicted = predicted_in(work, mean.size, rows.shape[0])
        predict_rows(mean, cov, rows, options.height_m, predicted)
        end = add_explanations(k, first, end, prior, epoch, options, found, work)
        end = add_common_errors(k, first, end, prior, rows, options, found)
    return int(end)


@kernel
def _explained(
    prior: Mixture, count: int, single: EpochInput, within_s: float, options: FilterOptions
) -> Candidates:
    """The candidates of one measurement: of the first ``count`` components of ``prior``, and of
    the others, which turned in the last ``within_s`` seconds."""
    rows, parts = single.rows, prior.log_weights.size
    splits, size = np.empty(parts, dtype=np.int64), 0
    for k in range(parts):
        splits[k] = split_of(rows, prior.means[k], prior.covs[k], options)
        size += most_candidates(splits[k]) + EXPLANATIONS_MAX + most_common_errors(rows.shape[0])
    found = candidates(size, prior.means.shape[1], 1)
    end = np.int64(0)  # no literal: it would make another version of each kernel below
    for k in range(parts):
        first = end
        end = _add_candidates(splits[k], k, end, prior, single, options, found)
        if k >= count:
            found.within_s[first:end] = within_s
    trimmed: Candidates = first_of(found, end)
    return trimmed


@kernel
def in_turn(
    components: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    accepted: Array,
) -> Update:
    """The epoch, measurement by measurement; each is ``accepted`` where most of the mixture does.
    Where paths may be blocked the rows of the epoch are re-weighted in place as the most probable
    component predicts them, for who reads them later; BLOCKED becomes the probability that the
    mixture gives."""
    raw, nis, used, start = epoch.rows.copy(), 0.0, 0, 0
    has_turned, longest_s, may_be_blocked = 0.0, 0.0, options.robust.nlos_probability > 0.0
    if may_be_blocked:
        reweight_by_best(components, epoch.rows, options.height_m, by_path(options.robust))
    best, groups = int(np.argmax(components.log_weights)), group_count(raw)
    outliers = np.zeros(groups)
    _, H = linearise(raw, components.means[best], options.height_m)
    begins = may_turn(H, groups, epoch.open_s, options)
    within_s = open_time_s(epoch)
    while start < raw.shape[0]:
        group, stop = int(raw[start, GROUP]), group_end(raw, start)
        alone = raw[start:stop].copy()
        alone[:, GROUP] = 0.0
        single = EpochInput(
            epoch.dt_s, epoch.unheard_s, epoch.open_s, epoch.rejected_in_row, alone
        )
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
            outliers[group] = 1.0 - (weights * taken).sum()
            accepted[group] = 1.0 if outliers[group] < 0.5 else 0.0
            best = int(np.argmax(np.where(taken == accepted[group], weights, -1.0)))
            nis, used = nis + found.nis[best], used + int(found.used[best])
            has_turned = max(has_turned, weights[found.within_s > 0.0].sum())
            longest_s = max(longest_s, found.within_s.max())
            late = late_row(alone) if may_be_blocked else -1
            if late >= 0:
                epoch.rows[start + late, BLOCKED] = (weights * found.blocked).sum()
            components = reduced(mixture_of(found), PART_MERGE_COST)
        start = stop
    return Update(components, nis, used, outliers, has_turned, longest_s, begins)
