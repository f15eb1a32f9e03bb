"""Nonlinear least squares by Levenberg-Marquardt (Marquardt 1963).

For what a node solves while it runs: SciPy's optimiser would cost it 24 MB. The loop is made for
its equations: it may be compiled together with them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Minimise = Callable[[Array, Any], tuple[float, Array, Array]]

_ITERATIONS = 100
_DAMPING, _DAMPING_MIN, _DAMPING_MAX = 1e-3, 1e-12, 1e8
_GAIN_MIN = 1e-6  # of the cost, beside 1


def minimiser(
    equations: Callable[[Array, Any], tuple[float, Array, Array]],
    solve: Callable[..., Array],
) -> Minimise:
    """A function ``minimise(start, given)`` that returns cost, state (n,) and normal matrix (n, n)
    where the cost no longer falls.

    equations : cost r'r, J'r (n,) and J'J (n, n) of the residuals r = z - h(state), J = dh/dstate,
        at a state (n,), by what is ``given`` beside it
    solve : x of A x = b by (A, b), for A (n, n) positive definite; what it raises is passed on
    """

    def minimise(start: Array, given: Any) -> tuple[float, Array, Array]:
        state, damping = start, _DAMPING
        cost, b, A = equations(state, given)
        for _ in range(_ITERATIONS):
            damped = A.copy()
            for i in range(state.size):
                damped[i, i] *= 1.0 + damping
            tried = state + solve(damped, b)
            new_cost, new_b, new_A = equations(tried, given)
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

    return minimise
