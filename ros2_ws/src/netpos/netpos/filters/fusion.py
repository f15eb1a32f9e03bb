"""Fusing scalar rows: Joseph form, row by row, and what watches over its rounding."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from netpos.filters.compile import kernel, leaf
from netpos.filters.factor import factor
from netpos.filters.motion import N_CORE
from netpos.messages.values import Array

# The workspace: vectors of one entry per row or state, then the prior covariance (n), H (m), P H'
# (m), and n more.
(
    W_VARIANCE,
    W_GATE_VARIANCE,
    W_INNOVATION,
    W_STEP,
    W_PH,
    W_GAIN,
    W_USE,
    W_PRIOR,
    W_COV,
) = range(9)


@kernel
def workspace(n: int, m: int) -> Array:
    """Scratch memory for updates of up to ``n`` states with up to ``m`` rows."""
    return np.zeros((W_COV + 2 * n + 2 * m, max(n, m)))


def _fuse_for(states: int) -> Callable[..., Any]:
    """``fuse`` for a fixed number of states, known to the compiler; 0: any number."""

    @leaf
    def fuse_rows(
        mean: Array,
        cov: Array,
        innovation: Array,
        H: Array,
        variance: Array,
        use: Array,
        work: Array,
    ) -> float:
        n = states if states > 0 else mean.size
        step, Ph, K = work[W_STEP], work[W_PH], work[W_GAIN]
        for a in range(n):
            step[a] = 0.0
        distance = 0.0
        for i in range(H.shape[0]):
            if use[i] == 0.0:
                continue
            h, r = H[i], variance[i]
            hPh, residual = 0.0, innovation[i]
            for a in range(n):
                row, total = cov[a], 0.0
                for b in range(n):
                    total += row[b] * h[b]
                Ph[a] = total
                hPh += h[a] * total
                residual -= h[a] * step[a]
            s = hPh + r
            distance += residual * residual / s
            for a in range(n):
                K[a] = Ph[a] / s
                step[a] += K[a] * residual
            for a in range(n):
                left = Ph[a] - K[a] * hPh - r * K[a]  # zero but for rounding: Joseph's term
                row = cov[a]
                for b in range(a, n):
                    value = row[b] - K[a] * Ph[b] - left * K[b]
                    row[b] = value
                    cov[b, a] = value
        for a in range(n):
            mean[a] += step[a]
        return distance

    return fuse_rows  # type: ignore[no-any-return]


_fuse_core = _fuse_for(N_CORE)
_fuse_any = _fuse_for(0)


@leaf
def fuse(
    mean: Array, cov: Array, innovation: Array, H: Array, variance: Array, use: Array, work: Array
) -> float:
    """Fuse scalar rows, all linearised at ``mean``, in place: fokin2020:eq.23-25 with diagonal R,
    row by row in Joseph form. The same posterior as one update with the full S.

    mean (n,), cov (n, n), innovation (m,), H (m, n), variance (m,) > 0; rows with ``use`` (m,) 0
    are left out. Returns the squared Mahalanobis distance of the rows used.
    """
    if mean.size == N_CORE:
        return float(_fuse_core(mean, cov, innovation, H, variance, use, work))
    return float(_fuse_any(mean, cov, innovation, H, variance, use, work))


@kernel
def group_nis(cov: Array, innovation: Array, H: Array, variance: Array) -> float:
    """Squared Mahalanobis distance of one group's innovation (m,), with S = H cov H' +
    diag(variance)."""
    S = H @ cov @ H.T
    for i in range(innovation.size):
        S[i, i] += variance[i]
    return float(innovation @ np.linalg.solve(S, innovation))


@leaf
def is_definite(cov: Array, work: Array) -> bool:
    """Whether elimination finds every pivot positive; ``cov`` (n, n) stays as it is."""
    n = cov.shape[0]
    base = work.shape[0] - n
    for a in range(n):
        row = work[base + a]
        for b in range(a, n):
            row[b] = cov[a, b]
    for k in range(n):
        upper = work[base + k]
        if not upper[k] > 0.0:
            return False
        inverse = 1.0 / upper[k]
        for a in range(k + 1, n):
            factor_ak = upper[a] * inverse
            row = work[base + a]
            for b in range(a, n):
                row[b] -= factor_ak * upper[b]
    return True


@kernel
def fuse_by_factor(mean: Array, cov: Array, m: int, work: Array) -> None:
    """``fuse`` again from the prior kept in the workspace, on the factor of the covariance (Potter
    1963): for what rounding makes indefinite, variances many orders of magnitude apart."""
    n = mean.size
    L = factor(work[W_COV : W_COV + n, :n].copy())
    step = np.zeros(n)
    for i in range(m):
        if work[W_USE, i] == 0.0:
            continue
        h, r = work[W_COV + n + i, :n].copy(), work[W_VARIANCE, i]
        f = L.T @ h
        s = f @ f + r
        Lf = L @ f
        step += Lf * ((work[W_INNOVATION, i] - h @ step) / s)
        L -= np.outer(Lf, f) / (s + math.sqrt(r * s))
    mean[:] = work[W_PRIOR, :n] + step
    cov[:] = L @ L.T
