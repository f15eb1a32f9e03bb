"""Slow errors of RSUs where measurements bend: what is known of h(x) + b is no news of x.

A value y = h(x) + b + n with a slow error b tells h(x) + b. As long as b is open, x is open along
dx with H dx + db = 0, and an update must leave it so. An extended Kalman filter that linearises
the next value somewhere else, with another H, takes the turning of its own tangent for news: a
device that stands is placed ever more surely, wherever it was first thought to be (the
inconsistency of simultaneous localisation and mapping: Julier and Uhlmann 2001; Huang, Mourikis
and Roumeliotis 2010).

So the tangents are followed. Of x the slow errors b explain x_b = C B^-1 b, C the covariance of x
and b and B that of b. Where an estimate moves and the device does not, H x_b + b stays as well
known as it is, with the H of the new place. An update moves the estimate only. A prediction moves
the device, too, as far as its velocity is known: that H turns with a real way makes b better
known, and with a way that may be none it tells nothing. Means stay as they are: by how much
h(x) + b misses the value now, the next value tells.
"""

from __future__ import annotations

import numpy as np

from netpos.estimation.compile import inlined, kernel, leaf
from netpos.estimation.factor import factor, solve_factored
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    KIND,
    ORIGIN,
    REFERENCE,
    ROW_WIDTH,
    innovation_row,
    part_kind,
    slow_error_of,
)
from netpos.estimation.state import X
from netpos.estimation.update.fusion import W_COV, W_PRIOR_VARIANCE
from netpos.messages.values import Array


@inlined
def has_been_heard(rows: Array, i: int, work: Array) -> bool:
    """Whether the row ``i``, predicted in the workspace, has a slow error of which there have been
    values: its value is known better than the slow error alone."""
    error = slow_error_of(rows[i])
    return bool(error >= 0 and work[W_PRIOR_VARIANCE, i] < work[W_COV + error, error])


@leaf
def _write_tangents(
    row: Array, before: Array, mean: Array, height_m: float, tangents: Array
) -> None:
    """Write to ``tangents`` (2, n) the H of ``row`` at ``before`` (n,) and at ``mean`` (n,)."""
    innovation_row(row, before, height_m, tangents[0])
    innovation_row(row, mean, height_m, tangents[1])


@kernel
def follow_tangents(
    mean: Array,
    cov: Array,
    first: int,
    rows: Array,
    used: Array,
    before: Array,
    height_m: float,
) -> None:
    """After the estimate, now mean (n,), cov (n, n), has moved from ``before`` (n,) and the device
    has not, turn what the slow errors, the states from ``first`` on, explain of the others with
    the tangents of the rows ``used`` (m,); ``cov`` in place. Of a difference both RSUs have one,
    each of the quantity itself. A slow error that has not been heard stays as it is."""
    n, k, any_turns = mean.size, mean.size - first, False
    H, part = np.zeros((k, 2, n)), np.empty(ROW_WIDTH)
    for i in range(rows.shape[0]):
        error = slow_error_of(rows[i])
        if used[i] == 0.0 or error < first:
            continue
        reference, kind = int(rows[i, REFERENCE]), part_kind(int(rows[i, KIND]))
        part[:] = rows[i]
        if kind >= 0:
            part[KIND], part[COMMON], part[REFERENCE] = kind, -1.0, 0.0
        any_turns = True
        _write_tangents(part, before, mean, height_m, H[error - first])
        if reference > 0:
            for c in range(3):
                part[ORIGIN + c] += part[AXES + c]
            part[BIAS] = reference
            _write_tangents(part, before, mean, height_m, H[reference - first])
    if not any_turns:
        return
    B, C = cov[first:, first:].copy(), cov[:first, first:].copy()
    explained = cov[first:].copy()
    solve_factored(factor(B), explained)
    of_x = explained[:, :first].T.copy()
    told = H[:, 0].copy() @ explained.T.copy()
    told_var = (told @ B * told).sum(axis=1)
    A = np.eye(k) + (H[:, 0, :first] - H[:, 1, :first]) @ of_x
    for e in range(k):
        if told_var[e] >= B[e, e]:
            A[e] = 0.0
            A[e, e] = 1.0
    B, C = A @ B @ A.T, C @ A.T
    cov[first:, first:] = 0.5 * (B + B.T)
    cov[:first, first:] = C
    cov[first:, :first] = C.T


@kernel
def follow_prediction(
    mean: Array, cov: Array, first: int, rows: Array, dt_s: float, height_m: float
) -> None:
    """After a prediction by ``dt_s`` seconds to mean (n,), cov (n, n), ``follow_tangents`` of the
    rows (m, ROW_WIDTH) along the part of the way that may be none: that of the variance of the
    velocity in its expected square."""
    unknown = cov[X.VX, X.VX] + cov[X.VY, X.VY]
    square = unknown + mean[X.VX] ** 2 + mean[X.VY] ** 2
    if dt_s <= 0.0 or square <= 0.0:
        return
    before, used = mean.copy(), np.ones(rows.shape[0])
    before[X.PX] -= unknown / square * dt_s * mean[X.VX]
    before[X.PY] -= unknown / square * dt_s * mean[X.VY]
    follow_tangents(mean, cov, first, rows, used, before, height_m)
