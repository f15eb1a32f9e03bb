"""An error that several measurements of an epoch share: where the reference of time differences
hears the device late, all of them are early, and where the clock of the device steps, all times of
arrival are off. None of them is wrong by itself."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.engine import FilterOptions
from netpos.estimation.measurement import COMMON, GROUP, VARIANCE
from netpos.estimation.mixture.candidates import OUTLIERS, TAIL_LOG, Candidates, apply
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.state import X
from netpos.estimation.update.fusion import workspace
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array

_CLOCK = int(X.CLOCK)
_LARGEST = 1e6  # standard deviations of a measurement: beyond it the update has no digits left
# The log density of an outlier over that of a Gaussian as wide as the outlier is large.
_OVER_GAUSSIAN_LOG = math.log(OUTLIERS) + TAIL_LOG + 0.5 * (1.0 + math.log(2.0 * math.pi))


@kernel
def add_common_errors(
    k: int, end: int, prior: Mixture, rows: Array, options: FilterOptions, found: Candidates
) -> int:
    """For each state that several ``rows`` (m, ROW_WIDTH) share, and for the clock, which a single
    one shares with those that follow, if the candidate ``k`` refuses one of them: add the
    component ``k`` of ``prior`` with an error there as large as the rows are off, if it accepts
    more, and two of those that share it, if there are two; the number of candidates then. Such
    errors are as frequent as outliers."""
    mean, cov, accepted = prior.means[k], prior.covs[k], found.accepted[k]
    work = workspace(mean.size, rows.shape[0])
    predicted = predicted_rows(mean, cov, rows, options.height_m)
    groups = rows[:, GROUP].astype(np.int64)
    is_refused = accepted[groups] == 0.0
    states = np.append(np.unique(rows[:, COMMON][is_refused]), _CLOCK)
    for state in states.astype(np.int64):
        shares = rows[:, COMMON] == state if state != _CLOCK else predicted.H[:, _CLOCK] != 0.0
        count = shares.sum()
        enough = count > 1 or state == _CLOCK
        if state <= 0 or not enough or not (shares & is_refused).any():
            continue
        off = np.median(predicted.innovation[shares])
        if abs(off) > _LARGEST * math.sqrt(rows[:, VARIANCE][shares].min()):
            continue
        found.means[end], found.covs[end] = mean, cov
        found.covs[end, state, state] += off**2
        apply(end, prior.log_weights[k] + _OVER_GAUSSIAN_LOG, rows, options, found, work)
        agree = found.accepted[end][groups[shares]].sum()
        if agree >= min(count, 2) and found.accepted[end].sum() > accepted.sum():
            end += 1
    return int(end)
