"""A path that may be blocked: a range is direct or late, and each is a component where one
Gaussian for both loses much."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.conditioning import RobustOptions, may_be_late, reweight
from netpos.estimation.engine import EpochInput, FilterOptions, is_sound
from netpos.estimation.fusion import predicted_in, workspace
from netpos.estimation.measurement import BLOCKED, GROUP, VARIANCE, linearise
from netpos.estimation.mixture.candidates import (
    Candidates,
    Update,
    apply,
    apply_predicted,
    candidates,
    first_of,
    log_likelihood,
)
from netpos.estimation.mixture.gaussians import Mixture, fuse_value
from netpos.estimation.mixture.reduction import reduced
from netpos.estimation.mixture.ring import RING_MERGE_COST
from netpos.estimation.mixture.turns import add_explanations, may_turn, turn
from netpos.estimation.predicted import PredictedRows, predict_rows, predicted_rows
from netpos.estimation.robust import blocked_excess, matching_cost
from netpos.estimation.sensors.row import group_end
from netpos.messages.values import Array


@kernel
def reweight_by_best(
    components: Mixture, rows: Array, height_m: float, robust: RobustOptions
) -> None:
    """Re-weight ``rows`` in place as the most probable component predicts them."""
    best = int(np.argmax(components.log_weights))
    mean, cov = components.means[best], components.covs[best]
    reweight(cov, rows, predicted_rows(mean, cov, rows, height_m), robust)


@kernel
def _late_row(rows: Array) -> int:
    """The row of one measurement that a blocked path makes late; -1 for none or several."""
    found = -1
    for i in range(rows.shape[0]):
        if may_be_late(rows[i]):
            if found >= 0:
                return -1
            found = i
    return found


class _Path(NamedTuple):
    """A late row seen from a component: log probability of a direct and of a blocked path before
    it and, after it, by how much a blocked one is likelier (log), the probability of a blocked
    path, mean and variance of its excess, and what one Gaussian for both paths costs."""

    direct_log: float
    blocked_log: float
    likelier: float
    blocked: float
    excess: float
    excess_var: float
    cost: float


@kernel
def _path(i: int, rows: Array, predicted: PredictedRows, robust: RobustOptions) -> _Path:
    """What a component says of the late row ``rows[i]``, as it ``predicted`` that."""
    row, innovation = rows[i], predicted.innovation[i]
    variance = row[VARIANCE] + predicted.prior_var[i] + predicted.second_order_var[i]
    share = row[BLOCKED] if row[BLOCKED] > 0.0 else robust.nlos_probability
    share = min(max(share, 1e-9), 1.0 - 1e-9)
    likelier, excess, excess_var = blocked_excess(innovation, variance, robust.nlos_excess_m)
    odds = math.exp(min(math.log(share / (1.0 - share)) + likelier, 700.0))
    blocked = odds / (1.0 + odds)
    cost = matching_cost(blocked, excess, excess_var, variance, row[VARIANCE])
    return _Path(
        math.log(1.0 - share), math.log(share), likelier, blocked, excess, excess_var, cost
    )


@kernel
def _fuse_blocked(
    mean: Array, cov: Array, i: int, rows: Array, predicted: PredictedRows, path: _Path
) -> float:
    """Fuse the range ``rows[i]`` of a blocked path in place, by the moments of its excess; its
    NIS."""
    n, innovation = mean.size, predicted.innovation[i] - path.excess
    noise = rows[i, VARIANCE] + predicted.second_order_var[i]
    variance = noise + predicted.prior_var[i]
    gain = predicted.HP[i, :n] / variance
    fuse_value(mean, cov, predicted.H[i, :n].copy(), innovation, noise)
    cov += np.outer(gain, gain) * path.excess_var
    return float(innovation * innovation / variance)


@kernel
def paths_are_open(rows: Array, predicted: PredictedRows, options: FilterOptions) -> bool:
    """Whether for a late range of ``rows``, as they are ``predicted``, a direct and a blocked path
    make two components."""
    start = 0
    while start < rows.shape[0]:
        stop = group_end(rows, start)
        late = _late_row(rows[start:stop])
        if late >= 0:
            path = _path(start + late, rows, predicted, options.robust)
            if path.cost > RING_MERGE_COST:
                return True
        start = stop
    return False


@kernel
def _both_paths(
    k: int,
    end: int,
    late: int,
    prior: Mixture,
    rows: Array,
    options: FilterOptions,
    found: Candidates,
    blocked: Array,
) -> int:
    """Add the candidates of the component ``k``: the path of the row ``late`` of one measurement
    is direct, and it is blocked, or both as one where that costs nothing; their probabilities of a
    ``blocked`` path. The number of candidates then."""
    mean, cov, log_weight = prior.means[k], prior.covs[k], prior.log_weights[k]
    work = workspace(mean.size, rows.shape[0])
    predicted = predicted_in(work, mean.size, rows.shape[0])
    predict_rows(mean, cov, rows, options.height_m, predicted)
    path = _path(late, rows, predicted, options.robust)
    several = math.exp(log_weight) * path.cost > RING_MERGE_COST
    found.means[end], found.covs[end] = mean, cov
    everything = np.ones(1)  # of the one measurement, whatever the gate says
    likelihood = log_weight + log_likelihood(
        mean, cov, rows, options.height_m, predicted, everything
    )
    if not several:
        read = rows.copy()
        reweight(cov, read, predicted, options.robust)
        apply_predicted(end, log_weight, read, options, options.gate_nis, found, work)
        if found.accepted[end, 0] == 1.0 and math.isfinite(found.log_weights[end]):
            late_log = path.blocked_log + path.likelier
            smaller = math.exp(-abs(late_log - path.direct_log))
            both_log = max(late_log, path.direct_log) + math.log1p(smaller)
            found.log_weights[end] = likelihood + both_log
        blocked[end] = path.blocked
        return end + 1
    direct_log = log_weight + path.direct_log
    apply_predicted(end, direct_log, rows, options, options.gate_nis, found, work)
    blocked[end] = 0.0
    found.means[end + 1], found.covs[end + 1] = mean, cov
    nis = _fuse_blocked(found.means[end + 1], found.covs[end + 1], late, rows, predicted, path)
    found.accepted[end + 1, 0], found.used[end + 1], found.within_s[end + 1] = 1.0, 0.0, 0.0
    if rows.shape[0] > 1:
        others = np.concatenate((rows[:late], rows[late + 1 :]))
        apply(end + 1, log_weight, others, options, found, work)
    found.nis[end + 1] += nis
    found.used[end + 1] += 1.0
    sound = is_sound(found.means[end + 1], found.covs[end + 1])
    found.log_weights[end + 1] = (
        likelihood + path.blocked_log + path.likelier if sound else -math.inf
    )
    blocked[end + 1] = 1.0
    return end + 2


@kernel
def _add_paths(
    components: Mixture,
    epoch: EpochInput,
    late: int,
    options: FilterOptions,
    found: Candidates,
    blocked: Array,
) -> int:
    """Fill ``found``, and the probabilities of a ``blocked`` path, with the candidates of all
    components for one measurement, of which the row ``late`` may be late (-1: none): the number of
    candidates."""
    end = np.int64(0)  # no literal: it would make another version of each kernel below
    m, n = epoch.rows.shape[0], components.means.shape[1]
    work = workspace(n, m)
    for k in range(components.log_weights.size):
        first, mean, cov = end, components.means[k], components.covs[k]
        if late >= 0:
            end = _both_paths(k, end, late, components, epoch.rows, options, found, blocked)
        else:
            found.means[end], found.covs[end] = mean, cov
            apply(end, components.log_weights[k], epoch.rows, options, found, work)
            end += 1
        if found.accepted[first, 0] == 0.0 and options.manoeuvre_speed_sd > 0.0:
            if late >= 0:
                predicted = predicted_in(work, n, m)
                predict_rows(mean, cov, epoch.rows, options.height_m, predicted)
            end = add_explanations(k, first, end, components, epoch, options, found, work)
    return int(end)


@kernel
def along_paths(
    components: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    open_s: float,
    accepted: Array,
) -> Update:
    """Measurement by measurement, where paths may be blocked. The rows of the epoch are
    re-weighted in place as the most probable component predicts them, for who reads them later;
    BLOCKED becomes the probability that the mixture gives."""
    raw, nis, used, start, turns = epoch.rows.copy(), 0.0, 0, 0, False
    turned, longest_s = 0.0, 0.0
    reweight_by_best(components, epoch.rows, options.height_m, options.robust)
    while start < raw.shape[0]:
        group, stop = int(raw[start, GROUP]), group_end(raw, start)
        alone = raw[start:stop].copy()
        alone[:, GROUP] = 0.0
        late = _late_row(alone)
        single = EpochInput(epoch.dt_s, epoch.unheard_s, epoch.rejected_in_row, alone)
        count, n = components.means.shape
        found = candidates(4 * count + 1, n, 1)
        blocked = np.zeros(4 * count + 1)
        end = _add_paths(components, single, late, options, found, blocked)
        best = int(np.argmax(components.log_weights))
        if stop == raw.shape[0]:
            _, H = linearise(raw, components.means[best], options.height_m)
            turns = may_turn(H, group + 1, open_s, options)
        if turns:
            within_s = max(open_s, epoch.unheard_s)
            turn(end, components, best, within_s, alone, options, found)
            end += 1
        best = int(np.argmax(found.log_weights[:end]))
        top = found.log_weights[best]
        accepted[group] = found.accepted[best, 0] if math.isfinite(top) else 0.0
        if math.isfinite(top):
            weights = np.exp(found.log_weights[:end] - top)
            weights /= weights.sum()
            turned = max(turned, weights[found.within_s[:end] > 0.0].sum())
            longest_s = max(longest_s, found.within_s[:end].max())
            if late >= 0:
                epoch.rows[start + late, BLOCKED] = (weights * blocked[:end]).sum()
            nis, used = nis + found.nis[best], used + int(found.used[best])
            components = reduced(first_of(found, end), RING_MERGE_COST)
        start = stop
    return Update(components, nis, used, turned, longest_s, turns)
