"""Cost of a state against all measurements of a window, the device moving straight in it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import VALUE, VARIANCE, is_cyclic, predict_row, wrap
from netpos.messages.values import Array


class Window(NamedTuple):
    """Measurements of a short time.

    ages_s (m,) : when each was made, <= 0 before the stamp of the state
    rows (m, ROW_WIDTH) : the slow errors in them are states behind those of the device
    height_m : nominal height of the device
    """

    ages_s: Array
    rows: Array
    height_m: float


@kernel
def normal_equations(
    state: Array, window: Window, prior: Array, prior_var: Array
) -> tuple[float, Array, Array]:
    """Cost, gradient (n,) and Gauss-Newton Hessian (n, n) of the fit at ``state`` (n,)."""
    rows, n = window.rows, state.size
    A = np.diag(1.0 / prior_var)
    difference = prior - state
    b = difference / prior_var
    cost = float((difference * b).sum())
    h = np.zeros(n)
    past = state.copy()
    for i in range(rows.shape[0]):
        age = window.ages_s[i]
        past[:] = state
        past[0] += state[2] * age
        past[1] += state[3] * age
        past[4] += state[5] * age
        residual = rows[i, VALUE] - predict_row(rows[i], past, window.height_m, h)
        if is_cyclic(rows[i]):
            residual = wrap(residual)
        h[2] += age * h[0]
        h[3] += age * h[1]
        h[5] += age * h[4]
        w = 1.0 / rows[i, VARIANCE]
        cost += w * residual * residual
        for a in range(n):
            if h[a] != 0.0:  # few are not: a row names one or two of the slow errors
                b[a] += w * residual * h[a]
                for c in range(n):
                    A[a, c] += w * (h[a] * h[c])
    return cost, b, A
