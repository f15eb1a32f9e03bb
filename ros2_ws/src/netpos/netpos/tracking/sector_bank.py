"""A bank of filters, one per sector of a phase difference's ambiguity, compiled.

Slot s of a bank of S slots holds the device where the phase has M = s - S // 2 whole turns
(petukhov:eq.9, 10); an empty slot has a log weight of -inf. Every epoch with a phase is an exact
step of the Bayes filter for a wrapped phase, kept to one Gaussian per sector: each filter gives
its likelihood of every number of turns, the weights of a sector add up, and its heir is the filter
that contributes most. So neighbouring sectors are always there to take over: a weight never falls
below a floor, the probability that the estimate has slipped unnoticed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation import engine
from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import FilterOptions, cov_of
from netpos.estimation.factor import factor
from netpos.estimation.forms.choice import write_cov_or_sqrt, write_sqrt
from netpos.estimation.gate import accepted_rows, gate_groups
from netpos.estimation.measurement import GROUP, KIND, VALUE, VARIANCE, Kind
from netpos.estimation.sensors.row import group_end
from netpos.estimation.sigma import innovation_cov, regress
from netpos.messages.values import Array
from netpos.tracking.phase_fix import TWO_PI, admissible, init_hypothesis, nearest_turns, to_fix

Ints = npt.NDArray[np.int64]

_WRAPPED, _UNWRAPPED = float(Kind.PHASE), float(Kind.UNWRAPPED_PHASE)
_WIDE_RAD = 1.0  # a filter that knows the phase less well is moved to the fix itself
_NEGLIGIBLE = 60.0  # squared distance of a number of turns that a filter does not explain


class Bank(NamedTuple):
    """S slots: means (S, n), covariances or their factors (S, n, n), log weights (S,)."""

    means: Array
    covs_or_sqrts: Array
    weights: Array


class BankResult(NamedTuple):
    """What came of an epoch in every slot: groups accepted (S, groups), NIS (S,), rows used
    (S,)."""

    accepted: Array
    nis: Array
    used: Array


@kernel
def _evidence(rows: Array, innovation: Array, S: Array, gate: Array, accepted: Array) -> float:
    """Log likelihood of the rows but for a constant.

    A rejected group counts as one at its gate: an outlier costs every hypothesis the same and
    decides nothing.
    """
    gate_groups(rows, innovation, S, gate, accepted)
    index = accepted_rows(rows, accepted)
    block = np.empty((index.size, index.size))
    rest = innovation[index]
    for i in range(index.size):
        for j in range(index.size):
            block[i, j] = S[index[i], index[j]]
    L = factor(block)
    total = 0.0
    for i in range(index.size):
        for k in range(i):
            rest[i] -= L[i, k] * rest[k]
        rest[i] /= L[i, i]
        total += rest[i] * rest[i] + 2.0 * math.log(L[i, i])
    start = 0
    while start < rows.shape[0]:
        group, stop = int(rows[start, GROUP]), group_end(rows, start)
        if accepted[group] == 0.0:
            total += gate[min(stop - start, gate.size - 1)]
            L = factor(S[start:stop, start:stop].copy())
            for i in range(stop - start):
                total += 2.0 * math.log(L[i, i])
        start = stop
    return -0.5 * total


@kernel
def advance(
    bank: Bank,
    dt: float,
    velocity_step_sd: float,
    unheard_s: float,
    motion: Array,
    bias: Array,
    options: FilterOptions,
) -> None:
    """Move every filter by ``dt`` seconds; ``velocity_step_sd`` > 0 opens the velocities."""
    means, covs_or_sqrts, weights = bank
    for s in range(weights.size):
        if weights[s] > -math.inf:
            engine.predict(means[s], covs_or_sqrts[s], dt, motion, bias, options)
            if velocity_step_sd > 0.0:
                engine.open_velocity(covs_or_sqrts[s], velocity_step_sd, unheard_s, options)


@kernel
def _factor_of(cov_or_sqrt: Array, options: FilterOptions) -> Array:
    L = np.empty_like(cov_or_sqrt)
    write_sqrt(options.filter, cov_or_sqrt, L)
    return L


@kernel
def update(
    bank: Bank, rows: Array, options: FilterOptions, result: BankResult, work: Array
) -> None:
    """An epoch without an ambiguous phase: every filter takes the rows, weights follow; ``result``
    is filled."""
    means, covs_or_sqrts, weights = bank
    accepted, nis, used = result
    for s in range(weights.size):
        if weights[s] == -math.inf:
            continue
        L = _factor_of(covs_or_sqrts[s], options)
        innovation, G, E = regress(means[s], L, rows, options.height_m)
        S = innovation_cov(G, E, rows[:, VARIANCE].copy())
        weights[s] += _evidence(rows, innovation, S, options.gate_nis, accepted[s])
        nis[s], used[s] = engine.update(
            means[s], covs_or_sqrts[s], rows, options, accepted[s], work
        )
    normalise(weights, 0.0)


@leaf
def normalise(weights: Array, floor: float) -> None:
    """Log weights (S,) that sum to one, in place, none that is there below ``floor``."""
    top = -math.inf
    for s in range(weights.size):
        top = max(top, weights[s])
    for _ in range(2):
        total = 0.0
        for s in range(weights.size):
            total += math.exp(weights[s] - top)
        for s in range(weights.size):
            if weights[s] > -math.inf:
                weights[s] -= top + math.log(total)
                if floor > 0.0:
                    weights[s] = max(weights[s], math.log(floor))
        top = 0.0


@kernel
def resolve(
    bank: Bank,
    rows: Array,
    at: int,
    options: FilterOptions,
    floor: float,
    parent_index: Ints,
    result: BankResult,
    work: Array,
) -> None:
    """An epoch whose row ``at`` is an ambiguous phase and ``at - 1`` the range of the same array.

    parent_index (S,) : filled with the slot each filter comes from, -1 for one that was put where
        the measurements say; result : filled
    """
    means, covs_or_sqrts, weights = bank
    accepted, nis, used = result
    rows[at, KIND] = _UNWRAPPED
    gains, wide = _gains(bank, rows, at, options)
    old_means, old_cov_or_sqrt = means.copy(), covs_or_sqrts.copy()
    _inherit(gains, weights, rows[at], floor, parent_index)
    nis[:], used[:], accepted[:] = 0.0, 0.0, 0.0
    leader = int(np.argmax(weights))
    group = int(rows[at, GROUP])
    own = rows.copy()
    for k in range(weights.size):
        j = leader if k == 0 else (k - 1 if k <= leader else k)
        if weights[j] == -math.inf:
            continue
        _unwrap(rows, at, j - weights.size // 2, own)
        parent = int(parent_index[j])
        if parent >= 0:
            means[j], covs_or_sqrts[j] = old_means[parent], old_cov_or_sqrt[parent]
            if wide[parent] > 0.0:
                to_fix(own, at, means[j], options.height_m)
            nis[j], used[j] = engine.update(
                means[j], covs_or_sqrts[j], own, options, accepted[j], work
            )
        lost = parent < 0 or accepted[j, group] == 0.0
        if j != leader and lost and accepted[leader, group] == 1.0:
            means[j], covs_or_sqrts[j] = (
                old_means[parent_index[leader]],
                old_cov_or_sqrt[parent_index[leader]],
            )
            _unwrap(rows, at, j - weights.size // 2, own)
            parent_index[j] = -1
            if not _start_over(means[j], covs_or_sqrts[j], own, at, options, accepted[j], work):
                weights[j] = -math.inf
        elif parent < 0:
            weights[j] = -math.inf
    normalise(weights, floor)
    rows[at, KIND] = _WRAPPED


@kernel
def _unwrap(rows: Array, at: int, turns: int, own: Array) -> None:
    """``own`` becomes ``rows`` with the phase ``rows[at]`` in the sector of ``turns``."""
    own[:] = rows
    own[at, VALUE] += TWO_PI * turns


@kernel
def _start_over(
    mean: Array,
    cov_or_sqrt: Array,
    own: Array,
    at: int,
    options: FilterOptions,
    accepted: Array,
    work: Array,
) -> bool:
    """Place a filter anew by range and phase and update it with the rest; False where they have no
    place."""
    if not _put(mean, cov_or_sqrt, own, at, options):
        return False
    _take_rest(mean, cov_or_sqrt, own, int(own[at, GROUP]), options, accepted, work)
    return True


@kernel
def _gains(bank: Bank, rows: Array, at: int, options: FilterOptions) -> tuple[Array, Array]:
    """Log weight of every number of turns (columns) as each filter (rows) has it, (S, S); and 1
    for a filter that knows the phase too badly for a tangent, (S,)."""
    means, covs_or_sqrts, weights = bank
    count, gate = weights.size, options.gate_nis
    gains, wide = np.full((count, count), -math.inf), np.zeros(count)
    flags = np.zeros(int(rows[rows.shape[0] - 1, GROUP]) + 1)
    for i in range(count):
        if weights[i] == -math.inf:
            continue
        L = _factor_of(covs_or_sqrts[i], options)
        innovation, G, E = regress(means[i], L, rows, options.height_m)
        S = innovation_cov(G, E, rows[:, VARIANCE].copy())
        raw = innovation[at]
        nearest = nearest_turns(rows[at], -raw)
        if S[at, at] - rows[at, VARIANCE] > _WIDE_RAD * _WIDE_RAD:
            wide[i] = 1.0
        for j in range(count):
            turns = j - count // 2
            off = raw + TWO_PI * turns
            far = turns != nearest and off * off > _NEGLIGIBLE * S[at, at]
            if far or not admissible(rows[at], turns):
                continue
            if wide[i] > 0.0:
                gains[i, j] = weights[i] + _fix_evidence(means[i], L, rows, at, turns, options)
            else:
                innovation[at] = off
                gains[i, j] = weights[i] + _evidence(rows, innovation, S, gate, flags)
    return gains, wide


@kernel
def _fix_evidence(
    mean: Array, L: Array, rows: Array, at: int, turns: int, options: FilterOptions
) -> float:
    """Log likelihood of the rows with range and phase taken as the fix they give."""
    own = np.empty_like(rows)
    _unwrap(rows, at, turns, own)
    if not to_fix(own, at, mean, options.height_m):
        return -math.inf
    innovation, G, E = regress(mean, L, own, options.height_m)
    S = innovation_cov(G, E, own[:, VARIANCE].copy())
    flags = np.zeros(int(rows[rows.shape[0] - 1, GROUP]) + 1)
    like = _evidence(own, innovation, S, options.gate_nis, flags)
    return float(like - 0.5 * math.log(rows[at, VARIANCE] * rows[at - 1, VARIANCE]))


@kernel
def _inherit(gains: Array, weights: Array, phase: Array, floor: float, parent_index: Ints) -> None:
    """Weights (S,) of the sectors and the filter each inherits: the one that gives it most."""
    top = gains.max()
    for j in range(weights.size):
        parent_index[j], weights[j] = -1, -math.inf
        if not admissible(phase, j - weights.size // 2):
            continue
        best = int(np.argmax(gains[:, j]))
        if gains[best, j] > -math.inf:
            total = 0.0
            for i in range(weights.size):
                total += math.exp(gains[i, j] - gains[best, j])
            weights[j] = gains[best, j] + math.log(total)
            parent_index[j] = best
        else:
            weights[j] = top + math.log(floor)


@kernel
def _put(mean: Array, cov_or_sqrt: Array, own: Array, at: int, options: FilterOptions) -> bool:
    """Place a filter anew where range and phase ``own[at - 1]``, ``own[at]`` say."""
    cov = cov_of(cov_or_sqrt, options)
    speed, height = options.initial_speed_sd, options.height_m
    if init_hypothesis(mean, cov, own[at - 1], own[at], 0, speed, height) == -math.inf:
        return False
    write_cov_or_sqrt(options.filter, cov, cov_or_sqrt)
    return True


@kernel
def _take_rest(
    mean: Array,
    cov_or_sqrt: Array,
    own: Array,
    group: int,
    options: FilterOptions,
    accepted: Array,
    work: Array,
) -> None:
    """Update a filter just placed by ``group`` with the other groups."""
    index = np.flatnonzero(own[:, GROUP] != group)
    accepted[:] = 1.0
    if index.size > 0:
        flags = np.zeros(accepted.size)
        engine.update(mean, cov_or_sqrt, own[index], options, flags, work)
        for g in range(accepted.size):
            accepted[g] = 1.0 if g == group else flags[g]


@kernel
def combine(bank: Bank, options: FilterOptions) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of the whole bank."""
    means, covs_or_sqrts, weights = bank
    n = means.shape[1]
    mean, cov = np.zeros(n), np.zeros((n, n))
    for s in range(weights.size):
        if weights[s] > -math.inf:
            mean += math.exp(weights[s]) * means[s]
    for s in range(weights.size):
        if weights[s] > -math.inf:
            P = cov_of(covs_or_sqrts[s], options)
            w = math.exp(weights[s])
            for a in range(n):
                for b in range(n):
                    apart = (means[s, a] - mean[a]) * (means[s, b] - mean[b])
                    cov[a, b] += w * (P[a, b] + apart)
    return mean, cov
