"""An error that several measurements share: where the reference of time differences hears the
device late, all of them are early; where the clock of the device steps, all times of arrival are
off. None of them is wrong by itself."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import inlined, kernel
from netpos.estimation.engine import FilterOptions
from netpos.estimation.measurement import COMMON, GROUP, VARIANCE
from netpos.estimation.mixture.candidates import Candidates, apply
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.mixture.outliers import OUTLIERS, TAIL_LOG
from netpos.estimation.state import X
from netpos.estimation.update.fusion import workspace
from netpos.estimation.update.predicted import PredictedRows, predicted_rows
from netpos.messages.values import Array

_CLOCK = int(X.CLOCK)
_LARGEST = 1e6  # standard deviations of a measurement: beyond it the update has no digits left
# The log density of an outlier over that of a Gaussian as wide as the outlier is large.
_OVER_GAUSSIAN_LOG = math.log(OUTLIERS) + TAIL_LOG + 0.5 * (1.0 + math.log(2.0 * math.pi))


@inlined
def most_common_errors(rows: int) -> int:
    """How many candidates ``add_common_errors`` makes of so many rows: two for each state, and the
    clock."""
    return rows // 2 + 1


@kernel
def _sharing(state: int, rows: Array, predicted: PredictedRows, options: FilterOptions) -> Array:
    """Which ``rows`` (m, ROW_WIDTH) share an error of ``state``. A single time of arrival shares
    that of the clock with those that follow; of COMMON it takes two."""
    if state == X.CLOCK:
        _, learns_clock = options.learns_density
        timed: Array = (predicted.H[:, X.CLOCK] != 0.0) & learns_clock
        return timed
    shares = rows[:, COMMON] == state
    several: Array = shares & (state > 0 and shares.sum() > 1)
    return several


@kernel
def add_common_errors(
    k: int,
    refused_by: int,
    end: int,
    prior: Mixture,
    rows: Array,
    options: FilterOptions,
    found: Candidates,
) -> int:
    """Add the component ``k`` of ``prior`` with an error in a state that ``rows`` (m, ROW_WIDTH)
    share, for each such state; the number of candidates then.

    The candidate ``refused_by`` refuses one of these rows. The variance of the state is larger by
    the square of their median innovation; such errors are as frequent as outliers. A candidate is
    kept if it accepts more than ``refused_by``, and two of these rows, if there are two.
    """
    mean, cov, accepted = prior.means[k], prior.covs[k], found.accepted[refused_by]
    work = workspace(mean.size, rows.shape[0])
    predicted = predicted_rows(mean, cov, rows, options.height_m)
    groups = rows[:, GROUP].astype(np.int64)
    is_refused = accepted[groups] == 0.0
    states = np.append(np.unique(rows[:, COMMON][is_refused]), float(_CLOCK))
    for state in states.astype(np.int64):
        shares = _sharing(state, rows, predicted, options)
        if not (shares & is_refused).any():
            continue
        off = np.median(predicted.innovation[shares])
        if abs(off) > _LARGEST * math.sqrt(rows[:, VARIANCE][shares].min()):
            continue
        found.means[end], found.covs[end] = mean, cov
        found.covs[end, state, state] += off**2
        apply(end, prior.log_weights[k] + _OVER_GAUSSIAN_LOG, rows, options, found, work)
        agree = found.accepted[end][groups[shares]].sum()
        if agree >= min(shares.sum(), 2) and found.accepted[end].sum() > accepted.sum():
            end += 1
    return int(end)
