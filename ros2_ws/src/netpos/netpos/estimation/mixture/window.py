"""Cost of a state against all measurements of a window, in which the acceleration is constant."""

from __future__ import annotations

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import VALUE, VARIANCE, is_cyclic, predict_row, wrap
from netpos.messages.values import Array


@kernel
def normal_equations(
    state: Array, ages_s: Array, rows: Array, height_m: float, prior: Array, prior_var: Array
) -> tuple[float, Array, Array]:
    """Cost, gradient (n,) and Gauss-Newton Hessian (n, n) of the fit at ``state`` (n,), the last
    two entries of which are the acceleration; ``ages_s`` <= 0 before its stamp."""
    A = np.diag(1.0 / prior_var)
    difference = prior - state
    b = difference / prior_var
    cost = float((difference * b).sum())
    n = state.size
    h, seen = np.zeros(n), np.zeros(n, dtype=np.int64)
    past = state.copy()
    for i in range(rows.shape[0]):
        age = ages_s[i]
        past[:] = state
        half = 0.5 * age * age
        past[0] += state[2] * age + state[n - 2] * half
        past[1] += state[3] * age + state[n - 1] * half
        past[2] += state[n - 2] * age
        past[3] += state[n - 1] * age
        past[4] += state[5] * age
        residual = rows[i, VALUE] - predict_row(rows[i], past, height_m, h)
        if is_cyclic(rows[i]):
            residual = wrap(residual)
        h[n - 2] += half * h[0] + age * h[2]
        h[n - 1] += half * h[1] + age * h[3]
        h[2] += age * h[0]
        h[3] += age * h[1]
        h[5] += age * h[4]
        w = 1.0 / rows[i, VARIANCE]
        cost += w * residual * residual
        count = 0
        for a in range(n):
            if h[a] != 0.0:
                seen[count] = a
                count += 1
        for a in seen[:count]:
            b[a] += w * residual * h[a]
            for c in seen[:count]:
                A[a, c] += w * h[a] * h[c]
    return cost, b, A
