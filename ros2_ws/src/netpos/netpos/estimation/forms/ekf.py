"""Extended and iterated extended Kalman filter: prediction, gating by group, update. Everything
works in place."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from netpos.estimation.compile import inlined, kernel, leaf, local_array, spliced
from netpos.estimation.forms.form import FilterForm
from netpos.estimation.measurement import GATE_VARIANCE, GROUP, VARIANCE, same_bend_variance
from netpos.estimation.motion import add_noise, is_straight, propagate, transition
from netpos.estimation.sensors.row import group_end
from netpos.estimation.state import N_CORE, X
from netpos.estimation.update.bearing import fuse_around, on_top
from netpos.estimation.update.fit import map_cost
from netpos.estimation.update.fusion import (
    W_COV,
    W_GATE_VARIANCE,
    W_INNOVATION,
    W_PRIOR,
    W_PRIOR_VARIANCE,
    W_SECOND_ORDER,
    W_USE,
    W_VARIANCE,
    fuse,
    fuse_by_factor,
    group_nis,
    is_definite,
    keeps_digits,
    predicted_in,
    workspace,
)
from netpos.estimation.update.gate import fail_together, leave_minority_out
from netpos.estimation.update.iteration import (
    is_curved,
    is_wide,
    iterate,
    iterate_from,
    iterate_used,
    refine_used,
)
from netpos.estimation.update.predicted import predict_rows, prior_cov_of
from netpos.estimation.update.slow_errors import follow_tangents
from netpos.messages.values import Array

if TYPE_CHECKING:
    from netpos.estimation.engine import FilterOptions

__all__ = [
    "fuse",
    "gate",
    "group_nis",
    "iterate",
    "iterate_from",
    "predict",
    "update",
    "workspace",
]


@leaf
def predict(mean: Array, cov: Array, dt: float, motion: Array, bias: Array) -> None:
    """Move mean (n,) and covariance (n, n) by ``dt`` seconds: fokin2020:eq.21, 22. Nothing
    happens for dt <= 0.

    motion : of ``motion_parameters``
    bias : (2, k) stationary sd and time constant of each bias state
    """
    if dt <= 0.0:
        return
    if not is_straight(motion):
        _predict_dense(mean, cov, dt, motion, bias)
    elif mean.size == N_CORE:
        _predict_core(cov, dt)
    else:
        _predict_biased(cov, dt, bias)
    propagate(mean, dt, motion, bias)
    add_noise(mean, dt, motion, bias, cov)


@kernel
def _predict_dense(mean: Array, cov: Array, dt: float, motion: Array, bias: Array) -> None:
    F = np.empty_like(cov)
    transition(mean, dt, motion, bias, F)
    moved = F @ cov @ F.T
    cov[:] = (moved + moved.T) / 2.0


@inlined
def _shear(n: int, P: Array, dt: float) -> None:
    """F P F' of a constant velocity by the few row and column operations F stands for."""
    for p, v in ((X.PX, X.VX), (X.PY, X.VY), (X.CLOCK, X.DRIFT)):
        for j in range(n):
            P[p, j] += dt * P[v, j]
        for i in range(n):
            P[i, p] += dt * P[i, v]


@leaf
def _predict_core(cov: Array, dt: float) -> None:
    """F P F' of a constant velocity without biases."""
    n = N_CORE
    P = local_array(N_CORE, N_CORE)
    for a in range(n):
        for b in range(n):
            P[a, b] = cov[a, b]
    _shear(n, P, dt)
    for a in range(n):
        for b in range(a + 1):
            cov[a, b] = cov[b, a] = (P[a, b] + P[b, a]) / 2.0


@leaf
def _predict_biased(cov: Array, dt: float, bias: Array) -> None:
    """F P F' of a constant velocity with biases."""
    n = cov.shape[0]
    _shear(n, cov, dt)
    for b in range(bias.shape[1]):
        decay = math.exp(-dt / bias[1, b])
        k = N_CORE + b
        for j in range(n):
            cov[k, j] *= decay
        for i in range(n):
            cov[i, k] *= decay
    for a in range(n):
        for b in range(a):
            cov[a, b] = cov[b, a] = (cov[a, b] + cov[b, a]) / 2.0


