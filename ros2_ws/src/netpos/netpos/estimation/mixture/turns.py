"""A manoeuvre that nobody has noticed yet: a component in which the device has turned since."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import EpochInput, FilterOptions, manoeuvre_s
from netpos.estimation.fusion import predicted_in, workspace
from netpos.estimation.manoeuvre import add_manoeuvre, measures_position, measures_velocity
from netpos.estimation.mixture.candidates import Candidates, apply, apply_predicted
from netpos.estimation.mixture.gaussians import Mixture
from netpos.messages.values import Array

TURN_PERIOD_S = 0.25  # a component "it has turned" begins so long after the last, with one RSU
TURNS_HZ = 1.0 / 30.0  # how often a device turns


@kernel
def turn(
    k: int,
    prior: Mixture,
    parent: int,
    within_s: float,
    rows: Array,
    options: FilterOptions,
    found: Candidates,
) -> None:
    """Make the candidate ``k`` from the component ``parent`` of ``prior``: the device turned in
    the last ``within_s`` seconds."""
    found.means[k], found.covs[k] = prior.means[parent], prior.covs[parent]
    add_manoeuvre(options.manoeuvre_speed_sd, within_s, found.covs[k])
    turns = math.log(TURNS_HZ * within_s)
    own = workspace(prior.means.shape[1], rows.shape[0])
    apply(k, prior.log_weights[parent] + turns, rows, options, found, own)
    found.within_s[k] = within_s


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
    mean, cov, rows = prior.means[parent], prior.covs[parent], epoch.rows
    predicted = predicted_in(work, mean.size, rows.shape[0])
    within_s = manoeuvre_s(cov, rows, predicted, epoch.unheard_s, options)
    if within_s <= 0.0:
        return end
    turn(end, prior, parent, within_s, rows, options, found)
    if found.accepted[end].sum() <= found.accepted[refused_by].sum():
        return end
    found.means[end + 1], found.covs[end + 1] = mean, cov
    no_gate = np.full_like(options.gate_nis, np.inf)
    apply_predicted(end + 1, prior.log_weights[parent], rows, options, no_gate, found, work)
    return end + 2


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
    turned = covs.copy()
    for k in range(log_weights.size):
        add_manoeuvre(speed, open_s, turned[k])
    return Mixture(
        np.concatenate((means, means)),
        np.concatenate((covs, turned)),
        np.concatenate((log_weights + math.log1p(-share), log_weights + math.log(share))),
    )
