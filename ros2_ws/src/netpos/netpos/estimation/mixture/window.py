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
    rows (m, ROW_WIDTH) : without states of slow errors
    shared (m,) : the error that a row has in common with others, -1: none
    shared_var (k,) : variance of each of these errors
    height_m : nominal height of the device
    """

    ages_s: Array
    rows: Array
    shared: Array
    shared_var: Array
    height_m: float


@kernel
def normal_equations(
    state: Array, window: Window, prior: Array, prior_var: Array
) -> tuple[float, Array, Array]:
    """Cost, gradient (n,) and Gauss-Newton Hessian (n, n) of the fit at ``state`` (n,). Errors
    that rows share are eliminated: rows with the variances d and the common error of variance c
    weigh D^-1 - D^-1 1 1' D^-1 / (1 / c + 1' D^-1 1), the inverse of D + c 1 1' (Woodbury)."""
    rows, n, k = window.rows, state.size, window.shared_var.size
    A = np.diag(1.0 / prior_var)
    difference = prior - state
    b = difference / prior_var
    cost = float((difference * b).sum())
    weight, by_residual, by_h = np.zeros(k), np.zeros(k), np.zeros((k, n))
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
        b += w * residual * h
        A += w * np.outer(h, h)
        error = int(window.shared[i])
        if error >= 0:
            weight[error] += w
            by_residual[error] += w * residual
            by_h[error] += w * h
    for error in range(k):
        share = 1.0 / (1.0 / window.shared_var[error] + weight[error])
        cost -= share * by_residual[error] ** 2
        b -= share * by_residual[error] * by_h[error]
        A -= share * np.outer(by_h[error], by_h[error])
    return cost, b, A
