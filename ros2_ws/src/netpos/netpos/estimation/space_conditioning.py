"""``conditioning`` in space, apart from it: a planar tracker does without."""

from __future__ import annotations

from netpos.estimation.compile import kernel
from netpos.estimation.conditioning import (
    Robust,
    RobustOptions,
    m_estimate,
    may_be_late,
    nlos_correct,
)
from netpos.estimation.measurement import VALUE, VARIANCE
from netpos.estimation.space import linearise_in_space
from netpos.messages.values import Array


@kernel
def reweight_3d(nav: Array, cov: Array, rows: Array, options: RobustOptions) -> None:
    """Re-weight ``rows`` (m, ROW_WIDTH) in place, as seen from a prior nav (n + 1,), cov (n, n) of
    ``error_state``."""
    innovations, H, second_order_var = linearise_in_space(rows, nav, cov)
    if options.nlos_probability > 0.0:
        for i in range(rows.shape[0]):
            if may_be_late(rows[i]):
                innovation_var = rows[i, VARIANCE] + second_order_var[i] + H[i] @ cov @ H[i]
                before = rows[i, VALUE]
                prior, excess_m = options.nlos_probability, options.nlos_excess_m
                nlos_correct(rows[i], innovations[i], innovation_var, prior, excess_m)
                innovations[i] += rows[i, VALUE] - before
    if options.kind != Robust.NONE:
        m_estimate(cov, rows, innovations, H, second_order_var, options)
