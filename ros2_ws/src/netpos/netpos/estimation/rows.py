"""Measurements to rows for the filters (``netpos.estimation.measurement``)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import inlined, leaf, link
from netpos.estimation.dispatch import Kernel, choose
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    BLOCKED,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    HEIGHT,
    KIND,
    LEVER,
    ORIGIN,
    OUTLIER_SHARE,
    REFERENCE,
    ROW_WIDTH,
    SAME_BEND,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.estimation.sensors.model import Reading
from netpos.estimation.sensors.table import readings
from netpos.estimation.state import KNOWN_HEIGHT, N_CORE, HeightState
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement

_POSITION = int(Field.POSITION)  # a plain integer: arithmetic of flags costs ten times as much
_MIDDLE, _POSE, _MASTER, _ALONG = 0, 3, 12, 15  # in ``rsu_place``
_CONE = AngleConvention.CONE
_HEIGHT_SD_MIN_M, _HEIGHT_SD_MAX_M = 1e-6, 1e6  # of a fix whose height counts
_CORRELATION_MARGIN = 1e-9
ROWS_MAX = len({reading.field for _, reading in readings()}) + 3
"""Rows of one measurement at most: its scalars and a position."""


def rsu_axes(info: RsuInfo) -> Array:
    """Rotation map -> RSU axes, row-major (9,), of the RSU's pose."""
    x, y, z, w = (info.quaternion / np.linalg.norm(info.quaternion)).tolist()
    return np.array(  # by hand: SciPy's Rotation would cost every tracker 24 MB and 0.2 s
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y + z * w),
            2.0 * (x * z - y * w),
            2.0 * (x * y - z * w),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z + x * w),
            2.0 * (x * z + y * w),
            2.0 * (y * z - x * w),
            1.0 - 2.0 * (x * x + y * y),
        ]
    )


def array_direction(axes: Array) -> Array:
    """Unit vector (3,) in map along a two-antenna array, slave to master, for ``axes`` (9,) of
    ``rsu_axes``: the paper's x axis, to the right of the boresight."""
    return -axes[3:6]


class RowErrors(NamedTuple):
    """How the slow and coloured errors of an RSU enter one of its rows."""

    bias: int = -1
    """State index of the RSU's own bias; -1: it has none."""
    common: int = -1
    """State index of the bias its network shares; -1: there is none."""
    reference: int = 0
    """State index of the bias of the RSU that a difference counts from; 0: there is none."""
    inflation: float = 1.0
    """Variance factor of correlated noise."""
    gate: float = 1.0
    """Variance factor of single values."""
    same_bend: float = 0.0
    """How many more values have the same bend: what linearising leaves out."""
    stretch: float = 0.0
    """Share by which the distance is too long; it is taken out."""


WHITE = RowErrors()


class ScalarPlan(NamedTuple):
    """What the scalar rows of a measurement are made of, k of them."""

    kinds: tuple[Kind, ...]
    read: attrgetter[tuple[float, ...]] | None
    """Gives value and variance of each, one after the other; None: no rows."""
    sources: npt.NDArray[np.int64]
    """(k, 3): kind, and where in ``rsu_place`` its ORIGIN and the first of its AXES are."""
    referenced: tuple[int, ...]
    """Which of them compare the RSU with a second one."""


@lru_cache(256)
def scalar_plan(fields: int, cone: bool) -> ScalarPlan:
    """Plan of a measurement with these ``fields`` by an RSU whose angles are those of linear
    arrays, or not."""
    convention = _CONE if cone else AngleConvention.SPHERICAL
    chosen = [
        (sensor, reading)
        for sensor, reading in readings()
        if fields & reading.field and reading.convention in (None, convention)
    ]
    names = [name for _, r in chosen for name in (r.value, r.variance)]
    sources = [
        (s.kind, _MASTER if r.from_master else _MIDDLE, _ALONG if r.along_array else _POSE)
        for s, r in chosen
    ]
    return ScalarPlan(
        tuple(Kind(sensor.kind) for sensor, _ in chosen),
        attrgetter(*names) if names else None,
        np.array(sources, dtype=np.int64).reshape(-1, 3),
        tuple(k for k, (sensor, _) in enumerate(chosen) if sensor.difference_of >= 0),
    )


