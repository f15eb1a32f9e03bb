"""What a posterior leaves of the rows it was made of."""

from __future__ import annotations

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import (
    BIAS,
    REFERENCE,
    VARIANCE,
    curvature_mean,
    curvature_variance,
    innovation_row,
)
from netpos.messages.values import Array


@kernel
def unexplained(mean: Array, cov: Array, rows: Array, height_m: float) -> Array:
    """What the posterior mean (n,), cov (n, n) leaves of each row (m, 3): the residual with the
    bias of the RSU in it, less that of the reference; its expected square, without; and the
    variance of the update."""
    n = mean.size
    h, out = np.empty(n), np.empty((rows.shape[0], 3))
    for i in range(rows.shape[0]):
        row = rows[i]
        residual = innovation_row(row, mean, height_m, h)
        residual -= curvature_mean(row, mean, cov, height_m)
        q = 0.0
        for a in range(n):
            for b in range(n):
                q += h[a] * cov[a, b] * h[b]
        own, reference = int(row[BIAS]), int(row[REFERENCE])
        bias = mean[own] if own >= 0 else 0.0
        bias -= mean[reference] if reference > 0 else 0.0
        out[i, 0], out[i, 1] = residual + bias, residual * residual + q
        out[i, 2] = row[VARIANCE] + curvature_variance(row, mean, cov, height_m)
    return out
