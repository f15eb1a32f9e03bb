"""``conditioning`` in space, apart from it: a planar tracker does without."""

from __future__ import annotations

from netpos.filters.compile import kernel
from netpos.filters.conditioning import Robust, RobustOptions, may_be_late, unblock, weigh
from netpos.filters.measurement import VALUE, VARIANCE
from netpos.filters.space import linearise_in_space
from netpos.messages.values import Array


@kernel
def condition_in_space(nav: Array, cov: Array, rows: Array, options: RobustOptions) -> None:
    """Re-weight ``rows`` (m, ROW_WIDTH) in place, as seen from a prior nav (n + 1,), cov (n, n) of
    ``error_state``."""
    innovations, H, bend = linearise_in_space(rows, nav, cov)
    if options.nlos_probability > 0.0:
        for i in range(rows.shape[0]):
            if may_be_late(rows[i]):
                spread = rows[i, VARIANCE] + bend[i] + H[i] @ cov @ H[i]
                before = rows[i, VALUE]
                prior, excess_m = options.nlos_probability, options.nlos_excess_m
                unblock(rows[i], innovations[i], spread, prior, excess_m)
                innovations[i] += rows[i, VALUE] - before
    if options.kind != Robust.NONE:
        weigh(cov, rows, innovations, H, bend, options)
