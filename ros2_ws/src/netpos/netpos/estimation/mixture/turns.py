"""A manoeuvre that nobody has noticed yet: a component in which the device has turned since."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import EpochInput, FilterOptions, manoeuvre_s
from netpos.estimation.level.manoeuvre import (
    add_manoeuvre,
    measures_position,
    measures_velocity,
    side_turns,
    turn_to_side,
)
from netpos.estimation.mixture.candidates import Candidates, add_gated, apply
from netpos.estimation.mixture.gaussians import Mixture, together
from netpos.estimation.sensors.row import group_count
from netpos.estimation.update.fusion import predicted_in, workspace
from netpos.messages.values import Array

TURN_PERIOD_S = 0.25  # a component "it has turned" begins so long after the last, with one RSU
TURNS_HZ = 1.0 / 30.0  # how often a device turns
TURNS_MAX = 3  # components of ``turned``
EXPLANATIONS_MAX = TURNS_MAX + 1  # candidates of ``add_explanations``
_LEAST_SHARE = 1e-2  # of turns to a side that are looked at


@leaf
def open_time_s(epoch: EpochInput) -> float:
    """Time [s] before an epoch of which no component says whether the device turned, or since it
    was heard."""
    return max(epoch.open_s, epoch.unheard_s)


@kernel
def turned(prior: Mixture, parent: int, within_s: float, options: FilterOptions) -> Mixture:
    """What a component ``parent`` of ``prior`` is if the device, in the last ``within_s`` seconds,
    turned to a side at its speed, or its velocity changed by any step."""
    speed_sd, mean, cov = options.manoeuvre_speed_sd, prior.means[parent], prior.covs[parent]
    n, end, share = mean.size, 0, side_turns(mean, cov, speed_sd)
    means, covs = np.empty((TURNS_MAX, n)), np.empty((TURNS_MAX, n, n))
    logs = np.full(TURNS_MAX, prior.log_weights[parent] + math.log(TURNS_HZ * within_s))
    share = share if share > _LEAST_SHARE else 0.0
    for side in (0.0, 1.0, -1.0):
        chance = 1.0 - share if side == 0.0 else 0.5 * share
        if chance == 0.0:
            continue
        means[end], covs[end] = mean, cov
        if side == 0.0:
            add_manoeuvre(speed_sd, within_s, covs[end])
        else:
            turn_to_side(side, within_s, means[end], covs[end])
        logs[end] += math.log(chance)
        end += 1
    return Mixture(means[:end], covs[:end], logs[:end])


@kernel
def add_turns(
    parent: int,
    end: int,
    prior: Mixture,
    within_s: float,
    rows: Array,
    options: FilterOptions,
    found: Candidates,
    more_than: float,
) -> int:
    """Add the component ``parent`` of ``prior``, ``turned``, as candidates that have had the
    ``rows``, if they accept ``more_than`` so many groups; the number of candidates then. None
    where ``within_s`` is 0."""
    if within_s <= 0.0:
        return end
    parts: Mixture = turned(prior, parent, within_s, options)
    own = workspace(found.means.shape[1], rows.shape[0])
    for k in range(parts.log_weights.size):
        found.means[end], found.covs[end] = parts.means[k], parts.covs[k]
        apply(end, parts.log_weights[k], rows, options, found, own)
        found.within_s[end] = within_s
        if found.accepted[end].sum() > more_than:
            end += 1
    return int(end)


@kernel
def unnoticed_s(cov: Array, epoch: EpochInput, options: FilterOptions, work: Array) -> float:
    """``manoeuvre_s`` of a component with ``cov`` (n, n), whose prediction ``work`` holds. No
    longer than the open time where the epoch does not show a turn by itself: of one from before
    that time a component says so."""
    rows = epoch.rows
    predicted = predicted_in(work, cov.shape[0], rows.shape[0])
    within_s = manoeuvre_s(cov, rows, predicted, epoch.unheard_s, options)
    if leaves_turns_open(predicted.H, group_count(rows)):
        within_s = min(within_s, open_time_s(epoch))
    return float(within_s)


@kernel
def add_explanations(
    parent: int,
    refused_by: int,
    end: int,
    prior: Mixture,
    epoch: EpochInput,
    options: FilterOptions,
    found: Candidates,
    work: Array,
) -> int:
    """Where a manoeuvre explains what the candidate ``refused_by``, made of the component
    ``parent``, refuses, add it, and the same measurements from the tail of their errors; the
    number of candidates then. ``work`` holds the rows as ``parent`` predicts them."""
    within_s = unnoticed_s(prior.covs[parent], epoch, options, work)
    first, refused = end, found.accepted[refused_by].sum()
    end = add_turns(parent, first, prior, within_s, epoch.rows, options, found, refused)
    if end == first:
        return end
    return int(add_gated(math.inf, parent, end, prior, epoch.rows, options, found, work))


@leaf
def leaves_turns_open(H: Array, groups: int) -> bool:
    """Whether an epoch of ``groups`` measurements with the Jacobian H (m, n) does not show a turn
    by itself: several RSUs in different directions tell where the device is, and a measured
    velocity whether it has turned."""
    if measures_velocity(H):
        return False
    return groups == 1 or not measures_position(H)


@leaf
def may_turn(H: Array, groups: int, open_s: float, options: FilterOptions) -> bool:
    """Whether an epoch of ``groups`` measurements with the Jacobian H (m, n) begins a component
    "it has turned", where no component says so of the last ``open_s`` seconds."""
    if options.manoeuvre_speed_sd <= 0.0 or open_s < TURN_PERIOD_S:
        return False
    return bool(leaves_turns_open(H, groups))


@kernel
def may_have_turned(components: Mixture, open_s: float, speed: float) -> Mixture:
    """The components, and each again as if the device had turned in the last ``open_s`` seconds,
    of which they know nothing: its position is as much less certain as that allows."""
    means, covs, log_weights = components
    share = min(TURNS_HZ * open_s, 0.5)
    if share <= 0.0 or speed <= 0.0:
        return components
    wide = covs.copy()
    for k in range(log_weights.size):
        add_manoeuvre(speed, open_s, wide[k])
    straight = Mixture(means, covs, log_weights + math.log1p(-share))
    both: Mixture = together(straight, Mixture(means, wide, log_weights + math.log(share)))
    return both
