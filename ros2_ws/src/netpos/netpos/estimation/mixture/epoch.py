"""One epoch of a mixture, compiled: move, split, update, weigh, reduce. The same kernels serve the
live track, the replay and Monte Carlo runs of thousands of routes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.conditioning import Robust, RobustOptions
from netpos.estimation.engine import (
    EpochInput,
    Epochs,
    FilterOptions,
    Run,
    Scratch,
    StepResult,
    cov_of,
    cov_or_sqrt_of,
    predict,
    scratch,
    set_velocity_step_noise,
    step,
)
from netpos.estimation.forms.choice import write_cov, write_cov_or_sqrt
from netpos.estimation.measurement import GROUP
from netpos.estimation.mixture import mixing
from netpos.estimation.mixture.candidates import (
    Candidates,
    Update,
    apply,
    candidates,
    first_of,
)
from netpos.estimation.mixture.gaussians import Mixture, leaders, moments, one_component
from netpos.estimation.mixture.paths import along_paths, paths_are_open, reweight_by_best
from netpos.estimation.mixture.reduction import reduced
from netpos.estimation.mixture.ring import any_splits, one_by_one
from netpos.estimation.mixture.sectors import (
    add_turns_of_phase,
    ambiguous_phase,
    keep_sectors,
    most_turns,
    reduced_by_sector,
)
from netpos.estimation.mixture.turns import add_explanations, may_turn, turn
from netpos.estimation.protection import mixture_radius
from netpos.messages.values import Array

_MERGE_SHARE = 0.1  # of the integrity risk: what merging two components may cost


class Dynamics(NamedTuple):
    """How a device moves between epochs: a vector of ``motion_parameters`` of each model (M,
    size), the mean time (M,) a device keeps to each of several, and sd and time constant (2, k)
    of the biases.

    One model moves all components. Of several, component k of M has the model k: its place in the
    mixture is its tag.
    """

    motions: Array
    sojourn_s: Array
    bias: Array


@kernel
def a_component_each(mean: Array, cov: Array, dynamics: Dynamics) -> Mixture:
    """A mixture with a component for each model, all alike."""
    count = dynamics.motions.shape[0]
    means, covs = np.empty((count, mean.size)), np.empty((count, mean.size, mean.size))
    for k in range(count):
        means[k], covs[k] = mean, cov
    return Mixture(means, covs, np.full(count, -math.log(count)))


@kernel
def move(components: Mixture, dt_s: float, dynamics: Dynamics, options: FilterOptions) -> Mixture:
    """The components moved by ``dt_s`` seconds; those of interacting models mix before."""
    means, covs = components.means.copy(), components.covs.copy()
    log_weights, models = components.log_weights, dynamics.motions.shape[0]
    if models > 1 and dt_s > 0.0:
        weights = np.exp(log_weights)
        passing = mixing.transition_matrix(dynamics.sojourn_s, dt_s)
        mixing.mix(means, covs, weights, passing)
        log_weights = np.log(weights)
    for k in range(means.shape[0]):
        cov_or_sqrt = cov_or_sqrt_of(covs[k], options)
        motion = dynamics.motions[k if models > 1 else 0]
        predict(means[k], cov_or_sqrt, dt_s, motion, dynamics.bias, options)
        covs[k] = cov_of(cov_or_sqrt, options)
    return Mixture(means, covs, log_weights)


@kernel
def moved_to_epoch(
    components: Mixture, epoch: EpochInput, dynamics: Dynamics, options: FilterOptions
) -> Mixture:
    """The components moved to the epoch, the rows of which are re-weighted in place as the most
    probable component predicts them; what a blocked path may be follows in ``apply_epoch``."""
    moved: Mixture = move(components, epoch.dt_s, dynamics, options)
    robust = options.robust
    if epoch.rows.shape[0] > 0 and robust.kind != Robust.NONE:
        weights = RobustOptions(robust.kind, robust.parameter, 0.0, robust.nlos_excess_m)
        reweight_by_best(moved, epoch.rows, options.height_m, weights)
    return moved


@kernel
def _add_candidates(
    k: int,
    end: int,
    prior: Mixture,
    epoch: EpochInput,
    at: int,
    options: FilterOptions,
    found: Candidates,
) -> int:
    """Make the candidate ``k`` from the component ``k`` of ``prior``, and at the end one for each
    other sector of a phase in the row ``at`` and each explanation of what is refused; the number
    of candidates then."""
    if at >= 0:
        end = add_turns_of_phase(k, end, prior, epoch.rows, at, options, found)
    else:
        found.means[k], found.covs[k] = prior.means[k], prior.covs[k]
        if options.models > 1:
            mixing.open_velocity(k, epoch, options, found)
        apply(k, prior.log_weights[k], epoch.rows, options, found)
    if options.models > 1 and found.used[k] == 0:
        found.covs[k] = prior.covs[k]
    refuses = found.accepted[k].sum() < found.accepted.shape[1]
    if refuses and options.manoeuvre_speed_sd > 0.0:
        end = add_explanations(k, k, end, prior, epoch, options, found)
    return int(end)


@kernel
def _at_once(
    prior: Mixture,
    epoch: EpochInput,
    at: int,
    options: FilterOptions,
    since_turn_s: float,
    accepted: Array,
) -> Update:
    """All measurements of the epoch, for every component of ``prior``, in every sector of an
    ambiguous phase in the row ``at`` (-1: there is none)."""
    rows = epoch.rows
    count, groups = prior.log_weights.size, int(rows[rows.shape[0] - 1, GROUP]) + 1
    sectors = 2 * most_turns(rows[at]) + 1 if at >= 0 else 0
    size = 3 * count + 1 + (sectors + 1) * (count + 1)
    found = candidates(size, prior.means.shape[1], groups)
    end = np.int64(count)
    for k in range(count):
        end = _add_candidates(k, end, prior, epoch, at, options, found)
    best = int(np.argmax(found.log_weights[:count]))
    turns = found.accepted[best, 0] == 1.0 and may_turn(
        prior.means[best], rows, since_turn_s, options
    )
    if turns:
        weighed = Mixture(prior.means, prior.covs, found.log_weights[:count])
        for k in leaders(weighed):
            turn(end, prior, k, max(since_turn_s, epoch.unheard_s), rows, options, found)
            end += 1
    if at >= 0:
        end = keep_sectors(prior, best, end, rows, at, options, found)
    best = int(np.argmax(found.log_weights[:end]))
    top = found.log_weights[best]
    if not math.isfinite(top):
        accepted[:groups] = 0.0
        return Update(prior, 0.0, 0, 0.0, 0.0, turns)
    accepted[:groups] = found.accepted[best]
    weights = np.exp(found.log_weights[:end] - top)
    turned = weights[found.within_s[:end] > 0.0].sum() / weights.sum()
    merge_cost = _MERGE_SHARE * options.integrity_risk
    if options.models > 1:
        components = mixing.one_of_each(first_of(found, end))
    elif at >= 0:
        components = reduced_by_sector(first_of(found, end), rows, at, merge_cost, options)
    else:
        components = reduced(first_of(found, end), merge_cost)
    nis, used = found.nis[best], int(found.used[best])
    return Update(components, nis, used, turned, found.within_s[:end].max(), turns)


@kernel
def is_too_wide(
    mean: Array, cov: Array, epoch: EpochInput, dynamics: Dynamics, options: FilterOptions
) -> bool:
    """Whether, after a silence, a range of the epoch splits the Gaussian mean (n,), cov (n, n)
    once it is moved to the epoch; nothing is changed."""
    if epoch.dt_s <= options.coast_after_s or epoch.rows.shape[0] == 0:
        return False
    own = Dynamics(dynamics.motions.copy(), dynamics.sojourn_s, dynamics.bias)
    moved = move(one_component(mean, cov), epoch.dt_s, own, options)
    return bool(any_splits(moved, epoch.rows, options.height_m))


@kernel
def is_not_enough(
    result: StepResult,
    mean: Array,
    epoch: EpochInput,
    since_turn_s: float,
    options: FilterOptions,
) -> bool:
    """Whether one component does not explain an epoch, of which ``engine.step`` made ``result``
    and mean (n,): something is refused, or nothing tells that the device has not turned."""
    groups = int(epoch.rows[epoch.rows.shape[0] - 1, GROUP]) + 1
    if options.manoeuvre_speed_sd <= 0.0:
        return False
    refused = result.groups < groups
    return bool(refused or may_turn(mean, epoch.rows, since_turn_s, options))


@kernel
def apply_epoch(
    components: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    since_turn_s: float,
    accepted: Array,
) -> Update:
    """The components, moved to the epoch already, after it; ``accepted`` (groups,) is filled with
    0 or 1. ``since_turn_s``: since the last component "it has turned" began."""
    rows, blocked = epoch.rows, options.robust.nlos_probability > 0.0
    at = ambiguous_phase(rows, options)
    one_model = options.models == 1 and at < 0
    splits = one_model and any_splits(components, rows, options.height_m)
    if one_model and blocked and not splits:
        found: Update = along_paths(components, epoch, options, since_turn_s, accepted)
        return found
    if blocked:
        reweight_by_best(components, rows, options.height_m, options.robust)
    if splits:
        found = one_by_one(components, rows, options, accepted)
    else:
        found = _at_once(components, epoch, at, options, since_turn_s, accepted)
    return found


@kernel
def note_turn(found: Update, motion: Array, options: FilterOptions) -> None:
    """Leave in ``motion`` the velocity step that the components of an epoch allow for, each by its
    weight (``set_velocity_step_noise``)."""
    speed_sd = options.manoeuvre_speed_sd * math.sqrt(found.turned)
    set_velocity_step_noise(motion, 0.0, 0.0, speed_sd, found.within_s)


@kernel
def _by_one(
    x: Array,
    S: Array,
    components: Mixture,
    epoch: EpochInput,
    since_turn_s: float,
    dynamics: Dynamics,
    options: FilterOptions,
    memory: Scratch,
) -> tuple[bool, Update]:
    """One epoch of the one component ``x`` (n,), ``S`` (n, n), in place: whether it does not
    explain the epoch, and then its prediction, else what came of it."""
    rows, nothing = epoch.rows, 0.0
    blocked = options.models == 1 and options.robust.nlos_probability > 0.0
    raw = rows.copy() if blocked else rows
    result = step(x, S, epoch, dynamics.motions[0], dynamics.bias, options, memory)
    more = is_not_enough(result, x, epoch, since_turn_s, options)
    if not more and blocked:
        P = cov_of(memory.prior_cov_or_sqrt, options)
        more = paths_are_open(memory.prior_mean, P, raw, options)
    if more:
        rows[:] = raw
        before = one_component(memory.prior_mean, cov_of(memory.prior_cov_or_sqrt, options))
        return True, Update(before, nothing, 0, nothing, nothing, False)
    return False, Update(components, result.nis, result.used, nothing, nothing, False)


@kernel
def _advance(
    x: Array,
    S: Array,
    components: Mixture,
    epoch: EpochInput,
    since_turn_s: float,
    dynamics: Dynamics,
    options: FilterOptions,
    memory: Scratch,
) -> Update:
    """One epoch of a track: of its one component ``x`` (n,), ``S`` (n, n), in place, or of several
    ``components``."""
    rows, several = epoch.rows, components.log_weights.size > 1
    moved = False
    found: Update = Update(components, 0.0, 0, 0.0, 0.0, False)
    is_ambiguous = ambiguous_phase(rows, options) >= 0
    if not several and (is_ambiguous or epoch.dt_s > options.coast_after_s):
        P = cov_of(S, options)
        several = is_ambiguous or is_too_wide(x, P, epoch, dynamics, options)
        if several:
            components = one_component(x, P)
    if not several and rows.shape[0] == 0:
        predict(x, S, epoch.dt_s, dynamics.motions[0], dynamics.bias, options)
        return found
    if not several:
        moved, found = _by_one(x, S, components, epoch, since_turn_s, dynamics, options, memory)
        if not moved:
            return found
        components = found.components
    else:
        components = moved_to_epoch(components, epoch, dynamics, options)
        found = Update(components, 0.0, 0, 0.0, 0.0, False)
    if rows.shape[0] > 0:
        found = apply_epoch(components, epoch, options, since_turn_s, memory.accepted)
    mean, cov = moments(found.components)
    x[:] = mean
    write_cov_or_sqrt(options.filter, cov, S)
    return found


@kernel
def run_epochs(
    epochs: Epochs,
    mean: Array,
    cov: Array,
    dynamics: Dynamics,
    options: FilterOptions,
    run: Run,
) -> int:
    """A whole run: every epoch from ``mean`` (n,), ``cov`` (n, n) valid at the first stamp on;
    ``run`` is filled.

    Returns the number of epochs done: less than N where the track was lost, that is after
    ``lost_after`` epochs rejected in a row.
    """
    stamps_ns, row_start = epochs.stamps_ns, epochs.row_start
    memory = scratch(mean.size, max(np.diff(row_start).max(), 1))
    x, S = mean.copy(), cov_or_sqrt_of(cov, options)
    components, rejected_in_row = a_component_each(x, cov, dynamics), 0
    last_ns = heard_ns = turn_ns = stamps_ns[0]
    for k in range(stamps_ns.size):
        now_ns = stamps_ns[k]
        rows = epochs.rows[row_start[k] : row_start[k + 1]].copy()
        dt, unheard_s = (now_ns - last_ns) * 1e-9, (now_ns - heard_ns) * 1e-9
        epoch = EpochInput(dt, unheard_s, rejected_in_row, rows)
        since_turn_s, last_ns = (now_ns - turn_ns) * 1e-9, now_ns
        found = _advance(x, S, components, epoch, since_turn_s, dynamics, options, memory)
        components = found.components
        turn_ns = now_ns if found.begun else turn_ns
        run.nis[k], run.dof[k], run.groups[k], run.radius[k] = found.nis, found.used, 0, 0.0
        if rows.shape[0] > 0:
            groups = int(rows[rows.shape[0] - 1, GROUP]) + 1
            taken = memory.accepted[:groups].sum()
            run.groups[k] = taken
            rejected_in_row = 0 if 2 * taken >= groups else rejected_in_row + 1
            heard_ns = now_ns if taken > 0 else heard_ns
        if components.log_weights.size > 1:
            run.radius[k] = mixture_radius(components, x, options.integrity_risk)
        run.means[k] = x
        write_cov(options.filter, S, run.covs[k])
        if rejected_in_row >= options.lost_after:
            return k + 1
    return int(stamps_ns.size)
