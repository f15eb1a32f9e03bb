"""The measurements of one epoch as rows for the filters, and how they fitted."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from netpos.estimation.measurement import (
    BIAS,
    COMMON,
    GROUP,
    HEIGHT,
    KIND,
    ROW_WIDTH,
    VARIANCE,
    Kind,
    linearise,
)
from netpos.estimation.rows import (
    ROWS_MAX,
    couple,
    linear_rows,
    put_measurement,
    speed_row,
)
from netpos.estimation.state import KNOWN_HEIGHT, N_CORE, VELOCITY, HeightState, X
from netpos.messages.values import Array, Field, GroundSpeed, RsuMeasurement, Velocity
from netpos.tracking.rsus.rsu import REFERENCED, BiasStates, Rsu, values_as_one

Source = RsuMeasurement | Velocity | GroundSpeed
Sites = tuple[bool, Array, Array | None]
"""As ``rows.put_measurement`` takes them."""
_TOA = int(Field.TOA)
_VELOCITY_H = np.eye(2, N_CORE, k=X.VX)


@dataclass(slots=True)
class EpochRows:
    """Rows (m, ROW_WIDTH) of one epoch and, per group, the item they come from."""

    rows: Array
    items: tuple[Source, ...]

    @property
    def has_time(self) -> bool:
        """Whether there is a time of arrival in it."""
        return any(isinstance(i, RsuMeasurement) and int(i.fields) & _TOA for i in self.items)

    def slow_variance(self, biases: BiasStates) -> Array:
        """Variance (m,) that the slow errors add to each row before there are states of them; the
        height is no error, a first fix estimates it."""
        mean = np.zeros(biases.first + len(biases.sd))
        for item in self.items:
            if isinstance(item, Velocity):
                mean[VELOCITY] = item.velocity  # the faster, the more a factor changes
        rows = self.rows
        if rows[:, HEIGHT].any():
            rows = rows.copy()
            rows[:, HEIGHT] = 0.0
        _, H = linearise(rows, mean, 0.0)
        variance: Array = np.square(H[:, biases.first :]) @ np.square(biases.sd)
        return variance


class RowForm(NamedTuple):
    """How the rows of an epoch are written for an estimator.

    put : ``rows.put_measurement`` of it, called with the rows, the index of the first one to
        write, the measurement, its ``Sites`` and its group; returns the index after the last one
    speed : row (1, ROW_WIDTH) of a ground speed, its variance and its group
    """

    put: Callable[[Array, int, RsuMeasurement, Sites, int], int]
    speed: Callable[[float, float, int], Array]


def planar_form(heading: int = -1, height: HeightState = KNOWN_HEIGHT) -> RowForm:
    """Rows of a planar estimator; ``heading``: state index of the device's heading, -1: none;
    ``height``: where its height is."""
    return RowForm(partial(put_measurement, heading=heading, height=height), speed_row)


_PLANAR = planar_form()


def reference_of(m: RsuMeasurement, rsus: Mapping[str, Rsu]) -> Rsu | None:
    """The RSU that a difference counts from; None where there is none."""
    return rsus[m.reference_rsu_id] if int(m.fields) & REFERENCED else None


def shared_references(items: Sequence[Source]) -> Collection[str]:
    """RSUs that several differences of one epoch count from, whose error these share."""
    if len(items) < 2:
        return ()
    names = [
        item.reference_rsu_id
        for item in items
        if isinstance(item, RsuMeasurement) and int(item.fields) & REFERENCED
    ]
    return {name for name in names if names.count(name) > 1}


def epoch_rows_of(
    items: Sequence[Source],
    rsus: Mapping[str, Rsu],
    biases: BiasStates | None,
    form: RowForm = _PLANAR,
    inflation: Mapping[str, float] | None = None,
) -> EpochRows:
    """Rows of the items, one group each; biases heard for the first time are added to ``biases``
    (None: rows without).

    form : of the estimator that takes them
    inflation : variance factor of velocities with correlated errors, by source
    """
    rows, end = np.empty(((ROWS_MAX + 1) * len(items), ROW_WIDTH)), 0
    shared = shared_references(items)
    for group, item in enumerate(items):
        first = end
        if isinstance(item, RsuMeasurement):
            rsu, reference = rsus[item.rsu_id], reference_of(item, rsus)
            sites = rsu.cone, rsu.place, None if reference is None else reference.place
            end = form.put(rows, first, item, sites, group)
            if biases is None:
                continue
            shares = item.reference_rsu_id in shared
            stated = rows[first:end, VARIANCE]
            couple(rows[first:end], biases.row_errors(rsu, item, stated, reference, shares))
            continue
        if isinstance(item, Velocity):
            block = linear_rows(item.velocity, item.cov, _VELOCITY_H, group)
            block[:, VARIANCE] *= (inflation or {}).get(item.source, 1.0)
            states = (-1, -1) if biases is None else biases.of_steps(item.source)
            if max(states) >= 0:
                block[:, KIND], block[:, BIAS], block[:, COMMON] = Kind.STEP_VELOCITY, *states
        else:
            block = form.speed(item.speed_mps, item.speed_var, group)
        end += len(block)
        rows[first:end] = block
    return EpochRows(rows[:end].copy(), tuple(items))  # the rest would be kept, too


def velocity_inflation(
    items: Sequence[Source], last_ns: Mapping[str, int], tau_s: float
) -> dict[str, float]:
    """``values_as_one`` of velocities whose errors last, by source.

    last_ns : stamp of the last velocity fused, by source; tau_s : correlation time, 0 for white
    """
    factors = {}
    for item in items:
        if tau_s > 0.0 and isinstance(item, Velocity) and item.source in last_ns:
            since_s = (item.stamp_ns - last_ns[item.source]) * 1e-9
            factors[item.source] = values_as_one(tau_s, since_s)
    return factors


def mostly_accepted(epoch_rows: EpochRows, accepted: Sequence[float]) -> bool:
    """Whether at least half of the RSUs, or of all where there is none, were accepted."""
    votes = [
        bool(taken)
        for item, taken in zip(epoch_rows.items, accepted, strict=True)
        if isinstance(item, RsuMeasurement)
    ] or [bool(taken) for taken in accepted]
    return 2 * sum(votes) >= len(votes)


def widen(innovations: Array, rows: Array, rsu: Rsu, reference: Rsu | None) -> None:
    """Let the sd in ``innovations`` (m, 2) of ``rows`` without bias states hold the biases of the
    RSU and of the ``reference`` of differences, in place."""
    for pair, row in zip(innovations, rows, strict=True):
        pair[1] = math.hypot(pair[1], rsu.bias_sd(Kind(int(row[KIND])), reference))


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
