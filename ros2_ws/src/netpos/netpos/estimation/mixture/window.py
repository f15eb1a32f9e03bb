"""Cost of a state against all measurements of a window, the device moving straight in it."""

from __future__ import annotations

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import VALUE, VARIANCE, is_cyclic, predict_row, wrap
from netpos.messages.values import Array


@kernel
def normal_equations(
    state: Array, ages_s: Array, rows: Array, height_m: float, prior: Array, prior_var: Array
) -> tuple[float, Array, Array]:
    """Cost, gradient (n,) and Gauss-Newton Hessian (n, n) of the fit at ``state`` (n,); ``ages_s``
    <= 0 before its stamp."""
    A = np.diag(1.0 / prior_var)
    difference = prior - state
    b = difference / prior_var
    cost = float((difference * b).sum())
    h = np.zeros(state.size)
    past = state.copy()
    for i in range(rows.shape[0]):
        age = ages_s[i]
        past[:] = state
        past[0] += state[2] * age
        past[1] += state[3] * age
        past[4] += state[5] * age
        residual = rows[i, VALUE] - predict_row(rows[i], past, height_m, h)
        if is_cyclic(rows[i]):
            residual = wrap(residual)
        h[2] += age * h[0]
        h[3] += age * h[1]
        h[5] += age * h[4]
        w = 1.0 / rows[i, VARIANCE]
        cost += w * residual * residual
        for a in range(state.size):
            b[a] += w * residual * h[a]
            for c in range(state.size):
                A[a, c] += w * h[a] * h[c]
    return cost, b, A
