"""Cholesky factors of covariances that may be singular; eigenvalues of small ones."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import inlined, kernel
from netpos.messages.values import Array

# A pivot below this share of its variance is rounding.
_RANK = 1e-14


@inlined
def eigenvalues(xx: float, xy: float, yy: float) -> tuple[float, float]:
    """Smallest and largest eigenvalue of a symmetric 2 x 2 matrix."""
    middle, radius = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    outer = middle + math.copysign(radius, middle)  # of the larger magnitude: nothing cancels
    inner = (xx * yy - xy * xy) / outer if outer != 0.0 else 0.0
    return (inner, outer) if outer >= 0.0 else (outer, inner)


@kernel
def factor(cov: Array) -> Array:
    """Lower triangular L (n, n) with L L' = cov, also of a singular ``cov`` (n, n): what is known
    exactly has a zero column."""
    n = cov.shape[0]
    L = np.zeros((n, n))
    for j in range(n):
        pivot = cov[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        if pivot <= _RANK * cov[j, j]:
            continue
        root = math.sqrt(pivot)
        L[j, j] = root
        for i in range(j + 1, n):
            total = cov[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / root
    return L


@kernel
def solve_factored(L: Array, B: Array) -> None:
    """Solve L L' X = B for X (m, k), in place of ``B``; 0 along zero columns of ``L`` (m, m)."""
    m = L.shape[0]
    for column in range(B.shape[1]):
        for i in range(m):
            total = B[i, column]
            for k in range(i):
                total -= L[i, k] * B[k, column]
            B[i, column] = total / L[i, i] if L[i, i] > 0.0 else 0.0
        for i in range(m - 1, -1, -1):
            total = B[i, column]
            for k in range(i + 1, m):
                total -= L[k, i] * B[k, column]
            B[i, column] = total / L[i, i] if L[i, i] > 0.0 else 0.0
