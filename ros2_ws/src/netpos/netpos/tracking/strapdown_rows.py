"""The measurements of one epoch as rows in space, and how they fit a navigation state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from netpos.estimation.measurement import GATE_VARIANCE, Kind
from netpos.estimation.rows import UNCOUPLED, rsu_rows
from netpos.estimation.sensors.table import readings
from netpos.estimation.space import direction_rows, linearise_in_space, place_rows
from netpos.messages.values import Array, Field, GroundSpeed, RsuMeasurement
from netpos.tracking.epoch_rows import EpochRows, reference_place, shared_references
from netpos.tracking.rsus import BiasStates, Rsu
from netpos.tracking.sequencer import Item

_SCALARS = Field(0)
for _sensor, _reading in readings():
    if _sensor.in_strapdown:
        _SCALARS |= _reading.field
_AHEAD = np.array([[1.0, 0.0, 0.0]])

Source = RsuMeasurement | GroundSpeed


def usable(item: Item) -> bool:
    """Whether a strapdown track has rows for it: no velocity in map, no phase difference."""
    if isinstance(item, RsuMeasurement):
        return bool(item.fields & (_SCALARS | Field.POSITION))
    return isinstance(item, GroundSpeed)


def epoch_rows_3d(
    items: Sequence[Source], rsus: Mapping[str, Rsu], biases: BiasStates | None
) -> EpochRows:
    """Rows of the items, one group each; biases heard for the first time are added to ``biases``
    (None: rows without)."""
    blocks = []
    shared = shared_references(items)
    for group, item in enumerate(items):
        if isinstance(item, GroundSpeed):
            value, variance = np.array([item.speed_mps]), np.array([item.speed_var])
            rows = direction_rows(Kind.BODY_VELOCITY, _AHEAD, value, variance, group)
            blocks.append(rows)
            continue
        if item.fields & _SCALARS:
            rsu = rsus[item.rsu_id]
            scalars = replace(item, fields=item.fields & _SCALARS)
            coupling = (
                UNCOUPLED
                if biases is None
                else biases.coupling(rsu, scalars, item.reference_rsu_id in shared)
            )
            reference = reference_place(scalars, rsus)
            block = rsu_rows(scalars, rsu.info, rsu.axes, group, coupling, reference=reference)
            blocks.append(block)
        if item.fields & Field.POSITION:
            blocks.append(place_rows(item.position, item.position_cov, item.lever_arm, group))
    return EpochRows(np.vstack(blocks), tuple(items))


def innovations_with_sd_3d(rows: Array, nav: Array, cov: Array) -> Array:
    """Innovation of each row (m, ROW_WIDTH) at nav (n + 1,) and its standard deviation under cov
    (n, n): (m, 2)."""
    innovation, H, bend = linearise_in_space(rows, nav, cov)
    variance = np.einsum("ij,jk,ik->i", H, cov, H) + rows[:, GATE_VARIANCE] + bend
    return np.column_stack([innovation, np.sqrt(variance)])
