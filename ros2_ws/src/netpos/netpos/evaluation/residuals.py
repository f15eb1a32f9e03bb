"""Residuals of each RSU and quantity against the track, without ground truth.

The track was made of these measurements, so residuals are smaller than errors; but a track of
several RSUs follows none of them, and what one of them keeps to one side shows.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from netpos.estimation.measurement import HEADING, KIND, LEVER, VALUE, VARIANCE, predict_row, wrap
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.rows import rsu_axes, rsu_place, rsu_rows
from netpos.estimation.sensors.model import Wraps
from netpos.estimation.sensors.table import BY_KIND
from netpos.estimation.state import N_CORE, POSITION, VELOCITY, X
from netpos.evaluation.pairing import ClockOffsets, Trajectory
from netpos.messages.values import (
    Array,
    Field,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
)

_NORMAL_QUARTILE = 0.6744897501960817
_FEW = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Residuals:
    """One quantity of one RSU; bias, scatter and stated are in ``unit`` (m, deg or 1).

    bias : median; scatter : sd by the median absolute deviation; stated : median of the sd
    stated; correlation_s : the lag at which the correlation falls below 1/e, None: within one
    interval; far : share beyond 4 of the stated sd; learned : in words, where it was
    """

    rsu_id: str
    quantity: str
    unit: str
    count: int
    bias: float
    scatter: float
    stated: float
    correlation_s: float | None
    far: float
    learned: str = ""


@dataclass(frozen=True, slots=True)
class Series:
    """Residuals of one quantity of one RSU over time: (n,) s, in ``unit``, and the sd stated."""

    rsu_id: str
    quantity: str
    unit: str
    stamp_ns: Array
    residual: Array
    stated: Array


def series_of(
    measurements: Iterable[RsuMeasurement],
    rsus: Mapping[str, RsuInfo],
    track: Trajectory,
    clock: ClockOffsets,
) -> list[Series]:
    """Residuals of the measurements at whose stamps the track has a pose, by RSU and quantity;
    times of arrival where the clock is known too."""
    poses = {stamp: index for index, stamp in enumerate(track.stamp_ns.tolist())}
    clocks = dict(zip(clock.stamp_ns.tolist(), clock.offset_s.tolist(), strict=True))
    axes = {name: rsu_axes(info) for name, info in rsus.items()}
    places = {name: rsu_place(info, axes[name]) for name, info in rsus.items()}
    values_by_key: dict[tuple[str, str], list[tuple[int, float, float]]] = defaultdict(list)
    h = np.empty(N_CORE)
    for m in measurements:
        pose = poses.get(m.stamp_ns)
        info = rsus.get(m.rsu_id)
        if pose is None or info is None:
            continue
        if Field.TDOA in m.fields and m.reference_rsu_id not in places:
            continue
        rows = rsu_rows(m, info, axes[m.rsu_id], 0, reference=places.get(m.reference_rsu_id))
        state, height_m = _state(track, pose, clocks.get(m.stamp_ns, 0.0), rows)
        name = f"{m.rsu_id}-{m.reference_rsu_id}" if m.reference_rsu_id else m.rsu_id
        for row in rows:
            sensor = BY_KIND[int(row[KIND])]
            if sensor.reading is None or (sensor.has_clock and m.stamp_ns not in clocks):
                continue
            residual = float(row[VALUE] - predict_row(row, state, height_m, h))
            if sensor.wraps is not Wraps.NEVER:
                residual = float(wrap(residual))
            values_by_key[name, sensor.name].append(
                (m.stamp_ns, residual, math.sqrt(row[VARIANCE]))
            )
    return [_series(key, values) for key, values in sorted(values_by_key.items())]


def _state(
    track: Trajectory, index: int, clock_offset_s: float, rows: Array
) -> tuple[Array, float]:
    """State (6,) of the antenna that the rows measured, and its height; their lever arms are taken
    out."""
    state = np.zeros(N_CORE)
    heading = float(track.heading[index])
    cos, sin = math.cos(heading), math.sin(heading)
    ahead, left, up = rows[0, LEVER : LEVER + 3].tolist() if len(rows) else (0.0, 0.0, 0.0)
    arm = np.array([cos * ahead - sin * left, sin * ahead + cos * left])
    state[POSITION] = track.position[index, :2] + arm
    state[VELOCITY] = track.velocity[index, :2]
    state[X.CLOCK] = SPEED_OF_LIGHT_MPS * clock_offset_s
    rows[:, LEVER : LEVER + 3] = 0.0
    rows[:, HEADING] = -1
    return state, float(track.position[index, 2]) + up


def _series(key: tuple[str, str], values: list[tuple[int, float, float]]) -> Series:
    rsu_id, quantity = key
    stamps, residual, stated = (np.array(column) for column in zip(*sorted(values), strict=True))
    cyclic = any(
        sensor.name == quantity and sensor.wraps is not Wraps.NEVER for sensor in BY_KIND.values()
    )
    cosine = quantity.startswith("COSINE")
    unit = "" if cosine else "deg" if cyclic or quantity == "ELEVATION" else "m"
    scale = math.degrees(1.0) if unit == "deg" else 1.0
    return Series(rsu_id, quantity, unit, stamps, scale * residual, scale * stated)


def summary(series: Series, learned: str = "") -> Residuals:
    """The figures of one series."""
    r = series.residual
    bias = float(np.median(r))
    return Residuals(
        rsu_id=series.rsu_id,
        quantity=series.quantity,
        unit=series.unit,
        count=len(r),
        bias=bias,
        scatter=float(np.median(np.abs(r - bias))) / _NORMAL_QUARTILE,
        stated=float(np.median(series.stated)),
        correlation_s=correlation_s(series.stamp_ns, r - bias),
        far=float(np.mean(np.abs(r) > 4.0 * series.stated)),
        learned=learned,
    )


def correlation_s(stamp_ns: Array, residual: Array) -> float | None:
    """The lag [s] at which the correlation of (n,) residuals falls below 1/e; None where that is
    within one interval, or there are few."""
    if len(residual) < _FEW:
        return None
    limit = float(np.median(np.abs(residual))) / _NORMAL_QUARTILE * 4.0
    r = np.clip(residual, -limit, limit)
    power = float(r @ r)
    interval_s = float(np.median(np.diff(stamp_ns))) * 1e-9
    if power <= 0.0 or interval_s <= 0.0:
        return None
    for lag in range(1, len(r) // 2):
        if float(r[lag:] @ r[:-lag]) / power < math.exp(-1.0):
            return lag * interval_s if lag > 1 else None
    return len(r) // 2 * interval_s


def newest(errors: Iterable[RsuErrors]) -> dict[tuple[str, str], RsuErrors]:
    """The newest learned errors, by RSU and quantity."""
    newest_by_key: dict[tuple[str, str], RsuErrors] = {}
    for report in errors:
        for quantity in report.quantities:
            newest_by_key[report.rsu_id, quantity] = report
    return newest_by_key
