"""The measurements of one epoch as rows for the filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from netpos.filters.measurement import UNCOUPLED, linear_rows, rsu_rows, speed_row
from netpos.messages.values import Array, GroundSpeed, RsuMeasurement, Velocity
from netpos.tracking.rsus import BiasStates, Rsu

Source = RsuMeasurement | Velocity | GroundSpeed
_VELOCITY_H = np.eye(2, 6, k=2)


@dataclass(frozen=True, slots=True)
class Batch:
    """Rows (m, ROW_WIDTH) of one epoch and, per group, the item they come from."""

    rows: Array
    items: tuple[Source, ...]


def batch_of(
    items: Sequence[Source], rsus: Mapping[str, Rsu], biases: BiasStates | None, heading: int
) -> Batch:
    """Rows of the items, one group each; biases heard for the first time are added to ``biases``
    (None: rows without). heading : state index of the device's heading, -1: none"""
    blocks = []
    for group, item in enumerate(items):
        if isinstance(item, RsuMeasurement):
            rsu = rsus[item.rsu_id]
            coupling = UNCOUPLED if biases is None else biases.coupling(rsu, item)
            blocks.append(rsu_rows(item, rsu.info, rsu.axes, group, coupling, heading))
        elif isinstance(item, Velocity):
            blocks.append(linear_rows(item.velocity, item.cov, _VELOCITY_H, group))
        else:
            blocks.append(speed_row(item.speed_mps, item.speed_var, group))
    return Batch(np.vstack(blocks) if len(blocks) > 1 else blocks[0], tuple(items))
