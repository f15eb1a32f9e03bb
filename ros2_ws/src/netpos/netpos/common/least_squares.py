"""Nonlinear least squares by Levenberg-Marquardt (Marquardt 1963).

For what a node solves while it runs: SciPy's optimiser would cost it 24 MB.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_ITERATIONS = 100
_DAMPING, _DAMPING_MIN, _DAMPING_MAX = 1e-3, 1e-12, 1e8
_GAIN_MIN = 1e-6  # of the cost, beside 1


def minimise(
    equations: Callable[[Array], tuple[float, Array, Array]],
    start: Array,
    solve: Callable[..., Array],
) -> tuple[float, Array, Array]:
    """Cost, state (n,) and normal matrix (n, n) where the cost no longer falls.

    equations : cost r'r, J'r (n,) and J'J (n, n) of the residuals r = z - h(state), J = dh/dstate
    solve : x of A x = b by (A, b), for A (n, n) positive definite; what it raises is passed on
    """
    state, damping = start, _DAMPING
    cost, b, A = equations(state)
    for _ in range(_ITERATIONS):
        damped = A.copy()
        np.fill_diagonal(damped, (1.0 + damping) * A.diagonal())
        tried = state + solve(damped, b)
        new_cost, new_b, new_A = equations(tried)
        if new_cost < cost:
            done = cost - new_cost < _GAIN_MIN * (1.0 + cost)
            state, cost, b, A = tried, new_cost, new_b, new_A
            damping = max(damping / 10.0, _DAMPING_MIN)
            if done:
                break
        else:
            damping *= 10.0
            if damping > _DAMPING_MAX:
                break
    return cost, state, A
