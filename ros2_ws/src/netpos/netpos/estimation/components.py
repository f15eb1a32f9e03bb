"""One epoch of a mixture, compiled: move, split, update, weigh, reduce. The same kernels serve the
live track, the replay and Monte Carlo runs of thousands of routes.

A component is one hypothesis about the device. There are three reasons to have more than one:

- *A measurement fails the gate.* It is an outlier, or it lies in the tail of its error, or the
  device made a manoeuvre that nobody has noticed yet. Each explanation is a component; the
  measurements that follow decide between them (``_add_explanations``).
- *One RSU at a time is heard.* A turn along the bearing shows in no single measurement. Every
  quarter of a second a component "the device has turned since" begins (``_at_once``).
- *The likelihood of a range is a ring.* A component too wide for the tangent of a range is split
  along the ring (``netpos.estimation.mixture``).

Or the device changes between several motion models: then each has a component, and they mix when
they are moved (``netpos.estimation.imm``). They do without the three reasons above.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation import fusion, imm, mixture
from netpos.estimation.compile import kernel
from netpos.estimation.conditioning import Robust, reweight
from netpos.estimation.engine import (
    GATE_SIZE,
    EpochInput,
    Epochs,
    FilterOptions,
    Run,
    Scratch,
    StepResult,
    cov_of,
    cov_or_sqrt_of,
    is_sound,
    manoeuvre_s,
    predict,
    scratch,
    set_velocity_step_noise,
    step,
    update,
    update_with_gate,
)
from netpos.estimation.fit import neg2_log_likelihood
from netpos.estimation.forms.choice import write_cov, write_cov_or_sqrt
from netpos.estimation.gate import accepted_rows
from netpos.estimation.manoeuvre import add_manoeuvre, measures_velocity
from netpos.estimation.measurement import (
    GROUP,
    VARIANCE,
    innovation_row,
    innovation_variance,
)
from netpos.estimation.mixture import Mixture
from netpos.estimation.motion import add_velocity_step
from netpos.estimation.protection import mixture_radius
from netpos.estimation.sensors.row import group_end
from netpos.messages.values import Array

TURN_PERIOD_S = 0.25  # a component "it has turned" begins so long after the last, with one RSU
_TURNS_HZ = 1.0 / 30.0  # how often a device turns
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


class Update(NamedTuple):
    """What came of an epoch: the components; of the most probable one the NIS of the rows it
    accepted and their number; the probability that the device turned in the ``within_s`` seconds
    before the epoch; whether a component "it has turned" has begun."""

    components: Mixture
    nis: float
    used: int
    turned: float
    within_s: float
    begun: bool


class _Candidates(NamedTuple):
    """Components before they are reduced: states, log weights, which groups (K, groups) each
    accepted, NIS of the accepted rows and their number, and for how long the device may have been
    turning (K,), 0 for components without a turn."""

    means: Array
    covs: Array
    log_weights: Array
    accepted: Array
    nis: Array
    used: Array
    within_s: Array


@kernel
def one_component(mean: Array, cov: Array) -> Mixture:
    """A mixture of one component."""
    means, covs = np.empty((1, mean.size)), np.empty((1, mean.size, mean.size))
    means[0], covs[0] = mean, cov
    return Mixture(means, covs, np.zeros(1))


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
        imm.mix(means, covs, weights, imm.transition_matrix(dynamics.sojourn_s, dt_s))
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
    """The components moved to the epoch, the rows of which are re-weighted in place as the robust
    options say: as the most probable component predicts them."""
    moved: Mixture = move(components, epoch.dt_s, dynamics, options)
    rows, robust = epoch.rows, options.robust
    if rows.shape[0] > 0 and (robust.kind != Robust.NONE or robust.nlos_probability > 0.0):
        best, height_m = int(np.argmax(moved.log_weights)), options.height_m
        work = fusion.workspace(moved.means.shape[1], rows.shape[0])
        reweight(moved.means[best], moved.covs[best], rows, height_m, robust, work[0])
    return moved


@kernel
def _log_likelihood(
    mean: Array, cov: Array, rows: Array, height_m: float, accepted: Array
) -> float:
    """Log density of ``rows`` as mean (n,), cov (n, n) predict them; what is not accepted is an
    outlier."""
    total, start = 0.0, 0
    kept = accepted_rows(rows, accepted)
    if kept.size > 0:
        distance, size = neg2_log_likelihood(mean, cov, rows[kept], height_m, False)
        total = -0.5 * (distance + size)
    while start < rows.shape[0]:
        stop = group_end(rows, start)
        if accepted[int(rows[start, GROUP])] == 0.0:
            total += mixture.outlier_log(rows[start:stop])
        start = stop
    return float(total)


@kernel
def _apply(
    k: int, log_weight: float, rows: Array, options: FilterOptions, found: _Candidates
) -> None:
    """Gate and apply ``rows`` to the candidate ``k``, which holds its prediction, and weigh it.
    Nothing accepted leaves the prediction."""
    mean, cov, accepted = found.means[k], found.covs[k], found.accepted[k]
    prior_mean, prior_cov = mean.copy(), cov.copy()
    work = fusion.workspace(mean.size, rows.shape[0])
    cov_or_sqrt = cov_or_sqrt_of(cov, options)
    nis, used = update(mean, cov_or_sqrt, rows, options, accepted, work)
    if used > 0:
        cov[:] = cov_of(cov_or_sqrt, options)
    else:
        mean[:] = prior_mean
    found.nis[k], found.used[k], found.within_s[k] = nis, used, 0.0
    _weigh(k, log_weight, prior_mean, prior_cov, rows, options, found)


@kernel
def _apply_all(
    k: int, log_weight: float, rows: Array, options: FilterOptions, found: _Candidates
) -> None:
    """As ``_apply`` without a gate: ``rows`` come from the tail of their errors."""
    mean, cov, accepted = found.means[k], found.covs[k], found.accepted[k]
    prior_mean, prior_cov = mean.copy(), cov.copy()
    work = fusion.workspace(mean.size, rows.shape[0])
    no_gate = np.full(GATE_SIZE, np.inf)
    cov_or_sqrt = cov_or_sqrt_of(cov, options)
    found.nis[k], found.used[k] = update_with_gate(
        mean, cov_or_sqrt, rows, options, no_gate, accepted, work
    )
    cov[:] = cov_of(cov_or_sqrt, options)
    found.within_s[k] = 0.0
    _weigh(k, log_weight, prior_mean, prior_cov, rows, options, found)


@kernel
def _weigh(
    k: int,
    log_weight: float,
    prior_mean: Array,
    prior_cov: Array,
    rows: Array,
    options: FilterOptions,
    found: _Candidates,
) -> None:
    """Weigh the candidate ``k`` by what its prediction says of ``rows``."""
    likelihood = _log_likelihood(prior_mean, prior_cov, rows, options.height_m, found.accepted[k])
    sound = math.isfinite(likelihood) and is_sound(found.means[k], found.covs[k])
    found.log_weights[k] = log_weight + likelihood if sound else -math.inf


@kernel
def _turn(
    k: int,
    prior: Mixture,
    parent: int,
    within_s: float,
    rows: Array,
    options: FilterOptions,
    found: _Candidates,
) -> None:
    """Make the candidate ``k`` from the component ``parent`` of ``prior``: the device turned in
    the last ``within_s`` seconds."""
    found.means[k], found.covs[k] = prior.means[parent], prior.covs[parent]
    add_manoeuvre(options.manoeuvre_speed_sd, within_s, found.covs[k])
    turns = math.log(_TURNS_HZ * within_s)
    _apply(k, prior.log_weights[parent] + turns, rows, options, found)
    found.within_s[k] = within_s


@kernel
def _add_explanations(
    parent: int,
    end: int,
    prior: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    found: _Candidates,
) -> int:
    """Where a manoeuvre explains what the candidate ``parent`` refuses, add it, and the same
    measurements from the tail of their errors; the number of candidates then."""
    mean, cov = prior.means[parent], prior.covs[parent]
    within_s = manoeuvre_s(mean, cov, epoch.rows, epoch.unheard_s, options)
    if within_s <= 0.0:
        return end
    _turn(end, prior, parent, within_s, epoch.rows, options, found)
    if found.accepted[end].sum() <= found.accepted[parent].sum():
        return end
    found.means[end + 1], found.covs[end + 1] = mean, cov
    _apply_all(end + 1, prior.log_weights[parent], epoch.rows, options, found)
    return end + 2


@kernel
def _candidates(size: int, n: int, groups: int) -> _Candidates:
    return _Candidates(
        np.empty((size, n)),
        np.empty((size, n, n)),
        np.full(size, -np.inf),
        np.zeros((size, groups)),
        np.zeros(size),
        np.zeros(size),
        np.zeros(size),
    )


@kernel
def _first(found: _Candidates, end: int) -> Mixture:
    return Mixture(found.means[:end], found.covs[:end], found.log_weights[:end])


@kernel
def _open_velocity(k: int, epoch: EpochInput, options: FilterOptions, found: _Candidates) -> None:
    """Open the velocity of the candidate ``k`` after ``inflate_after`` epochs rejected in a row:
    no other component has it for interacting models."""
    if epoch.rejected_in_row >= options.inflate_after:
        add_velocity_step(options.initial_speed_sd, epoch.unheard_s, 0.0, found.covs[k])


@kernel
def _one_of_each(components: Mixture) -> Mixture:
    """Components of interacting models after an epoch: none is merged, and none dies. One that is
    no longer sound begins anew as the most probable one."""
    means, covs, log_weights = components
    best = int(np.argmax(log_weights))
    weights = np.exp(log_weights - log_weights[best])
    for k in range(weights.size):
        if log_weights[k] == -math.inf:
            means[k], covs[k] = means[best], covs[best]
    imm.keep_alive(weights)
    return Mixture(means, covs, np.log(weights))


@kernel
def _at_once(
    prior: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    since_turn_s: float,
    accepted: Array,
) -> Update:
    """All measurements of the epoch, for every component of ``prior``."""
    rows = epoch.rows
    count, groups = prior.log_weights.size, int(rows[rows.shape[0] - 1, GROUP]) + 1
    found = _candidates(3 * count + 1, prior.means.shape[1], groups)
    end = count
    for k in range(count):
        found.means[k], found.covs[k] = prior.means[k], prior.covs[k]
        if options.models > 1:
            _open_velocity(k, epoch, options, found)
        _apply(k, prior.log_weights[k], rows, options, found)
        if options.models > 1 and found.used[k] == 0:
            found.covs[k] = prior.covs[k]
        refuses = found.accepted[k].sum() < groups
        if refuses and options.manoeuvre_speed_sd > 0.0:
            end = _add_explanations(k, end, prior, epoch, options, found)
    best = int(np.argmax(found.log_weights[:count]))
    turns = found.accepted[best, 0] == 1.0 and may_turn(
        prior.means[best], rows, since_turn_s, options
    )
    if turns:
        _turn(end, prior, best, max(since_turn_s, epoch.unheard_s), rows, options, found)
        end += 1
    best = int(np.argmax(found.log_weights[:end]))
    top = found.log_weights[best]
    if not math.isfinite(top):
        accepted[:groups] = 0.0
        return Update(prior, 0.0, 0, 0.0, 0.0, turns)
    accepted[:groups] = found.accepted[best]
    weights = np.exp(found.log_weights[:end] - top)
    turned = weights[found.within_s[:end] > 0.0].sum() / weights.sum()
    if options.models > 1:
        components = _one_of_each(_first(found, end))
    else:
        components = mixture.reduced(_first(found, end), _MERGE_SHARE * options.integrity_risk)
    nis, used = found.nis[best], int(found.used[best])
    return Update(components, nis, used, turned, found.within_s[:end].max(), turns)


@kernel
def may_turn(mean: Array, rows: Array, since_turn_s: float, options: FilterOptions) -> bool:
    """Whether an epoch ``rows`` begins a component "it has turned" beside mean (n,),
    ``since_turn_s`` after the last one: several RSUs tell where the device is, and a measured
    velocity whether it has turned."""
    if options.manoeuvre_speed_sd <= 0.0 or since_turn_s < TURN_PERIOD_S:
        return False
    if rows.shape[0] == 0 or rows[rows.shape[0] - 1, GROUP] > 0.0:
        return False
    return not measures_velocity(mean, rows, options.height_m)


@kernel
def _splits(components: Mixture, rows: Array, height_m: float) -> bool:
    """Whether a range of ``rows`` splits a component along its ring."""
    start = 0
    while start < rows.shape[0]:
        stop = group_end(rows, start)
        for k in range(components.log_weights.size):
            mean, cov = components.means[k], components.covs[k]
            if mixture.splits(rows[start:stop], mean, cov, height_m):
                return True
        start = stop
    return False


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
    return bool(_splits(moved, epoch.rows, options.height_m))


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
def _ring(
    k: int, prior: Mixture, rows: Array, end: int, height_m: float, found: _Candidates
) -> int:
    """Add the candidates of the component ``k`` along the ring of a range, and the component
    itself, to which the range is an outlier; the number of candidates then."""
    mean, cov, h = prior.means[k], prior.covs[k], np.empty(prior.means.shape[1])
    residual = innovation_row(rows[0], mean, height_m, h)
    variance = innovation_variance(rows[0], mean, cov, height_m, rows[0, VARIANCE], h)
    ring = mixture.split_along_ring(mean, cov, rows[0], height_m)
    stop = end + ring.log_weights.size
    found.means[end:stop], found.covs[end:stop] = ring.means, ring.covs
    found.log_weights[end:stop] = prior.log_weights[k] + ring.log_weights
    found.accepted[end:stop], found.used[end:stop] = 1.0, 1.0
    found.nis[end:stop] = residual * residual / variance
    found.means[stop], found.covs[stop] = mean, cov
    found.log_weights[stop] = prior.log_weights[k] + mixture.outlier_log(rows)
    found.accepted[stop], found.used[stop] = 0.0, 0.0
    return int(stop + 1)


@kernel
def _one_by_one(
    components: Mixture, rows: Array, options: FilterOptions, accepted: Array
) -> Update:
    """Measurement by measurement, where ranges split components; ``accepted`` where most of the
    mixture does."""
    nis, used, start = 0.0, 0, 0
    while start < rows.shape[0]:
        group, stop = int(rows[start, GROUP]), group_end(rows, start)
        alone = rows[start:stop].copy()
        alone[:, GROUP] = 0.0
        count, n = components.means.shape
        found = _candidates(count * (mixture.RING_MAX + 1), n, 1)
        end = np.int64(0)  # no literal: it would make another version of each kernel below
        for k in range(count):
            mean, cov = components.means[k], components.covs[k]
            if mixture.splits(alone, mean, cov, options.height_m):
                end = _ring(k, components, alone, end, options.height_m, found)
            else:
                found.means[end], found.covs[end] = mean, cov
                _apply(end, components.log_weights[k], alone, options, found)
                end += 1
        best = int(np.argmax(found.log_weights[:end]))
        weights = np.exp(found.log_weights[:end] - found.log_weights[best])
        taken = weights[found.accepted[:end, 0] == 1.0].sum()
        accepted[group] = 1.0 if 2.0 * taken > weights.sum() else 0.0
        if accepted[group] == 1.0:
            likely = np.where(found.accepted[:end, 0] == 1.0, weights, -1.0)
            best = int(np.argmax(likely))
            nis, used = nis + found.nis[best], used + stop - start
        components = mixture.reduced(_first(found, end), mixture.RING_MERGE_COST)
        start = stop
    return Update(components, nis, used, 0.0, 0.0, False)


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
    if options.models == 1 and _splits(components, epoch.rows, options.height_m):
        found: Update = _one_by_one(components, epoch.rows, options, accepted)
    else:
        found = _at_once(components, epoch, options, since_turn_s, accepted)
    return found


@kernel
def moments(components: Mixture) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of the mixture."""
    mean, cov = np.empty_like(components.means[0]), np.empty_like(components.covs[0])
    weights = np.exp(components.log_weights)
    imm.combine(components.means, components.covs, weights / weights.sum(), mean, cov)
    return mean, cov


