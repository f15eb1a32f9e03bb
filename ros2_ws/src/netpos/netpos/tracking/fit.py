"""How single rows fit a prediction, told to the health of the RSUs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.engine import FilterOptions, is_sound
from netpos.estimation.measurement import (
    GATE_VARIANCE,
    GROUP,
    KIND,
    Kind,
    innovation_row,
    innovation_variance,
)
from netpos.estimation.protection import FusedEpoch, manoeuvre_level
from netpos.messages.values import Array, RsuMeasurement
from netpos.tracking.epoch_rows import EpochRows, Source
from netpos.tracking.health import RsuHealth
from netpos.tracking.observations import FittedEpoch
from netpos.tracking.rsus import Rsu

AnySource = TypeVar("AnySource", bound=Source)


@leaf
def _innovations_with_sd(
    mean: Array, cov: Array, rows: Array, height_m: float, h: Array, innovations: Array
) -> None:
    for i in range(rows.shape[0]):
        innovations[i, 0] = innovation_row(rows[i], mean, height_m, h)
        noise = rows[i, GATE_VARIANCE]
        innovations[i, 1] = math.sqrt(innovation_variance(rows[i], mean, cov, height_m, noise, h))


@kernel
def innovations_with_sd(mean: Array, cov: Array, rows: Array, height_m: float) -> Array:
    """Innovation of each row (m, ROW_WIDTH) at ``mean`` (n,) and its standard deviation under
    ``cov`` (n, n): (m, 2)."""
    innovations = np.empty((rows.shape[0], 2))
    _innovations_with_sd(mean, cov, rows, height_m, np.empty(mean.size), innovations)
    return innovations


@kernel
def innovations_and_level(
    epoch: FusedEpoch, cov: Array, options: FilterOptions, innovations: Array
) -> float:
    """``innovations_with_sd`` at the prediction, put into ``innovations`` (m, 2);
    ``manoeuvre_level`` where there may be a manoeuvre, else 0. Not a number where the posterior,
    of covariance ``cov`` (n, n), is not sound."""
    if not is_sound(epoch.mean, cov):
        return math.nan
    h = np.empty(epoch.mean.size)
    _innovations_with_sd(
        epoch.prior_mean, epoch.prior_cov, epoch.rows, options.height_m, h, innovations
    )
    if options.manoeuvre_speed_sd <= 0.0:
        return 0.0
    return float(manoeuvre_level(epoch, options))


def widen(innovations: Array, rows: Array, rsu: Rsu) -> None:
    """Let the sd in ``innovations`` (m, 2) of ``rows`` without bias states hold the RSU's biases,
    in place."""
    for pair, row in zip(innovations, rows, strict=True):
        pair[1] = math.hypot(pair[1], rsu.bias_sd(Kind(int(row[KIND]))))


def without_excluded(
    health: RsuHealth,
    stamp_ns: int,
    items: Sequence[AnySource],
    agrees: Callable[[RsuMeasurement], bool],
) -> tuple[list[AnySource], list[RsuMeasurement]]:
    """What may be fused, and what is only looked at: that of an excluded RSU, and of one on
    probation where it does not agree with the prediction (``agrees``)."""
    if health.trusts_all(stamp_ns):
        return list(items), []
    used: list[AnySource] = []
    watched: list[RsuMeasurement] = []
    for item in items:
        if isinstance(item, RsuMeasurement) and (
            health.excluded(item.rsu_id, stamp_ns)
            or (health.on_probation(item.rsu_id, item.vue_id, stamp_ns) and not agrees(item))
        ):
            watched.append(item)
        else:
            used.append(item)
    return used, watched


def fits(innovations: Array, gate: Array) -> bool:
    """Whether each of ``innovations`` (m, 2), with its sd, is within the ``gate`` of one row."""
    return bool(((innovations[:, 0] / innovations[:, 1]) ** 2 <= gate[1]).all())


def with_refused(
    epoch_rows: EpochRows, accepted: Sequence[float], gate: Array, nis: float, dof: int
) -> tuple[float, int]:
    """``nis`` of ``dof`` accepted rows of an epoch with those it refused, as at their gate."""
    if dof < len(epoch_rows.rows):
        sizes = np.bincount(epoch_rows.rows[:, GROUP].astype(int), minlength=len(accepted))
        for size, taken in zip(sizes.tolist(), accepted, strict=True):
            if not taken:
                nis += float(gate[min(size, gate.size - 1)])
                dof += size
    return nis, dof


def observe_excluded(
    health: RsuHealth,
    vue_id: str,
    stamp_ns: int,
    epoch_rows: EpochRows,
    innovations: Array,
    gate: Array,
) -> None:
    """Tell ``health`` how what one RSU alone says, ``epoch_rows``, fitted without being fused;
    its rows have no bias states, which the sd of ``innovations`` (m, 2) holds."""
    accepted = [fits(innovations, gate)]
    health.hear(
        FittedEpoch(stamp_ns, vue_id, epoch_rows.items, epoch_rows.rows, innovations, accepted)
    )
