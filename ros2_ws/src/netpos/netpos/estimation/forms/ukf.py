"""Unscented Kalman filter: sigma points instead of Jacobians, update in Joseph form. Everything
works in place."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from netpos.estimation.compile import kernel, spliced
from netpos.estimation.factor import factor, solve_factored
from netpos.estimation.forms.form import FilterForm
from netpos.estimation.gate import gate_groups, select_rows
from netpos.estimation.measurement import GATE_VARIANCE, VARIANCE
from netpos.estimation.motion import add_noise
from netpos.estimation.sigma import innovation_cov, move, regress
from netpos.messages.values import Array

if TYPE_CHECKING:
    from netpos.estimation.engine import FilterOptions


@kernel
def predict(mean: Array, cov: Array, dt: float, motion: Array, bias: Array) -> None:
    """Move mean (n,) and covariance (n, n) by ``dt`` seconds through the sigma points: petukhov:
    eq.19-22. Nothing happens for dt <= 0.

    motion : of ``motion_parameters``
    bias : (2, k) stationary sd and time constant of each bias state
    """
    if dt <= 0.0:
        return
    D = move(mean, factor(cov), dt, motion, bias)
    for a in range(mean.size):
        for b in range(a + 1):
            total = 0.0
            for j in range(D.shape[0]):
                total += D[j, a] * D[j, b]
            cov[a, b] = cov[b, a] = total
    add_noise(mean, dt, motion, bias, cov)


@kernel
def update(
    mean: Array, cov: Array, rows: Array, height_m: float, gate_nis: Array, accepted: Array
) -> tuple[float, int]:
    """One epoch, in place: sigma points redrawn from the prediction, each group of rows gated as a
    whole and all together, one joint update with what passed. Nothing changes where nothing
    passes.

    rows : (m, ROW_WIDTH), rows of a group adjacent
    gate_nis : (d + 1,) largest accepted squared Mahalanobis distance for d degrees of freedom
    accepted : (groups,), filled with 0 or 1

    Returns the NIS of the accepted rows together, with their gate variances, and their number.
    """
    L = factor(cov)
    innovation, G, E = regress(mean, L, rows, height_m)
    S = innovation_cov(G, E, rows[:, GATE_VARIANCE].copy())
    gate_groups(rows, innovation, S, gate_nis, accepted)
    index, nis = select_rows(rows, innovation, S, gate_nis, accepted)
    if index.size == 0:
        return 0.0, 0
    fuse(mean, cov, L, innovation[index], G[index], E[index], rows[index, VARIANCE])
    return nis, index.size


@kernel
def fuse(
    mean: Array, cov: Array, L: Array, innovation: Array, G: Array, E: Array, variance: Array
) -> None:
    """Update mean (n,) and cov (n, n), of factor ``L``, with rows as ``sigma.regress`` returns
    them.

    The Joseph form of the regression, (L - K G)(L - K G)' + K (E E' + R) K', equals P - K S K' and
    stays positive semidefinite.
    """
    n, m = mean.size, innovation.size
    Kt = G @ L.T
    solve_factored(factor(innovation_cov(G, E, variance)), Kt)
    A = L - Kt.T @ G
    B = Kt.T @ E
    for a in range(n):
        for i in range(m):
            mean[a] += Kt[i, a] * innovation[i]
        for b in range(a + 1):
            total = np.dot(A[a], A[b]) + np.dot(B[a], B[b])
            for i in range(m):
                total += Kt[i, a] * variance[i] * Kt[i, b]
            cov[a, b] = cov[b, a] = total


@spliced
def _update_form(
    mean: Array,
    cov: Array,
    rows: Array,
    options: FilterOptions,
    gate_nis: Array,
    accepted: Array,
    _work: Array,
) -> tuple[float, int]:
    nis, used = update(mean, cov, rows, options.height_m, gate_nis, accepted)
    return nis, used


FORM = FilterForm(name="ukf", predict=predict, update=_update_form)