@kernel
def note_turn(found: Update, motion: Array, options: FilterOptions) -> None:
    """Leave in ``motion`` the velocity step that the components of an epoch allow for, each by its
    weight (``set_velocity_step_noise``)."""
    speed_sd = options.manoeuvre_speed_sd * math.sqrt(found.turned)
    set_velocity_step_noise(motion, 0.0, 0.0, speed_sd, found.within_s)


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
    rows = epoch.rows
    several, moved = components.log_weights.size > 1, False
    if not several and epoch.dt_s > options.coast_after_s:
        P = cov_of(S, options)
        several = is_too_wide(x, P, epoch, dynamics, options)
        if several:
            components = one_component(x, P)
    if not several and rows.shape[0] == 0:
        predict(x, S, epoch.dt_s, dynamics.motions[0], dynamics.bias, options)
        return Update(components, 0.0, 0, 0.0, 0.0, False)
    if not several:
        result = step(x, S, epoch, dynamics.motions[0], dynamics.bias, options, memory)
        if not is_not_enough(result, x, epoch, since_turn_s, options):
            return Update(components, result.nis, result.used, 0.0, 0.0, False)
        P = cov_of(memory.prior_cov_or_sqrt, options)
        components, moved = one_component(memory.prior_mean, P), True
    if not moved:
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
