"""Cost of a state against all measurements of a window, in parts of which the accelerations of the
device and of its clock are constant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.measurement import VALUE, VARIANCE, is_cyclic, predict_row, wrap
from netpos.estimation.state import X
from netpos.messages.values import Array

_MOVES = ((int(X.PX), int(X.VX)), (int(X.PY), int(X.VY)), (int(X.CLOCK), int(X.DRIFT)))


class Window(NamedTuple):
    """Measurements of a short time.

    ages_s (m,) : when each was made, <= 0 before the stamp of the state
    rows (m, ROW_WIDTH) : the slow errors in them are states behind those of the device
    height_m : nominal height of the device
    first, part_s : index of the accelerations [m/s^2] of the device, two, and of its clock, in
        ``parts`` of so many seconds each, the newest first
    """

    ages_s: Array
    rows: Array
    height_m: float
    first: int
    part_s: float
    parts: int


@leaf
def _moved(age_s: float, part: int, part_s: float) -> tuple[float, float]:
    """By how many seconds an acceleration of one ``part`` changes the speed at ``age_s`` <= 0, and
    by how many s^2 the place."""
    since = -age_s - part * part_s
    lasts = min(since, part_s)
    if lasts <= 0.0:
        return 0.0, 0.0
    return -lasts, lasts * (since - 0.5 * lasts)


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
        for place, rate in _MOVES:
            past[place] += state[rate] * age
        for part in range(window.parts):
            faster, farther = _moved(age, part, window.part_s)
            for k in range(3):
                (place, rate), at = _MOVES[k], window.first + 3 * part + k
                past[place] += farther * state[at]
                past[rate] += faster * state[at]
        residual = rows[i, VALUE] - predict_row(rows[i], past, window.height_m, h)
        if is_cyclic(rows[i]):
            residual = wrap(residual)
        for part in range(window.parts):
            faster, farther = _moved(age, part, window.part_s)
            for k in range(3):
                (place, rate), at = _MOVES[k], window.first + 3 * part + k
                h[at] += farther * h[place] + faster * h[rate]
        for place, rate in _MOVES:
            h[rate] += age * h[place]
        w = 1.0 / rows[i, VARIANCE]
        cost += w * residual * residual
        for a in range(n):
            if h[a] != 0.0:  # few are not: a row names one or two of the slow errors
                b[a] += w * residual * h[a]
                for c in range(n):
                    A[a, c] += w * (h[a] * h[c])
    return cost, b, A