def scalar_kinds(fields: int, convention: AngleConvention) -> tuple[Kind, ...]:
    """Kinds of the rows a measurement with these fields gives, in their order; those of a position
    are left out."""
    return scalar_plan(fields, convention is _CONE).kinds


@inlined
def _as_it_is(value: float, variance: float) -> tuple[float, float]:
    return value, variance


def _converted(reading: Reading) -> Kernel:
    """Value and variance of the message to those of the row."""
    scale, to_row = reading.scale, reading.to_row or _as_it_is

    @link
    def converted(value: float, variance: float) -> tuple[float, float]:
        return to_row(scale * value, scale * scale * variance)  # type: ignore[no-any-return]

    return converted  # type: ignore[no-any-return]


_to_row = choose([(sensor.kind, _converted(reading)) for sensor, reading in readings()], _as_it_is)


@leaf
def put_scalars(
    rows: Array,
    at: int,
    sources: npt.NDArray[np.int64],
    values: Array,
    place: Array,
    lever_arm: tuple[float, float, float],
    group: int,
    heading: int,
) -> int:
    """Write the rows of scalar quantities from ``rows[at]`` on; the index after the last one.

    sources : (k, 3) of ``ScalarPlan``; values : (2 k,) as its ``read`` gives them
    place : (18,) of ``rsu_place``
    """
    for k in range(sources.shape[0]):
        row, kind = rows[at + k], sources[k, 0]
        value, variance = _to_row(kind, values[2 * k], values[2 * k + 1])
        row[KIND], row[VALUE] = kind, value
        row[VARIANCE] = row[GATE_VARIANCE] = variance
        row[BIAS] = row[COMMON] = -1.0
        row[GROUP], row[HEADING] = group, heading
        row[BLOCKED] = row[HEIGHT] = row[REFERENCE] = row[SAME_BEND] = row[OUTLIER_SHARE] = 0.0
        for i in range(HEADING - AXES):
            row[AXES + i] = place[_POSE + i]
        for i in range(3):
            row[ORIGIN + i] = place[sources[k, 1] + i]
            row[AXES + i] = place[sources[k, 2] + i]
        row[LEVER], row[LEVER + 1], row[LEVER + 2] = lever_arm[0], lever_arm[1], lever_arm[2]
    return int(at + sources.shape[0])


def rsu_place(info: RsuInfo, axes: Array) -> Array:
    """Where an RSU is (18,), for ``put_scalars``: position, ``axes`` (9,) of ``rsu_axes``, where
    its ranges and times count from, what its phases count along."""
    along, master, turns = array_direction(axes), info.position, axes[:3]
    if info.baseline_m > 0.0:
        master = info.position + info.baseline_m / 2.0 * along
        turns = 2.0 * math.pi * info.baseline_m / info.wavelength_m * along
    return np.concatenate([info.position, axes, master, turns])


def put_measurement(
    rows: Array,
    at: int,
    m: RsuMeasurement,
    sites: tuple[bool, Array, Array | None],
    group: int,
    heading: int,
    height: HeightState = KNOWN_HEIGHT,
) -> int:
    """Write the rows of one RSU measurement, without biases, from ``rows[at]`` on; the index after
    the last one. A position fix of its antenna becomes two decorrelated LINEAR rows, or three
    where the height is a state and the fix has one.

    sites : whether the RSU's angles are those of linear arrays, its ``rsu_place``, and that of the
        second RSU of a difference
    """
    start = at
    fields, (cone, place, reference) = int(m.fields), sites
    plan = scalar_plan(fields, cone)
    if plan.read is not None:
        values = np.array(plan.read(m), np.float64)
        first = at
        at = put_scalars(rows, at, plan.sources, values, place, m.lever_arm, group, heading)
        for k in plan.referenced:
            if reference is None:
                raise ValueError(f"the difference of {m.rsu_id} needs the place of a second RSU")
            between = reference[_MASTER : _MASTER + 3] - place[_MASTER : _MASTER + 3]
            rows[first + k, AXES : AXES + 3] = between
    if fields & _POSITION:
        fix = _fix_rows(m, group, height)
        fix[:, HEADING:BLOCKED] = heading, *m.lever_arm
        rows[at : at + len(fix)] = fix
        at += len(fix)
    if height.entry:
        rows[start:at, HEIGHT] = height.entry
    return at


