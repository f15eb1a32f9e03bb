"""How well a state fits a prior and measurements."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.factor import factor
from netpos.estimation.measurement import (
    VARIANCE,
    linearise,
    same_bend_variance,
    second_order_variance,
)
from netpos.estimation.update.predicted import (
    Ints,
    PredictedRows,
    note_innovations,
    predicted_rows,
    prior_cov_of,
)
from netpos.messages.values import Array


@kernel
def distance2(cov: Array, d: Array) -> float:
    """Squared Mahalanobis distance of ``d`` (n,) by elimination.

    What is known exactly (a pivot of no more than rounding) is left out, so that ``cov`` (n, n)
    may be singular.
    """
    A, y = cov.copy(), d.copy()
    total = 0.0
    for j in range(d.size):
        pivot = A[j, j]
        if pivot <= 1e-14 * cov[j, j]:
            continue
        total += y[j] * y[j] / pivot
        for i in range(j + 1, d.size):
            share = A[i, j] / pivot
            y[i] -= share * y[j]
            for k in range(j + 1, d.size):
                A[i, k] -= share * A[j, k]
    return total


@kernel
def map_cost(
    mean: Array, cov: Array, rows: Array, variance: Array, height_m: float, x: Array
) -> float:
    """Twice the negative log posterior of ``x`` (n,) but for a constant: prior and measurement
    terms.

    At the most probable ``x`` of a linear model this is the NIS, chi-square with one degree of
    freedom per row; unlike the NIS it stays so where the model bends over the width of the
    prior.
    """
    innovation, _ = linearise(rows, x, height_m)
    return float(distance2(cov, x - mean) + (innovation * innovation / variance).sum())


@kernel
def neg2_log_likelihood(
    mean: Array,
    cov: Array,
    rows: Array,
    height_m: float,
    predicted: PredictedRows,
    index: Ints,
) -> tuple[float, float]:
    """Squared Mahalanobis distance of the rows ``index`` (k,) of ``rows`` (m, ROW_WIDTH) from
    where mean (n,), cov (n, n) ``predicted`` them, and ln det(2 pi S): minus twice their log
    density is the sum of the two. What is known exactly is left out.

    S has the curvature as ``second_order_variance``, to weigh priors of different widths. In the
    distance it is that of values with the same bend, as in an update: together they count as one.
    In the determinant it is that of a single value: a wide prior does not fit worse because there
    are more of them.
    """
    innovation, S = predicted.innovation[index], prior_cov_of(predicted, index, mean.size)
    single = S.copy()
    for a in range(index.size):
        row = rows[index[a]]
        bent = second_order_variance(row, mean, cov, height_m)
        single[a, a] += row[VARIANCE] + bent
        S[a, a] += row[VARIANCE] + same_bend_variance(row, mean, cov, height_m, bent)
    L, L_single = factor(S), factor(single)
    distance, size = 0.0, 0.0
    for i in range(innovation.size):
        if L[i, i] == 0.0:
            continue
        for k in range(i):
            innovation[i] -= L[i, k] * innovation[k]
        innovation[i] /= L[i, i]
        distance += innovation[i] ** 2
        size += math.log(2.0 * math.pi * L_single[i, i] ** 2)
    return distance, size


@kernel
def innovations_with_sd(mean: Array, cov: Array, rows: Array, height_m: float) -> Array:
    """Innovation of each row (m, ROW_WIDTH) at ``mean`` (n,) and its standard deviation under
    ``cov`` (n, n): (m, 2)."""
    innovations = np.empty((rows.shape[0], 2))
    note_innovations(rows, predicted_rows(mean, cov, rows, height_m), innovations)
    return innovations
