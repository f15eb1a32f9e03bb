"""A path that may be blocked: a range is direct or late, and each is a component where one
Gaussian for both loses much."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import EpochInput, FilterOptions, is_sound
from netpos.estimation.measurement import BLOCKED, VARIANCE, same_bend_variance
from netpos.estimation.mixture.candidates import (
    Candidates,
    apply,
    apply_predicted,
    log_likelihood,
)
from netpos.estimation.mixture.gaussians import Mixture, fuse_value
from netpos.estimation.mixture.reduction import PART_MERGE_COST
from netpos.estimation.mixture.splits.split import Split
from netpos.estimation.update.conditioning import RobustOptions, by_path, may_be_late, reweight
from netpos.estimation.update.fusion import predicted_in, workspace
from netpos.estimation.update.predicted import PredictedRows, predict_rows, predicted_rows
from netpos.estimation.update.robust import blocked_excess, matching_cost, mixed_excess
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
def late_row(rows: Array) -> int:
    """The row of one measurement that a blocked path makes late; -1 for none or several."""
    found = -1
    for i in range(rows.shape[0]):
        if may_be_late(rows[i]):
            if found >= 0:
                return -1
            found = i
    return found


class Path(NamedTuple):
    """A way a late row may have come: its log likelihood over that of a direct path known to be
    one, the probability of a blocked path, mean [m] and variance [m^2] of the excess."""

    log: float
    blocked: float
    excess: float
    excess_var: float


class Paths(NamedTuple):
    """A late row seen from a component: by a direct path, by a blocked one, by either as one
    Gaussian, and what that costs."""

    direct: Path
    blocked: Path
    either: Path
    cost: float


@kernel
def paths_of(row: Array, innovation: float, known_var: float, robust: RobustOptions) -> Paths:
    """What a component says of a late ``row``: its innovation, of which it explains
    ``known_var``."""
    if robust.nlos_probability <= 0.0:
        direct = Path(0.0, 0.0, 0.0, 0.0)
        return Paths(direct, Path(-math.inf, 1.0, 0.0, 0.0), direct, 0.0)
    variance = row[VARIANCE] + known_var
    share = row[BLOCKED] if row[BLOCKED] > 0.0 else robust.nlos_probability
    share = min(max(share, 1e-9), 1.0 - 1e-9)
    likelier, excess, excess_var = blocked_excess(innovation, variance, robust.nlos_excess_m)
    direct = Path(math.log(1.0 - share), 0.0, 0.0, 0.0)
    blocked = Path(math.log(share) + likelier, 1.0, excess, excess_var)
    smaller = math.exp(-abs(blocked.log - direct.log))
    either_log = max(blocked.log, direct.log) + math.log1p(smaller)
    both = mixed_excess(math.exp(blocked.log - either_log), excess, excess_var)
    either = Path(either_log, both[0], both[1], both[2])
    cost = matching_cost(both[0], excess, excess_var, variance, row[VARIANCE])
    return Paths(direct, blocked, either, cost)


@kernel
def fuse_by(
    path: Path, mean: Array, cov: Array, h: Array, innovation: float, variance: float
) -> float:
    """Fuse a range that came by ``path`` in place, by the moments of its excess: Jacobian h (n,),
    ``innovation`` [m] and ``variance`` of the row; its NIS."""
    Ph = cov @ h
    total = float(h @ Ph) + variance
    fuse_value(mean, cov, h, innovation - path.excess, variance)
    cov += np.outer(Ph, Ph) * (path.excess_var / (total * total))
    return float((innovation - path.excess) ** 2 / total)


@kernel
def paths_in(i: int, rows: Array, predicted: PredictedRows, robust: RobustOptions) -> Paths:
    """``paths_of`` the row ``rows[i]`` for a component that ``predicted`` the rows."""
    known_var = predicted.prior_var[i] + predicted.second_order_var[i]
    paths: Paths = paths_of(rows[i], predicted.innovation[i], known_var, robust)
    return paths


@kernel
def divides(rows: Array, _mean: Array, _cov: Array, options: FilterOptions) -> bool:
    """Whether one of the ``rows`` of one measurement may have come by a blocked path."""
    return bool(options.robust.nlos_probability > 0.0 and late_row(rows) >= 0)


@kernel
def add(
    k: int, end: int, prior: Mixture, rows: Array, options: FilterOptions, found: Candidates
) -> int:
    """Add the candidates of the component ``k``: the path of the late row of one measurement is
    direct, and it is blocked, or both as one where that costs nothing; the number of candidates
    then."""
    late = late_row(rows)
    mean, cov, log_weight = prior.means[k], prior.covs[k], prior.log_weights[k]
    work = workspace(mean.size, rows.shape[0])
    predicted = predicted_in(work, mean.size, rows.shape[0])
    predict_rows(mean, cov, rows, options.height_m, predicted)
    paths = paths_in(late, rows, predicted, options.robust)
    several = math.exp(log_weight) * paths.cost > PART_MERGE_COST
    found.means[end], found.covs[end] = mean, cov
    everything = np.ones(1)  # of the one measurement, whatever the gate says
    likelihood = log_weight + log_likelihood(
        mean, cov, rows, options.height_m, predicted, everything
    )
    if not several:
        read = rows.copy()
        reweight(cov, read, predicted, by_path(options.robust))
        apply_predicted(end, log_weight, read, options, options.gate_nis, found, work)
        if found.accepted[end, 0] == 1.0 and math.isfinite(found.log_weights[end]):
            found.log_weights[end] = likelihood + paths.either.log
        found.blocked[end] = paths.either.blocked
        return end + 1
    direct_log = log_weight + paths.direct.log
    apply_predicted(end, direct_log, rows, options, options.gate_nis, found, work)
    found.blocked[end] = 0.0
    found.means[end + 1], found.covs[end + 1] = mean, cov
    bent = predicted.second_order_var[late]
    nis = fuse_by(
        paths.blocked,
        found.means[end + 1],
        found.covs[end + 1],
        predicted.H[late, : mean.size].copy(),
        predicted.innovation[late],
        rows[late, VARIANCE] + same_bend_variance(rows[late], mean, cov, options.height_m, bent),
    )
    found.accepted[end + 1, 0], found.used[end + 1], found.within_s[end + 1] = 1.0, 0.0, 0.0
    if rows.shape[0] > 1:
        others = np.concatenate((rows[:late], rows[late + 1 :]))
        apply(end + 1, log_weight, others, options, found, work)
    found.nis[end + 1] += nis
    found.used[end + 1] += 1.0
    sound = is_sound(found.means[end + 1], found.covs[end + 1])
    found.log_weights[end + 1] = likelihood + paths.blocked.log if sound else -math.inf
    found.blocked[end + 1] = 1.0
    return end + 2


@leaf
def begins(
    start: int,
    stop: int,
    epoch: EpochInput,
    predicted: PredictedRows,
    _mean: Array,
    _cov: Array,
    options: FilterOptions,
) -> bool:
    """Whether for the late range in the rows ``start`` to ``stop`` of ``epoch``, as they are
    ``predicted``, a direct and a blocked path make two components."""
    if options.robust.nlos_probability <= 0.0:
        return False
    late = late_row(epoch.rows[start:stop])
    if late < 0:
        return False
    cost = paths_in(start + late, epoch.rows, predicted, options.robust).cost
    return bool(cost > PART_MERGE_COST)


SPLIT = Split(divides=divides, add=add, most=2, begins=begins)
