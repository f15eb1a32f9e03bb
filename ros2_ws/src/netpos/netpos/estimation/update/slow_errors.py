"""Slow errors of RSUs where measurements bend: what is known of h(x) + b is no news of x.

A value y = h(x) + b + n with a slow error b tells h(x) + b. As long as b is open, x is open along
dx with H dx + db = 0, and an update must leave it so. An extended Kalman filter that linearises
the next value somewhere else, with another H, takes the turning of its own tangent for news: a
device that stands is placed ever more surely, wherever it was first thought to be (the
inconsistency of simultaneous localisation and mapping: Julier and Uhlmann 2001; Huang, Mourikis
and Roumeliotis 2010).

So after an update each slow error is taken anew as what is left of h(x) + b at the new place: the
filter has then the states x and h(x) + b, in which such a value is linear, and writes b in the
place of the second.
"""

from __future__ import annotations

import math

from netpos.estimation.compile import inlined, leaf, local_array
from netpos.estimation.measurement import (
    AXES,
    KIND,
    ORIGIN,
    REFERENCE,
    ROW_WIDTH,
    curvature_mean,
    curvature_variance,
    innovation_row,
    is_cyclic,
    part_kind,
    slow_error_of,
    wrap,
)
from netpos.estimation.update.fusion import (
    W_COV,
    W_GAIN,
    W_PH,
    W_PRIOR,
    W_PRIOR_VARIANCE,
    W_STEP,
    W_USE,
)
from netpos.messages.values import Array

LASTS_S = 1.0
"""What linearising leaves out of a value is a part of its slow error that lasts so long."""


@inlined
def has_been_heard(rows: Array, i: int, work: Array) -> bool:
    """Whether the row ``i``, predicted in the workspace, has a slow error of which there have been
    values: its value is known better than the slow error alone."""
    error = slow_error_of(rows[i])
    return bool(error >= 0 and work[W_PRIOR_VARIANCE, i] < work[W_COV + error, error])


@leaf
def _take_anew(
    error: int, row: Array, mean: Array, cov: Array, height_m: float, work: Array
) -> None:
    """Write into the state ``error`` what is left of h(x) + b of ``row`` at ``mean`` (n,), in
    place; the prior is in the workspace."""
    n = mean.size
    prior, before, after, along = work[W_PRIOR], work[W_STEP], work[W_PH], work[W_GAIN]
    rise = innovation_row(row, prior[:n], height_m, before)
    rise -= innovation_row(row, mean, height_m, after)
    left = -wrap(rise) if is_cyclic(row) else -rise
    left += curvature_mean(row, prior[:n], work[W_COV : W_COV + n, :n], height_m)
    left -= curvature_mean(row, mean, cov, height_m)
    for a in range(n):
        left += before[a] * (mean[a] - prior[a])
        before[a] -= after[a]
    own = 0.0
    for a in range(n):
        along[a] = 0.0
        for b in range(n):
            along[a] += cov[a, b] * before[b]
    for a in range(n):
        own += before[a] * along[a]
    mean[error] += left
    for a in range(n):
        cov[error, a] += along[a]
        cov[a, error] += along[a]
    cov[error, error] += own


@inlined
def _is_first(rows: Array, i: int, error: int, work: Array) -> bool:
    """Whether no row used before ``i`` has the slow error."""
    for k in range(i):
        own = slow_error_of(rows[k]) == error or int(rows[k, REFERENCE]) == error
        if own and work[W_USE, k] == 1.0:
            return False
    return True


@leaf
def follow_tangents(mean: Array, cov: Array, rows: Array, height_m: float, work: Array) -> None:
    """Take the slow errors of the rows used anew after an update to mean (n,) and cov (n, n), in
    place: x and h(x) + b keep what the update, linearised at the prior in the workspace, gave
    them. Of a difference both RSUs have one, each with the quantity itself."""
    part = local_array(ROW_WIDTH)
    for i in range(rows.shape[0]):
        error = slow_error_of(rows[i])
        if work[W_USE, i] == 0.0 or error < 0:
            continue
        reference, kind = int(rows[i, REFERENCE]), part_kind(int(rows[i, KIND]))
        for c in range(ROW_WIDTH):
            part[c] = rows[i, c]
        if kind >= 0:
            part[KIND] = kind
        if _is_first(rows, i, error, work):
            _take_anew(error, part, mean, cov, height_m, work)
        if reference > 0 and _is_first(rows, i, reference, work):
            for c in range(3):
                part[ORIGIN + c] += part[AXES + c]
            _take_anew(reference, part, mean, cov, height_m, work)


@leaf
def with_linearisation(
    mean: Array, cov: Array, rows: Array, height_m: float, bias: Array, widened: Array
) -> None:
    """Write to ``widened`` (2, k) the table ``bias``, stationary sd and time constant of each slow
    error, for a step to ``rows``: in those that they have, what linearising leaves out at mean
    (n,), cov (n, n) is a second Gauss-Markov process. The sum of the two is taken for one process
    of their variance, which renews itself as fast as both together."""
    k = bias.shape[1]
    first = mean.size - k
    for c in range(k):
        widened[0, c], widened[1, c] = bias[0, c], bias[1, c]
    for i in range(rows.shape[0]):
        c = slow_error_of(rows[i]) - first
        if c >= 0:
            own, bent = bias[0, c] ** 2, curvature_variance(rows[i], mean, cov, height_m)
            widened[0, c] = math.sqrt(own + bent)
            widened[1, c] = (own + bent) / (own / bias[1, c] + bent / LASTS_S)
