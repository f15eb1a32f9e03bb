"""The most probable state where the measurements bend: iterated updates, from one or several
starts."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.measurement import (
    VALUE,
    VARIANCE,
    curvature_mean,
    curvature_variance,
    innovation_row,
    linearise,
)
from netpos.estimation.state import X
from netpos.estimation.update.fit import map_cost
from netpos.estimation.update.fusion import (
    W_COV,
    W_INNOVATION,
    W_PH,
    W_PRIOR,
    W_USE,
    W_VARIANCE,
    fuse,
)
from netpos.estimation.update.slow_errors import has_been_heard
from netpos.messages.values import Array

# Iterating ends where the model is straight over the last step to this share of a row's noise sd.
_STRAIGHT_SD = 0.02
# A prior is wide where the curvature adds more than this to the variance of a row.
_WIDE = 1.1
# Several starts are tried where the rows leave less than this share of the position's variance.
_NARROWS = 0.25
_STARTS, _SEARCH = 8, 30
_APART_M = 0.1
# Odds of e^-7 against it rule out another place; more than this per row is no fit.
_COST_GAP, _FITS = 15.0, 8.0


@kernel
def iterate(
    mean: Array,
    cov: Array,
    rows: Array,
    variance: Array,
    height_m: float,
    iterations: int,
    work: Array,
) -> tuple[Array, Array]:
    """Posterior of ``rows`` (m, ROW_WIDTH) with ``variance`` (m,); each iteration linearises at
    the last result.

    One iteration is the extended Kalman filter; more are those of ``iterate_from`` the prior.
    """
    if iterations > 1:
        x, P = iterate_from(mean, mean, cov, rows, variance, height_m, iterations, work)
        return x, P
    innovation, H = linearise(rows, mean, height_m)
    x, P = mean.copy(), cov.copy()
    fuse(x, P, innovation, H, variance, np.ones(rows.shape[0]), work)
    return x, P


@kernel
def iterate_from(
    start: Array,
    mean: Array,
    cov: Array,
    rows: Array,
    variance: Array,
    height_m: float,
    iterations: int,
    work: Array,
) -> tuple[Array, Array]:
    """Most probable state near ``start`` (n,) and its covariance, under the prior ``mean`` (n,),
    ``cov`` (n, n): Gauss-Newton steps (Bell and Cathey 1993), halved while they overshoot, ended
    when they move less than 1 % of the sd or no longer downhill: the result is never less
    probable than the start."""
    use = np.ones(rows.shape[0])
    last, last_cost = start, map_cost(mean, cov, rows, variance, height_m, start)
    x, P = mean.copy(), cov.copy()
    for remaining in range(iterations - 1, -1, -1):
        innovation, H = linearise(rows, last, height_m)
        innovation += H @ (last - mean)
        x, P = mean.copy(), cov.copy()
        fuse(x, P, innovation, H, variance, use, work)
        cost = map_cost(mean, cov, rows, variance, height_m, x)
        halvings = 0
        while cost > last_cost and halvings < 6:
            x = (x + last) / 2.0
            cost = map_cost(mean, cov, rows, variance, height_m, x)
            halvings += 1
        if cost > last_cost:
            return last.copy(), P
        small = (np.abs(x - last) < 0.01 * np.sqrt(np.diag(P))).all()
        if remaining == 0 or (halvings == 0 and small):
            break
        last, last_cost = x, cost
    return x, P


@leaf
def is_curved(rows: Array, mean: Array, height_m: float, work: Array) -> bool:
    """Whether a row used in the update, whose slow error has not been heard before, leaves its
    tangent at the prior by more than a small share of its noise when evaluated at the posterior
    ``mean`` (n,)."""
    n = mean.size
    h = work[W_PH]
    for i in range(rows.shape[0]):
        if work[W_USE, i] == 0.0 or has_been_heard(rows, i, work):
            continue
        tangent = work[W_INNOVATION, i]
        for a in range(n):
            tangent -= work[W_COV + n + i, a] * (mean[a] - work[W_PRIOR, a])
        bend = curvature_mean(rows[i], work[W_PRIOR, :n], work[W_COV : W_COV + n, :n], height_m)
        away = abs(innovation_row(rows[i], mean, height_m, h) - bend - tangent)
        if away > _STRAIGHT_SD * math.sqrt(work[W_VARIANCE, i]):
            return True
    return False


@kernel
def iterate_used(
    mean: Array, cov: Array, rows: Array, height_m: float, iterations: int, work: Array
) -> None:
    """``iterate`` the rows used from the prior kept in the workspace; their mean values are those
    of the first posterior."""
    n, m = mean.size, rows.shape[0]
    prior, prior_cov = work[W_PRIOR, :n].copy(), work[W_COV : W_COV + n, :n].copy()
    keep = work[W_USE, :m] == 1.0
    variance, kept = work[W_VARIANCE, :m][keep], rows[keep]
    for i in range(kept.shape[0]):
        kept[i, VALUE] -= curvature_mean(kept[i], mean, cov, height_m)
    x, P = iterate(prior, prior_cov, kept, variance, height_m, iterations, work)
    mean[:] = x
    cov[:] = P


@leaf
def is_wide(rows: Array, work: Array) -> bool:
    """Whether the curvature under the prior adds much to the variance of a row used, whose slow
    error has not been heard before."""
    for i in range(rows.shape[0]):
        wide = work[W_VARIANCE, i] > _WIDE * rows[i, VARIANCE]
        if wide and work[W_USE, i] == 1.0 and not has_been_heard(rows, i, work):
            return True
    return False


@kernel
def refine_used(mean: Array, cov: Array, rows: Array, height_m: float, work: Array) -> None:
    """Look for the most probable state under a wide prior from several starts, where the rows used
    narrow it much.

    The curvature of a wide prior makes an update cautious, too cautious where its rows together
    leave one place only. That is taken if no other explains the rows about as well and the model
    is straight over the width that is left.
    """
    n, m = mean.size, rows.shape[0]
    prior, prior_cov = work[W_PRIOR, :n].copy(), work[W_COV : W_COV + n, :n].copy()
    kept = rows[work[W_USE, :m] == 1.0]
    variance = kept[:, VARIANCE].copy()
    _, narrowed = iterate(prior, prior_cov, kept, variance, height_m, 1, work)
    width = prior_cov[X.PX, X.PX] + prior_cov[X.PY, X.PY]
    if narrowed[X.PX, X.PX] + narrowed[X.PY, X.PY] > _NARROWS * width:
        return
    x, P = iterate_from(mean, prior, prior_cov, kept, variance, height_m, _SEARCH, work)
    cost = map_cost(prior, prior_cov, kept, variance, height_m, x)
    second_cost = math.inf
    for k in range(_STARTS):
        start = prior.copy()
        start[X.PX] += (
            1.5 * math.sqrt(prior_cov[X.PX, X.PX]) * math.cos(2.0 * math.pi * k / _STARTS)
        )
        start[X.PY] += (
            1.5 * math.sqrt(prior_cov[X.PY, X.PY]) * math.sin(2.0 * math.pi * k / _STARTS)
        )
        y, Y = iterate_from(start, prior, prior_cov, kept, variance, height_m, _SEARCH, work)
        other = map_cost(prior, prior_cov, kept, variance, height_m, y)
        apart = math.hypot(y[X.PX] - x[X.PX], y[X.PY] - x[X.PY]) > _APART_M
        if other < cost - 1e-3:
            if apart:
                second_cost = cost
            x, P, cost = y, Y, other
        elif apart:
            second_cost = min(second_cost, other)
    if second_cost - cost < _COST_GAP or cost > _FITS * kept.shape[0]:
        return
    for i in range(kept.shape[0]):
        curved = variance[i] + curvature_variance(kept[i], x, P, height_m)
        if curved > _WIDE * variance[i]:
            return
    mean[:] = x
    cov[:] = P
