"""How well a state fits a prior and measurements."""

from __future__ import annotations

from netpos.filters.compile import kernel
from netpos.filters.measurement import linearise
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
            factor = A[i, j] / pivot
            y[i] -= factor * y[j]
            for k in range(j + 1, d.size):
                A[i, k] -= factor * A[j, k]
    return total


@kernel
def misfit(
    mean: Array, cov: Array, rows: Array, variance: Array, height_m: float, x: Array
) -> float:
    """Twice the negative log posterior of ``x`` (n,) but for a constant: prior and measurement
    terms.

    At the most probable ``x`` of a linear model this is the NIS, chi-square with one degree of
    freedom per row; unlike the NIS it stays so where the model bends over the width of the prior.
    """
    innovation, _ = linearise(rows, x, height_m)
    return float(distance2(cov, x - mean) + (innovation * innovation / variance).sum())
