"""Rows made fit for a Gaussian update: what fits badly gets a larger variance, what comes late by
a blocked path is shifted."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

from netpos.estimation.compile import inlined, kernel, leaf
from netpos.estimation.measurement import BLOCKED, GATE_VARIANCE, VALUE, VARIANCE, is_range
from netpos.estimation.sensors.row import group_end
from netpos.estimation.update.fusion import group_nis
from netpos.estimation.update.predicted import PredictedRows
from netpos.estimation.update.robust import (
    huber_factor,
    nlos_mixture_exponential,
    student_t_factor,
)
from netpos.messages.values import Array

# A late range whose equivalent variance would be above this share of the prior's says nothing.
_LARGEST_VAR = 1e12


class Robust(IntEnum):
    """Weighting of groups by how badly they fit."""

    NONE = 0
    HUBER = 1
    STUDENT_T = 2


_NONE = int(Robust.NONE)


class RobustOptions(NamedTuple):
    """How rows are re-weighted: kind and parameter of the weighting, probability of a blocked path
    and its mean excess [m]."""

    kind: int  # Robust
    parameter: float
    nlos_probability: float
    nlos_excess_m: float


@inlined
def by_fit(options: RobustOptions) -> RobustOptions:
    """The options without those of blocked paths."""
    return RobustOptions(options.kind, options.parameter, 0.0, options.nlos_excess_m)


@inlined
def by_path(options: RobustOptions) -> RobustOptions:
    """The options of blocked paths alone."""
    blocked, excess_m = options.nlos_probability, options.nlos_excess_m
    return RobustOptions(_NONE, options.parameter, blocked, excess_m)


@leaf
def nlos_correct(
    row: Array, innovation: float, innovation_var: float, prior: float, excess_m: float
) -> None:
    """Replace a range or time by the measurement equivalent to the mixture of a direct and a
    blocked path; its column BLOCKED, the prior where it is > 0, becomes the posterior.

    innovation_var : variance of the innovation
    """
    prior, noise = row[BLOCKED] if row[BLOCKED] > 0.0 else prior, row[VARIANCE]
    row[BLOCKED], shift, variance = nlos_mixture_exponential(
        innovation, innovation_var, noise, prior, excess_m
    )
    row[VALUE] -= shift
    added = max(min(variance, _LARGEST_VAR) - noise, 0.0)
    row[VARIANCE] += added
    row[GATE_VARIANCE] += added


@leaf
def may_be_late(row: Array) -> bool:
    """Whether a blocked path makes the row late."""
    return bool(is_range(row))


@kernel
def m_estimate(
    cov: Array,
    rows: Array,
    innovation: Array,
    H: Array,
    second_order_var: Array,
    options: RobustOptions,
) -> None:
    """Widen, in place, groups of ``rows`` (m, ROW_WIDTH) by how badly they fit: innovation (m,),
    Jacobian H (m, n), variance ``second_order_var`` (m,) of what linearising leaves out."""
    m, start = rows.shape[0], 0
    while start < m:
        stop = group_end(rows, start)
        variance = rows[start:stop, GATE_VARIANCE] + second_order_var[start:stop]
        d2 = group_nis(cov, innovation[start:stop], H[start:stop], variance)
        if options.kind == Robust.HUBER:
            factor = huber_factor(d2, stop - start, options.parameter)
        else:
            factor = student_t_factor(d2, stop - start, options.parameter)
        if math.isfinite(factor):
            rows[start:stop, VARIANCE] *= factor
            rows[start:stop, GATE_VARIANCE] *= factor
        start = stop


@kernel
def reweight(cov: Array, rows: Array, predicted: PredictedRows, options: RobustOptions) -> None:
    """Re-weight ``rows`` (m, ROW_WIDTH) in place, as ``predicted`` from a prior with cov (n, n); a
    value that is shifted shifts its innovation."""
    if options.nlos_probability > 0.0:
        for i in range(rows.shape[0]):
            row = rows[i]
            if may_be_late(row):
                known = predicted.prior_var[i] + predicted.second_order_var[i]
                before = row[VALUE]
                nlos_correct(
                    row,
                    predicted.innovation[i],
                    row[VARIANCE] + known,
                    options.nlos_probability,
                    options.nlos_excess_m,
                )
                predicted.innovation[i] += row[VALUE] - before
    if options.kind != Robust.NONE:
        H = predicted.H[:, : cov.shape[0]].copy()
        m_estimate(cov, rows, predicted.innovation, H, predicted.second_order_var, options)
