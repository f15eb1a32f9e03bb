"""Sectors of a phase difference: a phase is known but for whole turns, and every number of turns
is a component (petukhov:eq.9, 10)."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import FilterOptions
from netpos.estimation.fixes.phase_fix import (
    TWO_PI,
    admissible,
    init_hypothesis,
    nearest_turns,
    phase_scale,
    to_fix,
)
from netpos.estimation.measurement import (
    GROUP,
    KIND,
    VALUE,
    VARIANCE,
    Kind,
    innovation_row,
    innovation_variance,
    predict_row,
)
from netpos.estimation.mixture.candidates import Candidates, apply, apply_predicted
from netpos.estimation.mixture.gaussians import Ints, Mixture
from netpos.estimation.mixture.reduction import LEAST_WEIGHT, reduced
from netpos.estimation.update.fusion import predicted_in, workspace
from netpos.estimation.update.predicted import predict_rows
from netpos.messages.values import Array

_UNWRAPPED = float(Kind.UNWRAPPED_PHASE)
_WIDE_RAD = 1.0  # a component that knows the phase less well takes the fix itself
_NEGLIGIBLE = 60.0  # squared distance of a number of turns that a component does not explain
_LEAST_SHARE = 0.01  # of ``sector_slip``: a component less probable is dropped


@leaf
def phase_place(rows: Array) -> int:
    """Index of the first phase in ``rows`` (m, ROW_WIDTH) with a range of the same measurement
    just before it; -1: there is none."""
    for i in range(1, rows.shape[0]):
        ranged = int(rows[i - 1, KIND]) == Kind.RANGE and rows[i - 1, GROUP] == rows[i, GROUP]
        if ranged and int(rows[i, KIND]) == Kind.PHASE:
            return i
    return -1


@leaf
def ambiguous_phase(rows: Array, options: FilterOptions) -> int:
    """``phase_place`` where an estimate has a component for each sector, else -1."""
    place: int = phase_place(rows) if options.sector_slip > 0.0 else -1
    return place


@leaf
def most_turns(phase: Array) -> int:
    """Largest number of turns a phase row may have, with what noise adds."""
    return math.ceil(float(phase_scale(phase)) / TWO_PI + 0.5)


@kernel
def _unwrapped(rows: Array, at: int, turns: int) -> Array:
    """``rows`` with the phase ``rows[at]`` in the sector of ``turns``."""
    own = rows.copy()
    own[at, KIND] = _UNWRAPPED
    own[at, VALUE] += TWO_PI * turns
    return own


@kernel
def sectors_of_fix(
    mean: Array, cov: Array, rows: Array, at: int, options: FilterOptions
) -> Mixture:
    """A component in every sector of the phase ``rows[at]``, as probable as its area is large, the
    other states from mean (n,), cov (n, n); none where range and phase have no place."""
    n, most = mean.size, most_turns(rows[at])
    size = 2 * most + 1
    means, covs, logs = np.empty((size, n)), np.empty((size, n, n)), np.empty(size)
    end, top = 0, -math.inf
    for turns in range(-most, most + 1):
        means[end], covs[end] = mean, cov
        logs[end] = init_hypothesis(
            means[end],
            covs[end],
            rows[at - 1],
            rows[at],
            turns,
            options.initial_speed_sd,
            options.height_m,
        )
        if logs[end] > -math.inf:
            top = max(top, logs[end])
            end += 1
    logs = logs[:end]
    if end > 0:
        logs -= top + math.log(np.exp(logs - top).sum())
    return Mixture(means[:end], covs[:end], logs)


@kernel
def _take_turns(
    c: int,
    prior: Mixture,
    parent: int,
    turns: int,
    rows: Array,
    at: int,
    options: FilterOptions,
    found: Candidates,
) -> None:
    """Make the candidate ``c`` from the component ``parent`` of ``prior``, the phase ``rows[at]``
    having so many ``turns``. A component that knows the phase badly takes the fix itself, whose
    density is that of range and phase but for the area."""
    mean, cov, height_m = prior.means[parent], prior.covs[parent], options.height_m
    own, log_weight = _unwrapped(rows, at, turns), prior.log_weights[parent]
    work = workspace(mean.size, rows.shape[0])
    predicted = predicted_in(work, mean.size, rows.shape[0])
    predict_rows(mean, cov, own, height_m, predicted)
    phase_var = predicted.prior_var[at] + predicted.second_order_var[at]
    found.means[c], found.covs[c] = mean, cov
    if phase_var <= _WIDE_RAD * _WIDE_RAD or not to_fix(own, at, mean, height_m):
        apply_predicted(c, log_weight, own, options, options.gate_nis, found, work)
    else:
        apply(c, log_weight, own, options, found, work)
        found.log_weights[c] -= 0.5 * math.log(rows[at, VARIANCE] * rows[at - 1, VARIANCE])


@kernel
def add_turns_of_phase(
    k: int,
    end: int,
    prior: Mixture,
    rows: Array,
    at: int,
    options: FilterOptions,
    found: Candidates,
) -> int:
    """Make the candidate ``k`` from the component ``k`` of ``prior`` and the number of turns
    nearest to its prediction, and one at the end for each other number that explains the phase
    ``rows[at]``; the number of candidates then."""
    mean, cov, height_m = prior.means[k], prior.covs[k], options.height_m
    h, own, group = np.empty(mean.size), _unwrapped(rows, at, 0)[at], int(rows[at, GROUP])
    innovation = innovation_row(own, mean, height_m, h)
    variance = innovation_variance(own, mean, cov, height_m, rows[at, VARIANCE], h)
    nearest, most = nearest_turns(rows[at], -innovation), most_turns(rows[at])
    _take_turns(k, prior, k, nearest, rows, at, options, found)
    for turns in range(-most, most + 1):
        off = innovation + TWO_PI * turns
        if turns == nearest or off * off > _NEGLIGIBLE * variance:
            continue
        if not admissible(rows[at], turns):
            continue
        _take_turns(end, prior, k, turns, rows, at, options, found)
        if found.accepted[end, group] == 1.0:
            end += 1
    return int(end)


@kernel
def turns_of(means: Array, phase: Array, height_m: float) -> Ints:
    """Number of turns (K,) that a phase row has in each state of ``means`` (K, n)."""
    h, turns = np.empty(means.shape[1]), np.empty(means.shape[0], dtype=np.int64)
    unwrapped = phase.copy()
    unwrapped[KIND] = _UNWRAPPED
    for k in range(turns.size):
        turns[k] = round((predict_row(unwrapped, means[k], height_m, h) - phase[VALUE]) / TWO_PI)
    return turns


@kernel
def _place(
    k: int,
    prior: Mixture,
    parent: int,
    own: Array,
    at: int,
    options: FilterOptions,
    found: Candidates,
) -> bool:
    """Make the candidate ``k`` from the component ``parent`` of ``prior``, placed anew by range
    and phase, ``own[at - 1]`` and ``own[at]``, and updated with the rest; False where they have no
    place."""
    mean, cov, group = found.means[k], found.covs[k], int(own[at, GROUP])
    mean[:], cov[:] = prior.means[parent], prior.covs[parent]
    speed, height_m = options.initial_speed_sd, options.height_m
    if init_hypothesis(mean, cov, own[at - 1], own[at], 0, speed, height_m) == -math.inf:
        return False
    rest = own[own[:, GROUP] != group]
    found.accepted[k] = 1.0
    found.used[k], found.within_s[k] = 0.0, 0.0
    if rest.shape[0] > 0:
        apply(k, 0.0, rest, options, found, workspace(mean.size, rest.shape[0]))
        found.accepted[k, group] = 1.0
    return True


@kernel
def keep_sectors(
    prior: Mixture,
    parent: int,
    end: int,
    rows: Array,
    at: int,
    options: FilterOptions,
    found: Candidates,
) -> int:
    """Let no sector of the phase ``rows[at]`` be less probable than ``sector_slip``, the
    probability that the estimate has slipped unnoticed: its candidates weigh more, or one is
    placed anew by range and phase, its other states from the component ``parent``. Nothing happens
    where the most probable candidate refuses them. The number of candidates then."""
    group, best = int(rows[at, GROUP]), int(np.argmax(found.log_weights[:end]))
    top = found.log_weights[best]
    if found.accepted[best, group] == 0.0 or top == -math.inf:
        return end
    weights = np.exp(found.log_weights[:end] - top)
    least = options.sector_slip * weights.sum()
    weights[found.accepted[:end, group] == 0.0] = 0.0
    own_turns = turns_of(found.means[:end], rows[at], options.height_m)
    most = most_turns(rows[at])
    for turns in range(-most, most + 1):
        there = np.flatnonzero((own_turns == turns) & (weights > 0.0))
        total = weights[there].sum()
        if total >= least or not admissible(rows[at], turns):
            continue
        if total > 0.0:
            for k in there:
                found.log_weights[k] += math.log(least / total)
        elif _place(end, prior, parent, _unwrapped(rows, at, turns), at, options, found):
            found.log_weights[end] = top + math.log(least)
            end += 1
    return int(end)


@kernel
def reduced_by_sector(
    components: Mixture, rows: Array, at: int, merge_cost: float, options: FilterOptions
) -> Mixture:
    """As ``reduced``, but components of different sectors of the phase ``rows[at]`` stay apart:
    rivals are improbable, and merging them with each other would cost nothing. Sectors without
    weight are dropped."""
    means, covs = np.empty_like(components.means), np.empty_like(components.covs)
    weights = np.exp(components.log_weights - components.log_weights.max())
    weights /= weights.sum()
    logs, end = np.empty_like(weights), 0
    turns = turns_of(components.means, rows[at], options.height_m)
    least = min(LEAST_WEIGHT, _LEAST_SHARE * options.sector_slip)
    for sector in np.unique(turns):
        own = np.flatnonzero(turns == sector)
        total = weights[own].sum()
        if total < least:
            continue
        some = Mixture(components.means[own], components.covs[own], components.log_weights[own])
        part = reduced(some, merge_cost / total)
        stop = end + part.log_weights.size
        means[end:stop], covs[end:stop] = part.means, part.covs
        logs[end:stop] = part.log_weights + math.log(total)
        end = stop
    return Mixture(means[:end], covs[:end], logs[:end] - math.log(np.exp(logs[:end]).sum()))
