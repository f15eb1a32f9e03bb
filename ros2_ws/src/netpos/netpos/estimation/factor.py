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
def factor_in_place(A: Array) -> None:
    """Lower triangular L (n, n) with L L' = A, in place of the lower triangle of ``A``, which may
    be singular: what is known exactly has a zero column. The rest of ``A`` stays."""
    n = A.shape[0]
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= A[j, k] * A[j, k]
        root = 0.0 if pivot <= _RANK * A[j, j] else math.sqrt(pivot)
        A[j, j] = root
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = 0.0 if root == 0.0 else total / root


@kernel
def factor(cov: Array) -> Array:
    """``factor_in_place`` of a copy of ``cov`` (n, n); 0 above the diagonal."""
    L = np.zeros(cov.shape)
    for i in range(cov.shape[0]):
        L[i, : i + 1] = cov[i, : i + 1]
    factor_in_place(L)
    return L


@kernel
def solve_lower(L: Array, B: Array) -> None:
    """Solve L X = B for X (m, k), in place of ``B``; 0 along zero columns of ``L`` (m, m), of
    which the lower triangle counts."""
    for column in range(B.shape[1]):
        for i in range(L.shape[0]):
            total = B[i, column]
            for k in range(i):
                total -= L[i, k] * B[k, column]
            B[i, column] = total / L[i, i] if L[i, i] > 0.0 else 0.0


@kernel
def solve_factored(L: Array, B: Array) -> None:
    """Solve L L' X = B for X (m, k), in place of ``B``; 0 along zero columns of ``L`` (m, m)."""
    solve_lower(L, B)
    m = L.shape[0]
    for column in range(B.shape[1]):
        for i in range(m - 1, -1, -1):
            total = B[i, column]
            for k in range(i + 1, m):
                total -= L[k, i] * B[k, column]
            B[i, column] = total / L[i, i] if L[i, i] > 0.0 else 0.0


@kernel
def solve(A: Array, b: Array) -> Array:
    """x (n,) of A x = b for a positive definite ``A`` (n, n); 0 along what it leaves open."""
    x = b.copy().reshape(-1, 1)
    solve_factored(factor(A), x)
    return x[:, 0]


@kernel
def inverse(A: Array) -> Array:
    """Inverse of a positive definite ``A`` (n, n) whose units differ by many orders of magnitude;
    large along what it leaves open."""
    n = A.shape[0]
    scale, scaled, inverted = 1.0 / np.sqrt(np.diag(A)), np.empty((n, n)), np.eye(n)
    for i in range(n):
        for j in range(n):
            scaled[i, j] = A[i, j] * scale[i] * scale[j]
        scaled[i, i] += 2.0 * _RANK  # what is only ill-conditioned is not known exactly
    solve_factored(factor(scaled), inverted)
    for i in range(n):
        for j in range(n):
            inverted[i, j] *= scale[i] * scale[j]
    return inverted
