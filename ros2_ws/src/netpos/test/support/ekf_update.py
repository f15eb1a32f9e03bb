"""Updates on copies, for the tests of the filters."""

from __future__ import annotations

import numpy as np
from netpos.filters import ekf
from netpos.filters.measurement import GROUP
from netpos.messages.values import Array


def fused(x: Array, P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array, float]:
    """``ekf.fuse`` of all rows on copies; what is not its own is left alone."""
    mean, cov, inputs = x.copy(), P.copy(), (nu.copy(), H.copy(), R.copy())
    work = np.full_like(ekf.workspace(x.size, nu.size), np.nan)
    distance = ekf.fuse(mean, cov, nu, H, R, np.ones(nu.size), work)
    for given, before in zip((nu, H, R), inputs, strict=True):
        np.testing.assert_array_equal(given, before)
    return mean, cov, distance


def updated(
    x: Array, P: Array, rows: Array, height_m: float, gate: Array, iterations: int
) -> tuple[Array, Array, Array, float, int]:
    """``ekf.update`` on copies, all scratch memory spoiled: mean, cov, accepted, nis, used."""
    mean, cov, before = x.copy(), P.copy(), rows.copy()
    accepted = np.full(int(rows[:, GROUP].max()) + 1, 9.0)
    work = np.full_like(ekf.workspace(x.size + 1, len(rows) + 2), np.nan)
    nis, used = ekf.update(mean, cov, rows, height_m, gate, iterations, accepted, work)
    np.testing.assert_array_equal(rows, before)  # the caller's rows are left alone
    return mean, cov, accepted, nis, used
