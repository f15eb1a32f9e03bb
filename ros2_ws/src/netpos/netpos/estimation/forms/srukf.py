"""Square-root unscented Kalman filter: carries the lower factor L of P = L L'. In place.

Nothing is ever squared, so variances 1e20 apart live side by side. Prediction is a QR
decomposition of the weighted deviations and the noise's factor by rotations (one Cholesky up-date
per deviation: petukhov:eq.22). The update rotates

    [ chol(E E' + R)   G ]      [ chol(S)             0  ]
    [ 0                L ]  to  [ L G' chol(S)^-T     L+ ]

which gives the factor that down-dating L by the columns of K chol(S) gives (petukhov:eq.26, which
omits chol(S)). A down-date fails where rounding makes its result indefinite; a rotation cannot:
each diagonal entry of L is multiplied by a cosine that is positive while R is.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from netpos.estimation.compile import inlined, kernel, leaf, spliced
from netpos.estimation.factor import factor
from netpos.estimation.forms.form import FilterForm
from netpos.estimation.forms.sigma import innovation_cov, move, regress
from netpos.estimation.measurement import GATE_VARIANCE, VARIANCE
from netpos.estimation.motion import noise
from netpos.estimation.state import X
from netpos.estimation.update.gate import gate_groups, select_rows
from netpos.messages.values import Array

if TYPE_CHECKING:
    from netpos.estimation.engine import FilterOptions


@kernel
def write_cov(L: Array, cov: Array) -> None:
    """Write P = L L' of a factor (n, n) to ``cov`` (n, n)."""
    cov[:] = L @ L.T


@leaf
def _up_date(L: Array, x: Array) -> None:
    """The rotations that turn [L x] into a factor."""
    n = x.size
    for k in range(n):
        if x[k] == 0.0:
            continue
        length = math.hypot(L[k, k], x[k])
        c, s = L[k, k] / length, x[k] / length
        L[k, k] = length
        for i in range(k + 1, n):
            below = L[i, k]
            L[i, k] = c * below + s * x[i]
            x[i] = c * x[i] - s * below


@inlined
def _rotate(first: Array, second: Array, start: int, c: float, s: float) -> None:
    """Rotate two columns from entry ``start`` on."""
    for i in range(start, first.size):
        a, b = first[i], second[i]
        first[i] = c * a + s * b
        second[i] = c * b - s * a


@kernel
def predict(mean: Array, L: Array, dt: float, motion: Array, bias: Array) -> None:
    """Move mean (n,) and factor ``L`` (n, n) by ``dt`` seconds through the sigma points: petukhov:
    eq.19-22. Nothing happens for dt <= 0.

    motion : of ``motion_parameters``
    bias : (2, k) stationary sd and time constant of each bias state
    """
    if dt <= 0.0:
        return
    D = move(mean, L, dt, motion, bias)
    Q = np.empty_like(L)
    noise(mean, dt, motion, bias, Q)
    L[:] = factor(Q)
    for j in range(D.shape[0]):
        _up_date(L, D[j])


@kernel
def update(
    mean: Array, L: Array, rows: Array, height_m: float, gate_nis: Array, accepted: Array
) -> tuple[float, int]:
    """One epoch of mean (n,) and factor ``L`` (n, n), in place: sigma points redrawn from the
    prediction, each group of rows gated as a whole and all together, one joint update with what
    passed. Nothing changes where nothing passes.

    rows : (m, ROW_WIDTH), rows of a group adjacent
    gate_nis : (d + 1,) largest accepted squared Mahalanobis distance for d degrees of freedom
    accepted : (groups,), filled with 0 or 1

    Returns the NIS of the accepted rows together, with their gate variances, and their number.
    """
    innovation, G, E = regress(mean, L, rows, height_m)
    S = innovation_cov(G, E, rows[:, GATE_VARIANCE].copy())
    gate_groups(rows, innovation, S, gate_nis, accepted)
    index, nis = select_rows(rows, innovation, S, gate_nis, accepted)
    if index.size == 0:
        return 0.0, 0
    if index.size < rows.shape[0]:
        innovation, G, E = innovation[index], G[index], E[index]
    fuse(mean, L, innovation, G, E, rows[index, VARIANCE])
    return nis, index.size


@kernel
def fuse(mean: Array, L: Array, innovation: Array, G: Array, E: Array, variance: Array) -> None:
    """Update mean (n,) and factor (n, n) with rows as ``sigma.regress`` returns them; ``G`` and
    ``innovation`` are used up."""
    n, m = mean.size, innovation.size
    S = np.zeros((m, m))  # the factor: first of E E' + R, then of the whole
    for i in range(m):
        S[i, i] = math.sqrt(variance[i])
    column, gain = np.empty(m), np.empty(n)
    for j in range(E.shape[1]):
        column[:] = E[:, j]
        _up_date(S, column)
    for i in range(m):
        _eliminate(i, S, G, L, gain)
        for k in range(i):
            innovation[i] -= S[i, k] * innovation[k]
        innovation[i] /= S[i, i]
        for a in range(n):
            mean[a] += gain[a] * innovation[i]


@leaf
def _eliminate(i: int, S: Array, G: Array, L: Array, gain: Array) -> None:
    """Rotate row ``i`` of G (m, n) into S (m, m), and what of the factor goes with it into
    ``gain`` (n,)."""
    gain[:] = 0.0
    for j in range(gain.size - 1, -1, -1):
        if G[i, j] == 0.0:
            continue
        length = math.hypot(S[i, i], G[i, j])
        c, s = S[i, i] / length, G[i, j] / length
        _rotate(S[:, i], G[:, j], i, c, s)
        _rotate(gain, L[:, j], j, c, s)


@kernel
def add_velocity_step(sd: float, time_s: float, position_sd: float, L: Array) -> None:
    """``motion.add_velocity_step`` to the factor ``L`` (n, n)."""
    if sd == 0.0:
        return
    for p in range(2):
        x = np.zeros(L.shape[0])
        x[X.PX + p], x[X.VX + p] = sd * time_s, sd
        _up_date(L, x)
    for p in range(2):
        x = np.zeros(L.shape[0])
        x[X.PX + p] = position_sd
        _up_date(L, x)


@kernel
def _write_factor(cov: Array, L: Array) -> None:
    L[:] = factor(cov)


@spliced
def _update_form(
    mean: Array,
    L: Array,
    rows: Array,
    options: FilterOptions,
    gate_nis: Array,
    accepted: Array,
    _work: Array,
) -> tuple[float, int]:
    nis, used = update(mean, L, rows, options.height_m, gate_nis, accepted)
    return nis, used


FORM = FilterForm(
    name="srukf",
    predict=predict,
    update=_update_form,
    add_velocity_step=add_velocity_step,
    write_cov=write_cov,
    write_cov_or_sqrt=_write_factor,
    summary="square root",
)
