"""Updates on copies, for the tests of the filters."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import GROUP
from netpos.messages.values import Array


def scratch(n: int, m: int) -> Array:
    """A workspace full of what must not be read."""
    return np.full_like(ekf.workspace(n, m), np.nan)


def fused(x: Array, P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array, float]:
    """``ekf.fuse`` of all rows on copies; what is not its own is left alone."""
    mean, cov, inputs = x.copy(), P.copy(), (nu.copy(), H.copy(), R.copy())
    distance = ekf.fuse(mean, cov, nu, H, R, np.ones(nu.size), scratch(x.size, nu.size))
    for given, before in zip((nu, H, R), inputs, strict=True):
        np.testing.assert_array_equal(given, before)
    return mean, cov, distance


def updated(
    x: Array, P: Array, rows: Array, height_m: float, gate: Array, iterations: int
) -> tuple[Array, Array, Array, float, int]:
    """``ekf.update`` on copies, all scratch memory spoiled: mean, cov, accepted, nis, used."""
    mean, cov, before = x.copy(), P.copy(), rows.copy()
    accepted = np.full(int(rows[:, GROUP].max()) + 1, 9.0)
    work = scratch(x.size + 1, len(rows) + 2)
    nis, used = ekf.update(mean, cov, rows, height_m, gate, iterations, accepted, work)
    np.testing.assert_array_equal(rows, before)  # the caller's rows are left alone
    return mean, cov, accepted, nis, used


def iterated(
    mean: Array, cov: Array, rows: Array, variance: Array, iterations: int
) -> tuple[Array, Array]:
    """``ekf.iterate`` on the ground; its arguments are left alone."""
    given = mean, cov, rows, variance
    before = [a.copy() for a in given]
    x, P = ekf.iterate(*given, 0.0, iterations, scratch(mean.size, len(rows)))
    for a, b in zip(given, before, strict=True):
        np.testing.assert_array_equal(a, b)
    return x, P


def exact_fuse(x: Array, P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """The batch update in rational arithmetic: no rounding at all."""
    x, P, nu, H, R = (
        np.vectorize(Fraction, otypes=[object])(A) for A in (x, P, nu, H, np.diag(R))
    )
    PH = P @ H.T
    M = np.hstack([H @ PH + R, nu[:, None], PH.T])
    for i in range(len(M)):
        M[i] = M[i] / M[i, i]
        for j in range(len(M)):
            if j != i:
                M[j] = M[j] - M[j, i] * M[i]
    solved = M[:, len(M) :]
    return (x + PH @ solved[:, 0]).astype(float), (P - PH @ solved[:, 1:]).astype(float)
