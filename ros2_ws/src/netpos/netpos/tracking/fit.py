"""How single rows fit a prediction, told to the health of the RSUs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import GROUP, KIND, Kind
from netpos.estimation.predicted import note_innovations, predicted_rows
from netpos.messages.values import Array, RsuMeasurement
from netpos.tracking.epoch_rows import EpochRows, Source
from netpos.tracking.health import RsuHealth
from netpos.tracking.observations import FittedEpoch
from netpos.tracking.rsus import Rsu

AnySource = TypeVar("AnySource", bound=Source)


@kernel
def innovations_with_sd(mean: Array, cov: Array, rows: Array, height_m: float) -> Array:
    """Innovation of each row (m, ROW_WIDTH) at ``mean`` (n,) and its standard deviation under
    ``cov`` (n, n): (m, 2)."""
    innovations = np.empty((rows.shape[0], 2))
    note_innovations(rows, predicted_rows(mean, cov, rows, height_m), innovations)
    return innovations


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


def refused_groups(
    epoch_rows: EpochRows, accepted: Sequence[float], gate: Array
) -> list[tuple[int, float]]:
    """Rows and gate of each group of an epoch that its gate refused; one that is open refuses
    nothing."""
    if 0.0 not in accepted:
        return []
    sizes = np.bincount(epoch_rows.rows[:, GROUP].astype(int), minlength=len(accepted))
    limits = gate[np.minimum(sizes, gate.size - 1)]
    return [
        (size, limit)
        for size, limit, taken in zip(sizes.tolist(), limits.tolist(), accepted, strict=True)
        if not taken and math.isfinite(limit)
    ]


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
