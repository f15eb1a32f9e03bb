"""The measurements of one epoch as rows for the filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from netpos.filters.measurement import (
    BIAS,
    COMMON,
    KIND,
    UNCOUPLED,
    VARIANCE,
    Kind,
    linear_rows,
    linearise,
    rsu_rows,
    speed_row,
)
from netpos.messages.values import Array, GroundSpeed, RsuMeasurement, Velocity
from netpos.tracking.rsus import BiasStates, Rsu

Source = RsuMeasurement | Velocity | GroundSpeed
_VELOCITY_H = np.eye(2, 6, k=2)


@dataclass(frozen=True, slots=True)
class Batch:
    """Rows (m, ROW_WIDTH) of one epoch and, per group, the item they come from."""

    rows: Array
    items: tuple[Source, ...]

    def slow_variance(self, biases: BiasStates) -> Array:
        """Variance (m,) that the slow errors add to each row before there are states of them."""
        mean = np.zeros(biases.first + len(biases.sd))
        for item in self.items:
            if isinstance(item, Velocity):
                mean[2:4] = item.velocity  # the faster, the more a factor changes
        _, H = linearise(self.rows, mean, 0.0)
        variance: Array = np.square(H[:, biases.first :]) @ np.square(biases.sd)
        return variance


def batch_of(
    items: Sequence[Source],
    rsus: Mapping[str, Rsu],
    biases: BiasStates | None,
    heading: int,
    inflation: Mapping[str, float] | None = None,
) -> Batch:
    """Rows of the items, one group each; biases heard for the first time are added to ``biases``
    (None: rows without).

    heading : state index of the device's heading, -1: none
    inflation : variance factor of velocities with correlated errors, by source
    """
    blocks = []
    for group, item in enumerate(items):
        if isinstance(item, RsuMeasurement):
            rsu = rsus[item.rsu_id]
            coupling = UNCOUPLED if biases is None else biases.coupling(rsu, item)
            blocks.append(rsu_rows(item, rsu.info, rsu.axes, group, coupling, heading))
        elif isinstance(item, Velocity):
            rows = linear_rows(item.velocity, item.cov, _VELOCITY_H, group)
            rows[:, VARIANCE] *= (inflation or {}).get(item.source, 1.0)
            states = (-1, -1) if biases is None else biases.of_steps(item.source)
            if max(states) >= 0:
                rows[:, KIND], rows[:, BIAS], rows[:, COMMON] = Kind.STEP_VELOCITY, *states
            blocks.append(rows)
        else:
            blocks.append(speed_row(item.speed_mps, item.speed_var, group))
    return Batch(np.vstack(blocks) if len(blocks) > 1 else blocks[0], tuple(items))


def velocity_inflation(
    items: Sequence[Source], last_ns: Mapping[str, int], tau_s: float
) -> dict[str, float]:
    """Variance factors of velocities whose errors last, by source: white noise of the same
    spectral density at 0 (as ``BiasStates`` has it for RSUs).

    last_ns : stamp of the last velocity fused, by source; tau_s : correlation time, 0 for white
    """
    factors = {}
    for item in items:
        if tau_s > 0.0 and isinstance(item, Velocity) and item.source in last_ns:
            since_s = (item.stamp_ns - last_ns[item.source]) * 1e-9
            factors[item.source] = max(1.0, tau_s / since_s) if since_s > 0.0 else 1.0
    return factors


def mostly_accepted(batch: Batch, accepted: Array) -> bool:
    """Whether at least half of the RSUs, or of all where there is none, were accepted."""
    votes = [
        bool(taken)
        for item, taken in zip(batch.items, accepted, strict=True)
        if isinstance(item, RsuMeasurement)
    ] or [bool(taken) for taken in accepted]
    return 2 * sum(votes) >= len(votes)
