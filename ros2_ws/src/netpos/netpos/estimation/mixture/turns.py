"""A manoeuvre that nobody has noticed yet: a component in which the device has turned since."""

from __future__ import annotations

import math

from netpos.estimation.compile import kernel
from netpos.estimation.engine import EpochInput, FilterOptions, manoeuvre_s
from netpos.estimation.manoeuvre import add_manoeuvre, measures_velocity
from netpos.estimation.measurement import GROUP
from netpos.estimation.mixture.candidates import Candidates, apply, apply_all
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
    apply(k, prior.log_weights[parent] + turns, rows, options, found)
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
) -> int:
    """Where a manoeuvre explains what the candidate ``refused_by``, made of the component
    ``parent``, refuses, add it, and the same measurements from the tail of their errors; the
    number of candidates then."""
    mean, cov = prior.means[parent], prior.covs[parent]
    within_s = manoeuvre_s(mean, cov, epoch.rows, epoch.unheard_s, options)
    if within_s <= 0.0:
        return end
    turn(end, prior, parent, within_s, epoch.rows, options, found)
    if found.accepted[end].sum() <= found.accepted[refused_by].sum():
        return end
    found.means[end + 1], found.covs[end + 1] = mean, cov
    apply_all(end + 1, prior.log_weights[parent], epoch.rows, options, found)
    return end + 2


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