@leaf
def _small_nis(start: int, stop: int, work: Array, n: int, m: int) -> float:
    """``group_nis`` of one or two rows of the workspace."""
    first, second, ph = W_COV + n + start, W_COV + n + start + 1, m
    r0, r1 = work[W_INNOVATION, start], 0.0
    s00 = work[W_GATE_VARIANCE, start] + work[W_PRIOR_VARIANCE, start]
    s01, s11 = 0.0, 1.0
    if stop - start == 2:
        r1 = work[W_INNOVATION, start + 1]
        s11 = work[W_GATE_VARIANCE, start + 1] + work[W_PRIOR_VARIANCE, start + 1]
        for a in range(n):
            s01 += work[first, a] * work[second + ph, a]
    rest = r1 - s01 / s00 * r0
    return float(r0 * r0 / s00 + rest * rest / (s11 - s01 * s01 / s00))


@kernel
def _large_nis(cov: Array, start: int, stop: int, work: Array, m: int) -> float:
    """``group_nis`` of rows of the workspace."""
    n = cov.shape[0]
    H = work[W_COV + n + start : W_COV + n + stop, :n].copy()
    innovation, variance = work[W_INNOVATION, start:stop], work[W_GATE_VARIANCE, start:stop]
    return float(group_nis(cov, innovation, H, variance))


@leaf
def _passes(
    mean: Array,
    cov: Array,
    rows: Array,
    group: tuple[int, int],
    height_m: float,
    threshold: float,
    iterations: int,
    work: Array,
) -> bool:
    """Whether one group, (first row, row after its last), lies within ``threshold`` of squared
    Mahalanobis distance of the prediction.

    Where the linear distance says no and iterating is allowed, the ``map_cost`` of the most
    probable state decides.
    """
    start, stop = group
    if stop - start <= 2:
        nis = _small_nis(start, stop, work, mean.size, rows.shape[0])
    else:
        nis = _large_nis(cov, start, stop, work, rows.shape[0])
    if nis <= threshold:
        return True
    if iterations <= 1:
        return False
    return bool(_least_cost(mean, cov, rows, group, height_m, iterations, work) <= threshold)


@kernel
def _least_cost(
    mean: Array,
    cov: Array,
    rows: Array,
    group: tuple[int, int],
    height_m: float,
    iterations: int,
    work: Array,
) -> float:
    """``map_cost`` of the most probable state of one group."""
    some = rows[group[0] : group[1]]
    variance = work[W_GATE_VARIANCE, group[0] : group[1]].copy()
    x, _ = iterate(mean, cov, some, variance, height_m, iterations, work)
    return float(map_cost(mean, cov, some, variance, height_m, x))


@inlined
def gate(
    mean: Array,
    cov: Array,
    rows: Array,
    height_m: float,
    gate_nis: Array,
    iterations: int,
    accepted: Array,
    work: Array,
) -> int:
    """Accept or reject each group of the rows predicted in the workspace as a whole; returns the
    number of rows to fuse."""
    m = rows.shape[0]
    is_open = math.isinf(gate_nis[gate_nis.size - 1])
    for i in range(m):
        bent = work[W_SECOND_ORDER, i]
        work[W_GATE_VARIANCE, i] = rows[i, GATE_VARIANCE] + bent
        bent = same_bend_variance(rows[i], mean, cov, height_m, bent)
        work[W_VARIANCE, i] = rows[i, VARIANCE] + bent
    used, start = 0, 0
    while start < m:
        group = int(rows[start, GROUP])
        stop = group_end(rows, start)
        threshold = gate_nis[min(stop - start, gate_nis.size - 1)]
        taken = is_open or _passes(
            mean, cov, rows, (start, stop), height_m, threshold, iterations, work
        )
        accepted[group] = 1.0 if taken else 0.0
        for i in range(start, stop):
            work[W_USE, i] = accepted[group]
        used += stop - start if taken else 0
        start = stop
    return used


@leaf
def update(
    mean: Array,
    cov: Array,
    rows: Array,
    height_m: float,
    gate_nis: Array,
    iterations: int,
    accepted: Array,
    work: Array,
) -> tuple[float, int]:
    """One epoch, in place: gate each group as a whole, fuse what passed. Where three or more pass
    one by one but not together, a minority without which the others agree is left out.

    rows : (m, ROW_WIDTH), rows of a group adjacent, groups numbered 0, 1, ... in order
    gate_nis : (d + 1,) largest accepted squared Mahalanobis distance for d degrees of freedom
        (last entry inf: no gate)
    iterations : linearisations at most; 1 is the extended Kalman filter
    accepted : (groups,), filled with 0 or 1
    work : of ``workspace``, filled

    Returns the NIS of the accepted rows together and their number.
    """
    predict_rows(mean, cov, rows, height_m, predicted_in(work, mean.size, rows.shape[0]))
    nis, used, _ = update_predicted(
        mean, cov, rows, height_m, gate_nis, iterations, accepted, work
    )
    return nis, used


