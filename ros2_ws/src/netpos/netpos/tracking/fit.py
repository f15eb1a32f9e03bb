"""How single rows fit a prediction, told to the health of the RSUs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from netpos.filters.compile import kernel, leaf
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
from netpos.tracking.engine import FilterOptions, is_sound
from netpos.tracking.health import RsuHealth
from netpos.tracking.observations import FittedEpoch
from netpos.tracking.protection import FusedEpoch, manoeuvre_level
from netpos.tracking.rsus import Rsu

AnySource = TypeVar("AnySource", bound=Source)


@leaf
def _row_fits(
    mean: Array, cov: Array, rows: Array, height_m: float, h: Array, fits: Array
) -> None:
    for i in range(rows.shape[0]):
        fits[i, 0] = innovation_row(rows[i], mean, height_m, h)
        noise = rows[i, GATE_VARIANCE]
        fits[i, 1] = math.sqrt(innovation_variance(rows[i], mean, cov, height_m, noise, h))


@kernel
def row_fits(mean: Array, cov: Array, rows: Array, height_m: float) -> Array:
    """Innovation of each row (m, ROW_WIDTH) at ``mean`` (n,) and its standard deviation under
    ``cov`` (n, n): (m, 2)."""
    fits = np.empty((rows.shape[0], 2))
    _row_fits(mean, cov, rows, height_m, np.empty(mean.size), fits)
    return fits


@kernel
def fits_and_level(epoch: FusedEpoch, cov: Array, options: FilterOptions, fits: Array) -> float:
    """``row_fits`` at the prediction, put into ``fits`` (m, 2); ``manoeuvre_level`` where there
    may be a manoeuvre, else 0. Not a number where the posterior, of covariance ``cov`` (n, n), is
    not sound."""
    if not is_sound(epoch.mean, cov):
        return math.nan
    h = np.empty(epoch.mean.size)
    _row_fits(epoch.prior_mean, epoch.prior_cov, epoch.rows, options.height_m, h, fits)
    if options.manoeuvre_speed_sd <= 0.0:
        return 0.0
    return float(manoeuvre_level(epoch, options))


def widen(fits: Array, rows: Array, rsu: Rsu) -> None:
    """Let the sd in ``fits`` (m, 2) of ``rows`` without bias states hold the RSU's biases, in
    place."""
    for fit, row in zip(fits, rows, strict=True):
        fit[1] = math.hypot(fit[1], rsu.bias_sd(Kind(int(row[KIND]))))


def without_isolated(
    health: RsuHealth, stamp_ns: int, items: Sequence[AnySource]
) -> tuple[list[AnySource], list[RsuMeasurement]]:
    """What may be fused, and what comes from an isolated RSU and is only looked at."""
    if health.trusts_all(stamp_ns):
        return list(items), []
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


def observe_isolated(
    health: RsuHealth, vue_id: str, stamp_ns: int, batch: Batch, fits: Array, rsu: Rsu, gate: Array
) -> None:
    """Tell ``health`` how what the isolated ``rsu`` alone says, ``batch``, fitted without being
    fused; its rows have no bias states."""
    widen(fits, batch.rows, rsu)
    fitting = bool(((fits[:, 0] / fits[:, 1]) ** 2 <= gate[1]).all())
    health.hear(FittedEpoch(stamp_ns, vue_id, batch.items, batch.rows, fits, [fitting]))
