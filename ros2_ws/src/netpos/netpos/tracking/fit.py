"""How single rows fit a prediction, told to the health of the RSUs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

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
from netpos.tracking.batch import Batch, Source
from netpos.tracking.health import RsuHealth
from netpos.tracking.health_words import Observation
from netpos.tracking.rsus import Rsu

AnySource = TypeVar("AnySource", bound=Source)
# What is told of: a position fix has rows along no axis anyone can name.
_KIND_NAMES = {int(kind): kind.name for kind in Kind if kind is not Kind.LINEAR}


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


def without_isolated(
    health: RsuHealth, stamp_ns: int, items: Sequence[AnySource]
) -> tuple[list[AnySource], list[RsuMeasurement]]:
    """What may be fused, and what comes from an isolated RSU and is only looked at."""
    used: list[AnySource] = []
    watched: list[RsuMeasurement] = []
    for item in items:
        if isinstance(item, RsuMeasurement) and health.isolated(item.rsu_id, stamp_ns):
            watched.append(item)
        else:
            used.append(item)
    return used, watched


def with_refused(
    batch: Batch, accepted: Sequence[float], gate: Array, nis: float, dof: int
) -> tuple[float, int]:
    """``nis`` of ``dof`` accepted rows of an epoch with those it refused, as at their gate."""
    if dof < len(batch.rows):
        sizes = np.bincount(batch.rows[:, GROUP].astype(int), minlength=len(accepted))
        for size, taken in zip(sizes.tolist(), accepted, strict=True):
            if not taken:
                nis += float(gate[min(size, gate.size - 1)])
                dof += size
    return nis, dof


def observe(
    health: RsuHealth,
    vue_id: str,
    stamp_ns: int,
    batch: Batch,
    fits: Array,
    accepted: Sequence[float],
) -> None:
    """Tell ``health`` how the measurements of an epoch fitted: ``fits`` (m, 2) per row, whether
    ``accepted`` (groups,) per item."""
    found: list[list[tuple[str, tuple[float, float]]]] = [[] for _ in batch.items]
    kinds, groups = batch.rows[:, KIND].tolist(), batch.rows[:, GROUP].tolist()
    for kind, group, (innovation, sd) in zip(kinds, groups, fits.tolist(), strict=True):
        if kind in _KIND_NAMES:
            found[int(group)].append((_KIND_NAMES[kind], (innovation, sd)))
    for item, taken, innovations in zip(batch.items, accepted, found, strict=True):
        if isinstance(item, RsuMeasurement):
            seen = Observation(stamp_ns, vue_id, bool(taken), tuple(innovations))
            health.take(item.rsu_id, seen)


def observe_isolated(
    health: RsuHealth, vue_id: str, stamp_ns: int, batch: Batch, fits: Array, rsu: Rsu, gate: Array
) -> None:
    """Tell ``health`` how what the isolated ``rsu`` alone says, ``batch``, fitted without being
    fused; its rows have no bias states."""
    widen(fits, batch.rows, rsu)
    fitting = bool(((fits[:, 0] / fits[:, 1]) ** 2 <= gate[1]).all())
    observe(health, vue_id, stamp_ns, batch, fits, [fitting])
