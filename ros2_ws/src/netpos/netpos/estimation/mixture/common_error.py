"""An error that several measurements of an epoch share: where the reference of time differences
hears the device late, all of them are early, and none of them is wrong by itself."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.engine import FilterOptions
from netpos.estimation.measurement import COMMON, GROUP
from netpos.estimation.mixture.candidates import OUTLIERS, TAIL_LOG, Candidates, apply
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.update.fusion import workspace
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array

# The log density of an outlier over that of a Gaussian as wide as the outlier is large.
_OVER_GAUSSIAN_LOG = math.log(OUTLIERS) + TAIL_LOG + 0.5 * (1.0 + math.log(2.0 * math.pi))


@kernel
def add_common_errors(
    k: int, end: int, prior: Mixture, rows: Array, options: FilterOptions, found: Candidates
) -> int:
    """For each state that several ``rows`` (m, ROW_WIDTH) share, of which the candidate ``k``
    refuses one, add the component ``k`` of ``prior`` with an error there as large as the rows are
    off, if it accepts more; the number of candidates then. Such errors are as frequent as
    outliers."""
    mean, cov, accepted = prior.means[k], prior.covs[k], found.accepted[k]
    work = workspace(mean.size, rows.shape[0])
    off = predicted_rows(mean, cov, rows, options.height_m).innovation
    is_refused = accepted[rows[:, GROUP].astype(np.int64)] == 0.0
    for common in np.unique(rows[:, COMMON][is_refused]):
        shares, state = rows[:, COMMON] == common, int(common)
        if state <= 0 or shares.sum() < 2:
            continue
        found.means[end], found.covs[end] = mean, cov
        found.covs[end, state, state] += np.median(off[shares]) ** 2
        apply(end, prior.log_weights[k] + _OVER_GAUSSIAN_LOG, rows, options, found, work)
        if found.accepted[end].sum() > accepted.sum():
            end += 1
    return int(end)