def _fix_rows(m: RsuMeasurement, group: int, height: HeightState) -> Array:
    """Rows (2 or 3, ROW_WIDTH) of a position fix."""
    if height.entry and _has_height(m.position, m.position_cov):
        H = np.zeros((3, N_CORE + 1))
        H[:2, :2], H[2, N_CORE] = np.eye(2), 1.0
        return linear_rows(m.position - (0.0, 0.0, height.nominal_m), m.position_cov, H, group)
    return linear_rows(m.position[:2], m.position_cov[:2, :2], np.eye(2, N_CORE), group)


def _has_height(position: Array, cov: Array) -> bool:
    """Whether the third component of a fix counts: it is finite, and ``cov`` (3, 3) symmetric and
    positive definite beyond rounding."""
    if not (math.isfinite(position[2]) and np.isfinite(cov).all() and np.allclose(cov, cov.T)):
        return False
    sd = np.sqrt(np.maximum(np.diag(cov), 0.0))
    if not _HEIGHT_SD_MIN_M <= sd[2] <= _HEIGHT_SD_MAX_M:
        return False
    return bool(np.linalg.eigvalsh(cov / np.outer(sd, sd))[0] > _CORRELATION_MARGIN)


def couple(rows: Array, errors: Sequence[RowErrors]) -> None:
    """Write the slow and coloured errors of an RSU into the first rows of its measurement."""
    for row, own in zip(rows, errors, strict=False):
        row[VALUE] /= 1.0 + own.stretch
        row[VARIANCE] *= own.inflation
        row[GATE_VARIANCE] *= own.gate
        row[BIAS], row[COMMON], row[REFERENCE] = own.bias, own.common, own.reference
        row[SAME_BEND] = own.same_bend


def drop_biases(rows: Array) -> None:
    """Let ``rows`` (m, ROW_WIDTH) name no states of slow errors, in place."""
    rows[:, BIAS] = rows[:, COMMON] = -1.0
    rows[:, REFERENCE] = 0.0


def rsu_rows(
    m: RsuMeasurement,
    info: RsuInfo,
    axes: Array,
    group: int,
    errors: Sequence[RowErrors] = (),
    heading: int = -1,
    reference: Array | None = None,
    height: HeightState = KNOWN_HEIGHT,
) -> Array:
    """Rows (m, ROW_WIDTH) of one RSU measurement.

    axes : (9,) of ``rsu_axes``; errors : of its scalar rows
    reference : ``rsu_place`` of the second RSU of a difference
    heading : state index of the device's heading, by which its lever arm turns; -1: none
    """
    rows = np.empty((ROWS_MAX, ROW_WIDTH))
    sites = info.angle_convention is _CONE, rsu_place(info, axes), reference
    end = put_measurement(rows, 0, m, sites, group, heading, height)
    couple(rows, errors)
    return rows[:end]


def linear_rows(value: Array, cov: Array, H: Array, group: int) -> Array:
    """Rows of a linear measurement ``value = H x + noise`` with full covariance, decorrelated by
    its Cholesky factor.

    value (m,), cov (m, m) positive definite, H (m, 6) of the core states, or (m, 7) with the
    height. Raises ``LinAlgError`` where cov is not.
    """
    L = np.linalg.cholesky((cov + cov.T) / 2.0)
    rows = np.zeros((len(value), ROW_WIDTH))
    rows[:, KIND] = Kind.LINEAR
    rows[:, VALUE] = np.linalg.solve(L, value)
    rows[:, VARIANCE] = rows[:, GATE_VARIANCE] = 1.0
    rows[:, BIAS] = rows[:, COMMON] = rows[:, HEADING] = -1
    rows[:, GROUP] = group
    rows[:, ORIGIN : ORIGIN + H.shape[1]] = np.linalg.solve(L, H)
    return rows


def speed_row(speed_mps: float, variance: float, group: int) -> Array:
    """Row (1, ROW_WIDTH) of a ground-speed measurement."""
    row = np.zeros((1, ROW_WIDTH))
    row[0, :ORIGIN] = Kind.SPEED, speed_mps, variance, variance, -1, -1, group
    row[0, HEADING] = -1
    return row
