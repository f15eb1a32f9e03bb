"""``conditioning`` in space, apart from it: a planar tracker does without."""

from __future__ import annotations

from netpos.filters.compile import kernel
from netpos.filters.conditioning import Robust, may_be_late, unblock, weigh
from netpos.filters.measurement import VALUE, VARIANCE
from netpos.filters.space import linearise_in_space
from netpos.messages.values import Array


@kernel
def condition_in_space(
    nav: Array,
    cov: Array,
    rows: Array,
    robust: int,
    parameter: float,
    nlos_probability: float,
    nlos_excess_m: float,
) -> None:
    """Re-weight ``rows`` (m, ROW_WIDTH) in place, as seen from a prior nav (n + 1,), cov (n, n) of
    ``error_state``."""
    innovations, H, bend = linearise_in_space(rows, nav, cov)
    if nlos_probability > 0.0:
        for i in range(rows.shape[0]):
            if may_be_late(rows[i]):
                spread = rows[i, VARIANCE] + bend[i] + H[i] @ cov @ H[i]
                before = rows[i, VALUE]
                unblock(rows[i], innovations[i], spread, nlos_probability, nlos_excess_m)
                innovations[i] += rows[i, VALUE] - before
    if robust != Robust.NONE:
        weigh(cov, rows, innovations, H, bend, robust, parameter)
