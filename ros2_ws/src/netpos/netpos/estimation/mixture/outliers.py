"""Outliers: measurements that are wrong by nobody knows how much. A track refuses them, a first
fix leaves them out."""

from __future__ import annotations

import math

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.measurement import GATE_VARIANCE, OUTLIER_SHARE
from netpos.estimation.update.predicted import PredictedRows
from netpos.messages.values import Array

OUTLIERS = 1e-2
"""Share of all values that are outliers, where nothing is known of their RSU."""
_FARTHEST = 1e3  # standard deviations
TAIL_LOG = -math.log(2.0 * (1.0 + math.log(_FARTHEST)))
"""Log density of such an error, times its size: each octave is as likely."""


@leaf
def share_of_outliers(row: Array) -> float:
    """How many of the measurements to which ``row`` (ROW_WIDTH,) belongs are outliers."""
    share = row[OUTLIER_SHARE]
    return float(share) if share > 0.0 else OUTLIERS


@leaf
def tail_log(squared: float, variance: float) -> float:
    """Log density of the error of an outlier, by its square: beyond one standard deviation each
    octave is as likely, up to it every error."""
    return TAIL_LOG - 0.5 * math.log(max(squared, variance))


@kernel
def outlier_log(rows: Array, predicted: PredictedRows, start: int, stop: int) -> float:
    """Log density of the ``rows`` (m, ROW_WIDTH) ``start`` to ``stop`` of one measurement, as they
    are ``predicted``, if it is an outlier, with the log probability that it is one."""
    total = math.log(share_of_outliers(rows[start]))
    for i in range(start, stop):
        known = predicted.prior_var[i] + predicted.second_order_var[i]
        total += tail_log(predicted.innovation[i] ** 2, rows[i, GATE_VARIANCE] + known)
    return total
