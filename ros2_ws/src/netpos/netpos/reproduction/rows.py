"""Filter rows of a whole simulated run at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import kernel
from netpos.estimation.measurement import (
    BIAS,
    GATE_VARIANCE,
    GROUP,
    KIND,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.sensors.table import readings
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.radio.measure import QUANTITIES, Observations
from netpos.tracking.rsus.rsu import Rsu

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RowTemplates:
    """What rows of each RSU have in common: everything but value, variances and group.

    rows (m, q, ROW_WIDTH) per RSU and quantity; column (q,) of ``Observations.values``; scale (q,)
    from its unit to the row's; rank (m,) of the RSU where a tracker sorts them by name; bias
    (m, q, 2) standard deviation and time constant of the slow error in the row, 0 where none.
    """

    rows: Array
    column: Ints
    scale: Array
    rank: Ints
    bias: Array

    @classmethod
    def of(cls, rsus: tuple[RsuInfo, ...], fields: Field) -> RowTemplates:
        """Templates of RSUs that measure ``fields`` in their own axes."""
        rows = []
        for info in rsus:
            empty = RsuMeasurement(stamp_ns=1, rsu_id=info.rsu_id, vue_id="", fields=fields)
            rows.append(rsu_rows(empty, info, rsu_axes(info), 0))
        kinds = [Kind(int(kind)) for kind in rows[0][:, KIND]]
        sd = np.array([[Rsu.of(info).bias_sd(kind) for kind in kinds] for info in rsus])
        tau = np.array([info.bias_correlation_time_s for info in rsus])
        bias = np.stack([sd, np.where(sd > 0.0, tau[:, None], 0.0)], axis=-1)
        carried = [r for _, r in readings() if fields & r.field and r.simulated is not None]
        order = np.argsort([info.rsu_id for info in rsus])
        rank = np.empty(len(rsus), dtype=np.int64)
        rank[order] = np.arange(len(rsus))
        scale = np.array([reading.scale for reading in carried])
        column = np.array([QUANTITIES.index(str(r.simulated)) for r in carried], dtype=np.int64)
        return cls(np.array(rows), column, scale, rank, bias)


@kernel
def _fill(
    heard_by: Ints,
    rsu: Ints,
    values: Array,
    variances: Array,
    templates: Array,
    column: Ints,
    scale: Array,
    rank: Ints,
    rows: Array,
    source: Ints,
    row_start: Ints,
) -> None:
    at, epoch = 0, 0
    quantities = column.size
    order = np.empty(rsu.shape[1], dtype=np.int64)
    for i in range(heard_by.size):
        if heard_by[i] == 0:
            continue
        row_start[epoch] = at
        for j in range(heard_by[i]):  # insertion sort by name
            place = j
            while place > 0 and rank[rsu[i, order[place - 1]]] > rank[rsu[i, j]]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = j
        for group in range(heard_by[i]):
            j = order[group]
            for q in range(quantities):
                rows[at] = templates[rsu[i, j], q]
                variance = scale[q] * scale[q] * variances[i, j, column[q]]
                rows[at, VALUE] = scale[q] * values[i, j, column[q]]
                rows[at, VARIANCE] = variance
                rows[at, GATE_VARIANCE] = variance
                rows[at, GROUP] = group
                source[at] = rsu[i, j] * quantities + q
                at += 1
        epoch += 1
    row_start[epoch] = at


def observation_rows(
    seen: Observations, templates: RowTemplates, first_bias: int
) -> tuple[Ints, Ints, Array, Array]:
    """Epochs (N,) as indices of the beacons that were heard, row_start (N + 1,), rows
    (M, ROW_WIDTH) and biases (2, k): the rows of ``rsu_rows`` of every measurement, RSUs in the
    order of their names.

    The slow errors of what is heard are the states ``first_bias``, ``first_bias`` + 1, ... in the
    order in which they are first heard, as a tracker numbers them.
    """
    heard = np.flatnonzero(seen.heard_by)
    rows = np.empty((int(seen.heard_by.sum()) * templates.column.size, ROW_WIDTH))
    source = np.empty(len(rows), dtype=np.int64)
    row_start = np.zeros(heard.size + 1, dtype=np.int64)
    _fill(
        seen.heard_by,
        seen.rsu,
        seen.values,
        seen.variances,
        templates.rows,
        templates.column,
        templates.scale,
        templates.rank,
        rows,
        source,
        row_start,
    )
    bias = templates.bias.reshape(-1, 2)
    known, first = np.unique(source, return_index=True)
    known = known[np.argsort(first)]
    biased = known[bias[known, 0] > 0.0]
    state = np.full(len(bias), -1)
    state[biased] = first_bias + np.arange(biased.size)
    rows[:, BIAS] = state[source]
    return heard, row_start, rows, bias[biased].T.copy()
