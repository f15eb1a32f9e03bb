"""One epoch of a mixture, compiled: move, split, update, weigh, reduce. The same kernels serve the
live track, the replay and Monte Carlo runs of thousands of routes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.densities import PARAMETERS, learn, unknown_densities, write_densities
from netpos.estimation.densities import move as move_densities
from netpos.estimation.engine import (
    EpochInput,
    Epochs,
    FilterOptions,
    Run,
    Scratch,
    cov_of,
    cov_or_sqrt_of,
    is_sound,
    predict,
    predict_epoch,
    predict_to,
    scratch,
    set_velocity_step_noise,
    update_epoch,
)
from netpos.estimation.forms.choice import write_cov, write_cov_or_sqrt
from netpos.estimation.level.manoeuvre import detection_delay_s
from netpos.estimation.level.protection import (
    FusedEpoch,
    LevelScratch,
    level_scratch,
    manoeuvre_level,
    mixture_radius,
)
from netpos.estimation.mixture import mixing
from netpos.estimation.mixture.candidates import (
    Candidates,
    Update,
    add_gated,
    apply,
    candidates,
    first_of,
    mixture_of,
)
from netpos.estimation.mixture.common_error import add_common_errors, most_common_errors
from netpos.estimation.mixture.gaussians import Mixture, leaders, moments, one_component
from netpos.estimation.mixture.in_turn import in_turn
from netpos.estimation.mixture.reduction import reduced
from netpos.estimation.mixture.sectors import (
    add_turns_of_phase,
    ambiguous_phase,
    keep_sectors,
    most_turns,
    reduced_by_sector,
)
from netpos.estimation.mixture.splits.choice import any_begins, any_divides
from netpos.estimation.mixture.splits.paths import reweight_by_best
from netpos.estimation.mixture.turns import (
    EXPLANATIONS_MAX,
    TURNS_MAX,
    add_explanations,
    add_turns,
    leaves_turns_open,
    may_have_turned,
    may_turn,
    open_time_s,
    unnoticed_s,
)
from netpos.estimation.motion import add_velocity_step
from netpos.estimation.sensors.row import ROW_WIDTH, group_count
from netpos.estimation.update.conditioning import Robust, by_fit, by_path
from netpos.estimation.update.fusion import predicted_in, workspace
from netpos.estimation.update.gate import fail_together
from netpos.estimation.update.predicted import note_innovations, predict_rows
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
def move(
    components: Mixture, dt_s: float, rows: Array, dynamics: Dynamics, options: FilterOptions
) -> Mixture:
    """The components moved by ``dt_s`` seconds, to an epoch of ``rows`` or to none; those of
    interacting models mix before."""
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
        predict_to(means[k], cov_or_sqrt, dt_s, rows, motion, dynamics.bias, options)
        covs[k] = cov_of(cov_or_sqrt, options)
    return Mixture(means, covs, log_weights)


@kernel
def reweighted(components: Mixture, rows: Array, options: FilterOptions) -> None:
    """Re-weight the rows of an epoch in place by how they fit the most probable component, which
    predicts them; what a blocked path may be follows in ``apply_epoch``."""
    if rows.shape[0] > 0 and options.robust.kind != Robust.NONE:
        reweight_by_best(components, rows, options.height_m, by_fit(options.robust))


@kernel
def moved_to_epoch(
    components: Mixture, epoch: EpochInput, dynamics: Dynamics, options: FilterOptions
) -> Mixture:
    """The components moved to the epoch, the rows of which are ``reweighted``."""
    moved: Mixture = move(components, epoch.dt_s, epoch.rows, dynamics, options)
    reweighted(moved, epoch.rows, options)
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
    work: Array,
) -> int:
    """Make the candidate ``k`` from the component ``k`` of ``prior``, and at the end one for each
    other sector of a phase in the row ``at`` and each explanation of what is refused; the number
    of candidates then. ``work`` keeps the rows as the component sees them."""
    mean, cov, rows = prior.means[k], prior.covs[k], epoch.rows
    refused = epoch.rejected_in_row >= options.inflate_after
    opens = refused and (options.models > 1 or options.manoeuvre_speed_sd <= 0.0)
    if at >= 0:
        end = add_turns_of_phase(k, end, prior, rows, at, options, found)
        predicted = predicted_in(work, mean.size, rows.shape[0])
        predict_rows(mean, cov, rows, options.height_m, predicted)
    else:
        found.means[k], found.covs[k] = mean, cov
        if opens:  # no other component allows for a turn
            add_velocity_step(options.initial_speed_sd, epoch.unheard_s, 0.0, found.covs[k])
        apply(k, prior.log_weights[k], rows, options, found, work)
    if opens and found.used[k] == 0:
        found.covs[k] = cov
    if options.manoeuvre_speed_sd <= 0.0:
        return int(end)
    if fail_together(found.nis[k], int(found.used[k]), options.gate_nis):
        end = add_gated(-1.0, k, end, prior, rows, options, found, work)
        within_s = unnoticed_s(cov, epoch, options, work)
        end = add_turns(k, end, prior, within_s, rows, options, found, 0.0)
    elif found.accepted[k].sum() < found.accepted.shape[1]:
        end = add_explanations(k, k, end, prior, epoch, options, found, work)
        end = add_common_errors(k, k, end, prior, rows, options, found)
    return int(end)


@kernel
def _at_once(
    prior: Mixture,
    epoch: EpochInput,
    at: int,
    options: FilterOptions,
    accepted: Array,
) -> Update:
    """All measurements of the epoch, for every component of ``prior``, in every sector of an
    ambiguous phase in the row ``at`` (-1: there is none)."""
    rows = epoch.rows
    count, groups = prior.log_weights.size, group_count(rows)
    sectors = 2 * most_turns(rows[at]) + 1 if at >= 0 else 0
    m, n = rows.shape[0], prior.means.shape[1]
    each = 1 + EXPLANATIONS_MAX + most_common_errors(m) + TURNS_MAX
    size = each * count + (sectors + 1) * (count + 1)
    found, work = candidates(size, n, groups), workspace(n, m)
    end = np.int64(count)
    for k in range(count):
        end = _add_candidates(k, end, prior, epoch, at, options, found, work)
    best = int(np.argmax(found.log_weights[:count]))
    H = predicted_in(work, n, m).H  # velocities: of any component
    turns = found.accepted[best, 0] == 1.0 and may_turn(H, groups, epoch.open_s, options)
    if turns:
        weighed = Mixture(prior.means, prior.covs, found.log_weights[:count])
        for k in leaders(weighed):
            within_s = open_time_s(epoch)
            end = add_turns(k, end, prior, within_s, rows, options, found, -1.0)
    if at >= 0:
        end = keep_sectors(prior, best, end, rows, at, options, found)
    found = first_of(found, end)
    best = int(np.argmax(found.log_weights))
    top = found.log_weights[best]
    if not math.isfinite(top):
        accepted[:groups] = 0.0
        return Update(prior, 0.0, 0, np.ones(groups), 0.0, 0.0, turns)
    accepted[:groups] = found.accepted[best]
    weights = np.exp(found.log_weights - top)
    weights /= weights.sum()
    turned, outliers = weights[found.within_s > 0.0].sum(), 1.0 - weights @ found.accepted
    parts, merge_cost = mixture_of(found), _MERGE_SHARE * options.integrity_risk
    if options.models > 1:
        components = mixing.one_of_each(parts)
    elif at >= 0:
        components = reduced_by_sector(parts, rows, at, merge_cost, options)
    else:
        components = reduced(parts, merge_cost)
    nis, used = found.nis[best], int(found.used[best])
    return Update(components, nis, used, outliers, turned, found.within_s.max(), turns)


@kernel
def apply_epoch(
    components: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    accepted: Array,
) -> Update:
    """The components, moved to the epoch already, after it; ``accepted`` (groups,) is filled with
    0 or 1."""
    rows, at = epoch.rows, ambiguous_phase(epoch.rows, options)
    if options.models == 1 and at < 0 and any_divides(components, rows, options):
        found: Update = in_turn(components, epoch, options, accepted)
        return found
    if options.robust.nlos_probability > 0.0:
        reweight_by_best(components, rows, options.height_m, by_path(options.robust))
    at_once: Update = _at_once(components, epoch, at, options, accepted)
    return at_once


@kernel
def note_turn(found: Update, motion: Array, options: FilterOptions) -> None:
    """Leave in ``motion`` the velocity step that the components of an epoch allow for, each by its
    weight (``set_velocity_step_noise``)."""
    speed_sd = options.manoeuvre_speed_sd * math.sqrt(found.turned)
    set_velocity_step_noise(motion, 0.0, 0.0, speed_sd, found.within_s)


class Outcome(NamedTuple):
    """What came of an epoch of a track: its components; NIS of the rows accepted and their number;
    the probability of each group that it is an outlier (groups,); how far [m] a manoeuvre that
    this epoch does not show may have taken the device (not a number where the posterior is not
    sound); the probability that the device has turned; the last seconds of which neither a
    component nor the epoch itself says whether it did."""

    components: Mixture
    nis: float
    used: int
    outliers: Array
    undetected_m: float
    turned: float
    open_s: float


class Memory(NamedTuple):
    """Memory of ``advance`` for up to m rows: of one component, of ``manoeuvre_level``,
    innovations (m, 2) with their sd, as the whole estimate predicted them, and rows (m,
    ROW_WIDTH) as they were."""

    step: Scratch
    level: LevelScratch
    innovations: Array
    rows: Array


@kernel
def memory_of(n: int, m: int) -> Memory:
    """Memory for ``advance`` with ``n`` states and up to ``m`` rows."""
    return Memory(scratch(n, m), level_scratch(n, m), np.empty((m, 2)), np.empty((m, ROW_WIDTH)))


@leaf
def _copy_rows(rows: Array, to: Array) -> None:
    for i in range(rows.shape[0]):
        for k in range(ROW_WIDTH):
            to[i, k] = rows[i, k]


@leaf
def _by_one(
    x: Array,
    S: Array,
    epoch: EpochInput,
    dynamics: Dynamics,
    options: FilterOptions,
    memory: Memory,
) -> tuple[bool, float, int]:
    """One epoch of the one component ``x`` (n,), ``S`` (n, n), in place: whether that is enough,
    NIS and number of the rows accepted. It is not where a measurement divides it, something is
    refused or contradicts the rest, or nothing tells that the device has not turned; the rows are
    as they were then."""
    rows, motion, n, step = epoch.rows, dynamics.motions[0], x.size, memory.step
    groups = group_count(rows)
    predict_epoch(x, S, epoch, motion, dynamics.bias, options, step)
    predicted = predicted_in(step.work, n, rows.shape[0])
    if options.models == 1 and any_begins(x, step.met_cov, epoch, predicted, options):
        return False, 0.0, 0
    changes = options.robust.kind != Robust.NONE or options.robust.nlos_probability > 0.0
    if changes:
        _copy_rows(rows, memory.rows)
    result = update_epoch(x, S, epoch, motion, options, step)
    if options.manoeuvre_speed_sd > 0.0:
        refused = result.groups < groups
        contradict = fail_together(result.nis, result.used, options.gate_nis)
        if refused or contradict or may_turn(predicted.H, groups, epoch.open_s, options):
            if changes:
                _copy_rows(memory.rows[: rows.shape[0]], rows)
            return False, 0.0, 0
    return True, result.nis, result.used


@kernel
def _open_radius(
    components: Mixture, x: Array, cov: Array, open_s: float, options: FilterOptions
) -> float:
    """Radius round ``x`` (n,) that the several ``components``, or one with ``x`` and ``cov`` (n,
    n), leave with the integrity risk if nobody knows of the last ``open_s`` seconds whether the
    device turned."""
    several = components.log_weights.size > 1
    known = components if several else one_component(x, cov)
    told = may_have_turned(known, open_s, options.manoeuvre_speed_sd)
    return float(mixture_radius(told, x, options.integrity_risk))


@leaf
def _finish(
    x: Array,
    S: Array,
    components: Mixture,
    epoch: EpochInput,
    open_s: float,
    options: FilterOptions,
    memory: Memory,
) -> tuple[float, float]:
    """Fill the innovations of an epoch that the estimate ``x`` (n,), ``S`` (n, n), of several
    ``components`` or of one, has had, from the rows as its prediction saw them;
    ``Outcome.undetected_m`` and ``Outcome.open_s``, which was ``open_s``. ``memory.step.met_cov``
    becomes the covariance of the estimate.

    An epoch that sees all directions shows a manoeuvre after some time. Of another, one range or
    one angle, components say whether the device has turned, but for the last ``open_s`` seconds.
    """
    step, rows, speed = memory.step, epoch.rows, options.manoeuvre_speed_sd
    write_cov(options.filter, S, step.met_cov)
    if not is_sound(x, step.met_cov):
        return math.nan, open_s
    predicted = predicted_in(step.work, x.size, rows.shape[0])
    note_innovations(rows, predicted, memory.innovations)
    if speed <= 0.0:
        return 0.0, open_s
    groups, accepted = group_count(rows), step.accepted
    gate = options.gate_nis[2]
    _, longest_s = detection_delay_s(rows, predicted, x.size, gate, speed)
    is_open = leaves_turns_open(predicted.H, groups)
    if math.isinf(longest_s) and (is_open or math.isfinite(gate)):
        return _open_radius(components, x, step.met_cov, open_s, options), open_s
    prior_mean, prior_cov = step.prior_mean, step.prior_cov
    fused = FusedEpoch(prior_mean, prior_cov, rows, accepted, epoch.unheard_s, x)
    level = float(manoeuvre_level(fused, longest_s, options, memory.level))
    shown = math.isfinite(level) and not is_open and accepted[:groups].sum() > 0.0
    return level, min(longest_s, open_s) if shown else open_s


@kernel
def advance(
    x: Array,
    S: Array,
    components: Mixture,
    epoch: EpochInput,
    dynamics: Dynamics,
    options: FilterOptions,
    memory: Memory,
) -> Outcome:
    """One epoch of a track: of its one component ``x`` (n,), ``S`` (n, n), or of several
    ``components``, of which ``x`` and ``S`` are the moments; in place.

    ``memory.step`` keeps the prediction of the whole estimate, and 0 or 1 of each group in
    ``accepted``. ``dynamics.motions[0]`` keeps the velocity step that the epoch allowed for.
    """
    rows, several, step = epoch.rows, components.log_weights.size > 1, memory.step
    is_ambiguous = ambiguous_phase(rows, options) >= 0
    if not several and is_ambiguous:
        several = True
        components = one_component(x, cov_of(S, options))
    if not several:
        if rows.shape[0] == 0:
            predict(x, S, epoch.dt_s, dynamics.motions[0], dynamics.bias, options)
            return Outcome(components, 0.0, 0, np.zeros(0), 0.0, 0.0, epoch.open_s)
        enough, nis, used = _by_one(x, S, epoch, dynamics, options, memory)
        if enough:
            undetected_m, open_s = _finish(x, S, components, epoch, epoch.open_s, options, memory)
            groups = group_count(rows)
            return Outcome(components, nis, used, np.zeros(groups), undetected_m, 0.0, open_s)
        components = one_component(step.prior_mean, step.prior_cov)
        reweighted(components, rows, options)
    else:
        components = moved_to_epoch(components, epoch, dynamics, options)
    if rows.shape[0] == 0:
        mean, cov = moments(components)
        x[:] = mean
        write_cov_or_sqrt(options.filter, cov, S)
        return Outcome(components, 0.0, 0, np.zeros(0), 0.0, 0.0, epoch.open_s)
    step.prior_mean[:], step.prior_cov[:] = moments(components)
    write_cov_or_sqrt(options.filter, step.prior_cov, step.prior_cov_or_sqrt)
    found = apply_epoch(components, epoch, options, step.accepted)
    predicted = predicted_in(step.work, x.size, rows.shape[0])
    predict_rows(step.prior_mean, step.prior_cov, rows, options.height_m, predicted)
    note_turn(found, dynamics.motions[0], options)
    mean, cov = moments(found.components)
    x[:] = mean
    write_cov_or_sqrt(options.filter, cov, S)
    open_s = 0.0 if found.begun else epoch.open_s
    undetected_m, open_s = _finish(x, S, found.components, epoch, open_s, options, memory)
    nis, used, turned = found.nis, found.used, found.turned
    return Outcome(found.components, nis, used, found.outliers, undetected_m, turned, open_s)


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
    memory = memory_of(mean.size, max(np.diff(row_start).max(), 1))
    x, S = mean.copy(), cov_or_sqrt_of(cov, options)
    components, rejected_in_row = a_component_each(x, cov, dynamics), 0
    learned, motion = unknown_densities(x.size, options.learns_density), dynamics.motions[0]
    last_ns = heard_ns = stamps_ns[0]
    open_s = 0.0
    for k in range(stamps_ns.size):
        now_ns = stamps_ns[k]
        rows = epochs.rows[row_start[k] : row_start[k + 1]].copy()
        dt, unheard_s = (now_ns - last_ns) * 1e-9, (now_ns - heard_ns) * 1e-9
        epoch = EpochInput(dt, unheard_s, open_s + dt, rejected_in_row, rows)
        last_ns = now_ns
        write_densities(learned, motion)
        move_densities(learned, x, dt, motion, dynamics.bias)
        run.densities[k] = motion[PARAMETERS[0]], motion[PARAMETERS[1]]
        found = advance(x, S, components, epoch, dynamics, options, memory)
        components = found.components
        if rows.shape[0] > 0:
            step = memory.step
            learn(learned, step.prior_mean, step.prior_cov, x, step.met_cov, found.turned)
        open_s = found.open_s
        run.nis[k], run.dof[k], run.groups[k], run.radius[k] = found.nis, found.used, 0, 0.0
        run.undetected_m[k] = run.undetected_m[k - 1] if k > 0 else 0.0
        if rows.shape[0] > 0:
            run.undetected_m[k] = found.undetected_m
            groups = group_count(rows)
            taken = memory.step.accepted[:groups].sum()
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
