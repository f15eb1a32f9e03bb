"""How single rows fit a prediction, told to the health of the RSUs."""

from __future__ import annotations

import math

import numpy as np

from netpos.filters.compile import kernel
from netpos.filters.measurement import (
    GATE_VARIANCE,
    GROUP,
    KIND,
    Kind,
    innovation_row,
    innovation_variance,
)
from netpos.messages.values import Array, RsuMeasurement
from netpos.tracking.batch import Batch
from netpos.tracking.health import RsuHealth
from netpos.tracking.rsus import Rsu

_KIND_NAMES = tuple(kind.name for kind in Kind)
_LINEAR = Kind.LINEAR.name


@kernel
def row_fits(mean: Array, cov: Array, rows: Array, height_m: float) -> Array:
    """Innovation of each row (m, ROW_WIDTH) at ``mean`` (n,) and its standard deviation under
    ``cov`` (n, n): (m, 2)."""
    fits = np.empty((rows.shape[0], 2))
    h = np.empty(mean.size)
    for i in range(rows.shape[0]):
        fits[i, 0] = innovation_row(rows[i], mean, height_m, h)
        noise = rows[i, GATE_VARIANCE]
        fits[i, 1] = math.sqrt(innovation_variance(rows[i], mean, cov, height_m, noise, h))
    return fits


def widen(fits: Array, rows: Array, rsu: Rsu) -> None:
    """Let the sd in ``fits`` (m, 2) of ``rows`` without bias states hold the RSU's biases, in
    place."""
    for fit, row in zip(fits, rows, strict=True):
        fit[1] = math.hypot(fit[1], rsu.bias_sd(Kind(int(row[KIND]))))


def observe(
    health: RsuHealth, vue_id: str, stamp_ns: int, batch: Batch, fits: Array, accepted: Array
) -> None:
    """Tell ``health`` how the measurements of an epoch fitted: ``fits`` (m, 2) per row, whether
    ``accepted`` (groups,) per item."""
    found: list[dict[str, tuple[float, float]]] = [{} for _ in batch.items]
    kinds, groups = batch.rows[:, KIND].tolist(), batch.rows[:, GROUP].tolist()
    for kind, group, (innovation, sd) in zip(kinds, groups, fits.tolist(), strict=True):
        found[int(group)][_KIND_NAMES[int(kind)]] = (innovation, sd)
    for item, taken, innovations in zip(batch.items, accepted, found, strict=True):
        if isinstance(item, RsuMeasurement):
            innovations.pop(_LINEAR, None)
            health.observe(item.rsu_id, vue_id, stamp_ns, bool(taken), innovations)
