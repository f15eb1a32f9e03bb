"""Rows as a prediction sees them: linearised once for an epoch and a component, and read by all
that follows (gate, update, weights, protection level, health of the RSUs)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import inlined, kernel, leaf
from netpos.estimation.measurement import (
    GATE_VARIANCE,
    curvature_mean,
    curvature_variance,
    innovation_row,
)
from netpos.estimation.state import N_CORE, X
from netpos.messages.values import Array

Ints = npt.NDArray[np.int64]


class PredictedRows(NamedTuple):
    """Rows (m, ROW_WIDTH) at a prediction mean (n,), cov (n, n). In a workspace the arrays are
    wider: the first m and n entries count.

    innovation : (m,) measured minus predicted mean value, wrapped where it is an angle
    H, HP : (m, n) Jacobian, and the same times cov
    prior_var : (m,) variance that the prediction has along H
    second_order_var : (m,) variance of what linearising leaves out (``curvature_variance``)

    An innovation has the variance of the row, ``prior_var`` and ``second_order_var`` together.
    """

    innovation: Array
    H: Array
    HP: Array
    prior_var: Array
    second_order_var: Array


@inlined
def along_gradient(n: int, P: Array, h: Array, Ph: Array) -> float:
    """Variance that P (n, n) has along the gradient ``h`` (n,), most of whose entries are 0; fills
    ``Ph`` (n,), P times ``h``."""
    still = h[X.VX] == 0.0 and h[X.VY] == 0.0 and h[X.DRIFT] == 0.0
    if n == N_CORE and still:  # position and clock only
        for a in range(N_CORE):
            Ph[a] = P[X.PX, a] * h[X.PX] + P[X.PY, a] * h[X.PY] + P[X.CLOCK, a] * h[X.CLOCK]
        return float(h[X.PX] * Ph[X.PX] + h[X.PY] * Ph[X.PY] + h[X.CLOCK] * Ph[X.CLOCK])
    for a in range(n):
        Ph[a] = 0.0
    for b in range(n):
        if h[b] != 0.0:
            for a in range(n):
                Ph[a] += P[b, a] * h[b]
    total = 0.0
    for a in range(n):
        total += h[a] * Ph[a]
    return total


@leaf
def predict_rows(
    mean: Array, cov: Array, rows: Array, height_m: float, predicted: PredictedRows
) -> None:
    """Fill ``predicted`` with ``rows`` (m, ROW_WIDTH) at mean (n,), cov (n, n). ``height_m``:
    nominal height of the device in map."""
    n = mean.size
    for i in range(rows.shape[0]):
        h, hp = predicted.H[i], predicted.HP[i]
        # Both before anything is stored: they share the direction and the distance of the RSU.
        variance = curvature_variance(rows[i], mean, cov, height_m)
        bend = curvature_mean(rows[i], mean, cov, height_m)
        predicted.second_order_var[i] = variance
        predicted.innovation[i] = innovation_row(rows[i], mean, height_m, h) - bend
        predicted.prior_var[i] = along_gradient(n, cov, h, hp)


@kernel
def prior_cov_of(predicted: PredictedRows, index: Ints, n: int) -> Array:
    """Covariance (k, k) that a prediction of ``n`` states gives the values of the rows ``index``
    (k,), without their noise: H P H'."""
    cov = np.empty((index.size, index.size))
    for a in range(index.size):
        for b in range(a + 1):
            total = 0.0
            for c in range(n):
                total += predicted.H[index[a], c] * predicted.HP[index[b], c]
            cov[a, b] = cov[b, a] = total
    return cov


@leaf
def note_innovations(rows: Array, predicted: PredictedRows, innovations: Array) -> None:
    """Write the innovations of ``rows`` and their sd, as they were ``predicted``, to
    ``innovations`` (m, 2)."""
    for i in range(rows.shape[0]):
        known = predicted.prior_var[i] + predicted.second_order_var[i]
        innovations[i, 0] = predicted.innovation[i]
        innovations[i, 1] = math.sqrt(rows[i, GATE_VARIANCE] + known)


@kernel
def predicted_rows(mean: Array, cov: Array, rows: Array, height_m: float) -> PredictedRows:
    """``predict_rows`` in new arrays."""
    m, n = rows.shape[0], mean.size
    predicted = PredictedRows(
        np.empty(m), np.empty((m, n)), np.empty((m, n)), np.empty(m), np.empty(m)
    )
    predict_rows(mean, cov, rows, height_m, predicted)
    return predicted