@leaf
def update_predicted(
    mean: Array,
    cov: Array,
    rows: Array,
    height_m: float,
    gate_nis: Array,
    iterations: int,
    accepted: Array,
    work: Array,
) -> tuple[float, int, bool]:
    """``update`` with rows that are predicted in the workspace already; also whether it linearised
    them there only."""
    used = gate(mean, cov, rows, height_m, gate_nis, iterations, accepted, work)
    if used == 0:
        return 0.0, 0, False
    nis = _fuse_used(mean, cov, rows, work)
    if fail_together(nis, used, gate_nis):
        dropped = _minority_out(rows, mean.size, gate_nis, accepted, work)
        if dropped > 0:
            used -= dropped
            for a in range(mean.size):
                mean[a] = work[W_PRIOR, a]
                for b in range(mean.size):
                    cov[a, b] = work[W_COV + a, b]
            nis = _fuse_used(mean, cov, rows, work)
    curved, wide = False, False
    if iterations > 1:
        curved, wide = is_curved(rows, mean, height_m, work), is_wide(rows, work)
        if curved or wide:
            iterate_used(mean, cov, rows, height_m, iterations, work)
            if on_top(mean, cov, rows, work):
                fuse_around(mean, cov, rows, height_m, work)
        if wide:
            refine_used(mean, cov, rows, height_m, work)
        if (curved or wide) and not is_definite(cov, work):
            fuse_by_factor(mean, cov, rows.shape[0], work)
    return nis, used, not (curved or wide)


@leaf
def _fuse_used(mean: Array, cov: Array, rows: Array, work: Array) -> float:
    """Fuse the rows used; their joint NIS."""
    n, m = mean.size, rows.shape[0]
    coloured = False
    for i in range(m):
        coloured |= work[W_USE, i] == 1.0 and work[W_VARIANCE, i] != work[W_GATE_VARIANCE, i]
    nis = _coloured_nis(cov, m, work) if coloured else 0.0
    for a in range(n):
        work[W_PRIOR, a] = mean[a]
        for b in range(n):
            work[W_COV + a, b] = cov[a, b]
    H = work[W_COV + n : W_COV + n + m]
    distance = fuse(mean, cov, work[W_INNOVATION], H, work[W_VARIANCE], work[W_USE], work)
    if not coloured:
        nis = distance
    if not keeps_digits(cov, work):
        fuse_by_factor(mean, cov, rows.shape[0], work)
    return nis


@kernel
def _minority_out(rows: Array, n: int, gate_nis: Array, accepted: Array, work: Array) -> int:
    """``gate.leave_minority_out`` of the rows in the workspace; the number of rows taken out."""
    m = rows.shape[0]
    S = prior_cov_of(predicted_in(work, n, m), np.arange(m), n)
    for i in range(m):
        S[i, i] += work[W_GATE_VARIANCE, i]
    if not leave_minority_out(rows, work[W_INNOVATION, :m].copy(), S, gate_nis, accepted):
        return 0
    taken_out = 0
    for i in range(m):
        if work[W_USE, i] == 1.0 and accepted[int(rows[i, GROUP])] == 0.0:
            work[W_USE, i] = 0.0
            taken_out += 1
    return taken_out


@kernel
def _coloured_nis(cov: Array, m: int, work: Array) -> float:
    """NIS of the rows used where their gate variances differ from those of the update."""
    n = cov.shape[0]
    keep = work[W_USE, :m] == 1.0
    H = work[W_COV + n : W_COV + n + m, :n][keep]
    innovation, variance = work[W_INNOVATION, :m][keep], work[W_GATE_VARIANCE, :m][keep]
    return float(group_nis(cov, innovation, H, variance))


@spliced
def _update_form(
    mean: Array,
    cov: Array,
    rows: Array,
    options: FilterOptions,
    gate_nis: Array,
    accepted: Array,
    work: Array,
) -> tuple[float, int]:
    height_m, iterations = options.height_m, options.iterations
    nis, used, at_prior = update_predicted(
        mean, cov, rows, height_m, gate_nis, iterations, accepted, work
    )
    if at_prior and mean.size > options.first_slow_error:
        used_rows, before = work[W_USE, : rows.shape[0]], work[W_PRIOR, : mean.size]
        first = options.first_slow_error
        follow_tangents(mean, cov, first, rows, used_rows, before, height_m)
    return nis, used


EKF = FilterForm(name="ekf", predict=predict, update=_update_form, is_extended=True)
IEKF = FilterForm(
    name="iekf",
    predict=predict,
    update=_update_form,
    summary="linearised again at its own result",
    iterations=8,
    is_extended=True,
)
