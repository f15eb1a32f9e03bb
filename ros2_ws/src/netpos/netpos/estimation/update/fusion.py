"""Fusing scalar rows: Joseph form, row by row, and what watches over its rounding."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import inlined, kernel, leaf, local_array, spliced
from netpos.estimation.factor import factor
from netpos.estimation.state import N_CORE
from netpos.estimation.update.predicted import PredictedRows, along_gradient
from netpos.messages.values import Array

# The workspace: vectors of one entry per row or state, then the prior covariance (n), H (m), H P
# (m), and n more.
(
    W_VARIANCE,
    W_GATE_VARIANCE,
    W_INNOVATION,
    W_PRIOR_VARIANCE,
    W_SECOND_ORDER,
    W_STEP,
    W_PH,
    W_GAIN,
    W_USE,
    W_PRIOR,
    W_COV,
) = range(11)
# A pivot of the posterior below this share of the prior's variance has lost its digits: the result
# may be off by more than 1e-5 sd.
_ROUNDING = 1e-11


@kernel
def workspace(n: int, m: int) -> Array:
    """Scratch memory for updates of up to ``n`` states with up to ``m`` rows."""
    return np.zeros((W_COV + 2 * n + 2 * m, max(n, m)))


@spliced
def predicted_in(work: Array, n: int, m: int) -> PredictedRows:
    """The part of a workspace that holds ``m`` rows at a prediction of ``n`` states; an update
    leaves it as it is. Spliced: a leaf does not count the references it returns."""
    h, hp = W_COV + n, W_COV + n + m
    return PredictedRows(
        work[W_INNOVATION],
        work[h:hp],
        work[hp : hp + m],
        work[W_PRIOR_VARIANCE],
        work[W_SECOND_ORDER],
    )


class LinearRows(NamedTuple):
    """Rows linearised at one state: innovation (m,), H (m, n), variance (m,); those with ``use``
    (m,) 0 are left out."""

    innovation: Array
    H: Array
    variance: Array
    use: Array


@inlined
def _fuse_rows(
    n: int, mean: Array, P: Array, rows: LinearRows, step: Array, Ph: Array, K: Array
) -> float:
    """``fuse`` on P (n, n), with vectors ``step``, ``Ph`` and ``K`` (n,) to work in."""
    for a in range(n):
        step[a] = 0.0
    distance = 0.0
    for i in range(rows.H.shape[0]):
        if rows.use[i] == 0.0:
            continue
        h, residual = rows.H[i], rows.innovation[i]
        hPh = along_gradient(n, P, h, Ph)
        for a in range(n):
            residual -= h[a] * step[a]
        variance = rows.variance[i]
        s = hPh + variance
        distance += residual * residual / s
        for a in range(n):
            K[a] = Ph[a] / s
            step[a] += K[a] * residual
        for a in range(n):
            left = Ph[a] - K[a] * hPh - variance * K[a]  # zero but for rounding: Joseph's
            for b in range(a, n):
                value = P[a, b] - K[a] * Ph[b] - left * K[b]
                P[a, b] = value
                P[b, a] = value
    for a in range(n):
        mean[a] += step[a]
    return distance


@leaf
def _fuse_core(mean: Array, cov: Array, rows: LinearRows) -> float:
    """``fuse`` for the six core states."""
    P = local_array(N_CORE, N_CORE)
    step, Ph, K = local_array(N_CORE), local_array(N_CORE), local_array(N_CORE)
    for a in range(N_CORE):
        for b in range(N_CORE):
            P[a, b] = cov[a, b]
    distance = _fuse_rows(N_CORE, mean, P, rows, step, Ph, K)
    for a in range(N_CORE):
        for b in range(N_CORE):
            cov[a, b] = P[a, b]
    return float(distance)


@leaf
def _fuse_any(mean: Array, cov: Array, rows: LinearRows, work: Array) -> float:
    """``fuse`` for any number of states."""
    step, Ph, K = work[W_STEP], work[W_PH], work[W_GAIN]
    n = mean.size
    return float(_fuse_rows(n, mean, cov, rows, step, Ph, K))


@inlined
def fuse(
    mean: Array, cov: Array, innovation: Array, H: Array, variance: Array, use: Array, work: Array
) -> float:
    """Fuse scalar rows, all linearised at ``mean``, in place: fokin2020:eq.23-25 with diagonal R,
    row by row in Joseph form. The same posterior as one update with the full S.

    mean (n,), cov (n, n), innovation (m,), H (m, n), variance (m,) > 0; rows with ``use`` (m,) 0
    are left out. Returns the squared Mahalanobis distance of the rows used.
    """
    rows = LinearRows(innovation, H, variance, use)
    if mean.size == N_CORE:
        return float(_fuse_core(mean, cov, rows))
    return float(_fuse_any(mean, cov, rows, work))


@kernel
def group_nis(cov: Array, innovation: Array, H: Array, variance: Array) -> float:
    """Squared Mahalanobis distance of one group's innovation (m,), with S = H cov H' +
    diag(variance)."""
    S = H @ cov @ H.T
    for i in range(innovation.size):
        S[i, i] += variance[i]
    return float(innovation @ np.linalg.solve(S, innovation))


@inlined
def _pivots_exceed(n: int, cov: Array, share: float, prior: Array, A: Array) -> bool:
    """Whether elimination of cov (n, n), in the upper triangle of ``A``, finds every pivot above a
    share of the prior's variance."""
    for a in range(n):
        for b in range(a, n):
            A[a, b] = cov[a, b]
    for k in range(n):
        if not A[k, k] > share * prior[k, k]:
            return False
        inverse = 1.0 / A[k, k]
        for a in range(k + 1, n):
            factor_ak = A[k, a] * inverse
            for b in range(a, n):
                A[a, b] -= factor_ak * A[k, b]
    return True


@leaf
def _exceeds(cov: Array, share: float, work: Array) -> bool:
    n, prior = cov.shape[0], work[W_COV:]
    if n == N_CORE:
        return bool(_pivots_exceed(N_CORE, cov, share, prior, local_array(N_CORE, N_CORE)))
    return bool(_pivots_exceed(n, cov, share, prior, work[work.shape[0] - n :]))


@leaf
def is_definite(cov: Array, work: Array) -> bool:
    """Whether elimination finds every pivot positive; ``cov`` (n, n) stays as it is."""
    return bool(_exceeds(cov, 0.0, work))


@leaf
def keeps_digits(cov: Array, work: Array) -> bool:
    """Whether elimination of ``cov`` (n, n), which stays as it is, finds every pivot above what
    rounding leaves of the prior kept in the workspace."""
    return bool(_exceeds(cov, _ROUNDING, work))


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
