"""Rows made fit for a Gaussian update: what fits badly gets a larger variance, what comes late by
a blocked path is shifted."""

from __future__ import annotations

import math
from enum import IntEnum

from netpos.filters.compile import kernel, leaf
from netpos.filters.ekf import group_nis
from netpos.filters.measurement import (
    BLOCKED,
    GATE_VARIANCE,
    GROUP,
    KIND,
    VALUE,
    VARIANCE,
    Kind,
    curvature_variance,
    innovation_row,
    innovation_variance,
    linearise,
)
from netpos.filters.robust import huber_factor, nlos_mixture_exponential, student_t_factor
from netpos.messages.values import Array

# A late range whose equivalent variance would be above this share of the prior's says nothing.
_LARGEST_VAR = 1e12


class Robust(IntEnum):
    """Weighting of groups by how badly they fit."""

    NONE = 0
    HUBER = 1
    STUDENT_T = 2


@leaf
def _unblock(
    mean: Array, cov: Array, row: Array, height_m: float, prior: float, excess_m: float, h: Array
) -> None:
    """Replace a range or time by the measurement equivalent to the mixture of a direct and a
    blocked path; its column BLOCKED, the prior where it is > 0, becomes the posterior."""
    innovation = innovation_row(row, mean, height_m, h)
    spread = innovation_variance(row, mean, cov, height_m, row[VARIANCE], h)
    measurement_var = row[VARIANCE] + curvature_variance(row, mean, cov, height_m)
    prior = row[BLOCKED] if row[BLOCKED] > 0.0 else prior
    row[BLOCKED], shift, variance = nlos_mixture_exponential(
        innovation, spread, measurement_var, prior, excess_m
    )
    row[VALUE] -= shift
    added = max(min(variance, _LARGEST_VAR) - measurement_var, 0.0)
    row[VARIANCE] += added
    row[GATE_VARIANCE] += added


@kernel
def condition(
    mean: Array,
    cov: Array,
    rows: Array,
    height_m: float,
    robust: int,
    parameter: float,
    nlos_probability: float,
    nlos_excess_m: float,
    work: Array,
) -> None:
    """Re-weight ``rows`` (m, ROW_WIDTH) in place, as seen from the prior mean (n,), cov (n, n)."""
    m = rows.shape[0]
    if nlos_probability > 0.0:
        for i in range(m):
            kind = int(rows[i, KIND])
            if kind == Kind.TOA or kind == Kind.RANGE:
                _unblock(mean, cov, rows[i], height_m, nlos_probability, nlos_excess_m, work[0])
    if robust == Robust.NONE:
        return
    innovation, H = linearise(rows, mean, height_m)
    start = 0
    while start < m:
        stop = start + 1
        while stop < m and rows[stop, GROUP] == rows[start, GROUP]:
            stop += 1
        variance = rows[start:stop, GATE_VARIANCE].copy()
        for i in range(start, stop):
            variance[i - start] += curvature_variance(rows[i], mean, cov, height_m)
        d2 = group_nis(cov, innovation[start:stop], H[start:stop], variance)
        if robust == Robust.HUBER:
            factor = huber_factor(d2, stop - start, parameter)
        else:
            factor = student_t_factor(d2, stop - start, parameter)
        if math.isfinite(factor):
            rows[start:stop, VARIANCE] *= factor
            rows[start:stop, GATE_VARIANCE] *= factor
        start = stop
