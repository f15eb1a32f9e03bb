"""Measurements to rows for the filters (``netpos.filters.measurement``)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from netpos.filters.compile import leaf
from netpos.filters.measurement import (
    AXES,
    BIAS,
    BLOCKED,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    KIND,
    LEVER,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.filters.motion import SPEED_OF_LIGHT_MPS
from netpos.filters.state import N_CORE
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement

# Plain integers: arithmetic of flags costs ten times as much.
_AZIMUTH, _ELEVATION, _TOA = int(Field.AZIMUTH), int(Field.ELEVATION), int(Field.TOA)
_RANGE, _PHASE, _POSITION = int(Field.RANGE), int(Field.PHASE), int(Field.POSITION)
_PLACE = HEADING - ORIGIN  # what of a row says where its RSU is
_MASTER, _ALONG = 12, 15  # in ``rsu_place``, after ORIGIN and AXES
_CONE = AngleConvention.CONE
ROWS_MAX = 7  # of one measurement: five scalars and a position


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


@dataclass(frozen=True, slots=True)
class Coupling:
    """How the slow and coloured errors of one RSU enter its rows, by kind; what is absent is white
    and unbiased."""

    bias: Mapping[Kind, int]  # state index of the RSU's own bias
    common: Mapping[Kind, int]  # state index of the bias its network shares
    inflation: Mapping[Kind, float]  # variance factor of correlated noise


UNCOUPLED = Coupling({}, {}, {})


@lru_cache(256)
def scalar_kinds(fields: int, convention: AngleConvention) -> tuple[Kind, ...]:
    """Kinds of the rows a measurement with these fields gives, in their order; those of a position
    are left out."""
    angles = (Kind.COSINE_Y, Kind.COSINE_Z) if convention is _CONE else (Kind(0), Kind(1))
    kinds = ((_AZIMUTH, angles[0]), (_ELEVATION, angles[1]), (_TOA, Kind.TOA))
    return tuple(
        kind
        for flag, kind in (*kinds, (_RANGE, Kind.RANGE), (_PHASE, Kind.PHASE))
        if fields & flag
    )


@leaf
def _put(rows: Array, at: int, kind: Kind, value: float, variance: float, place: Array) -> int:
    """Write a row; the index of the next one."""
    row = rows[at]
    row[KIND], row[VALUE] = kind.value, value
    row[VARIANCE] = row[GATE_VARIANCE] = variance
    row[BIAS] = row[COMMON] = -1.0
    for i in range(_PLACE):
        row[ORIGIN + i] = place[i]
    if kind == Kind.TOA or kind == Kind.RANGE:
        for i in range(3):
            row[ORIGIN + i] = place[_MASTER + i]
    elif kind == Kind.PHASE:
        for i in range(3):
            row[AXES + i] = place[_ALONG + i]
    return at + 1


@leaf
def _put_angle(
    rows: Array, at: int, kind: Kind, angle: float, variance: float, place: Array, cone: bool
) -> int:
    """``_put`` of an azimuth or elevation; of the sine, which is a direction cosine, where it is
    that of a cone. Its variance is at end-fire no smaller than the second-order term."""
    if not cone:
        return int(_put(rows, at, kind, angle, variance, place))
    cosine = Kind.COSINE_Y if kind == Kind.AZIMUTH else Kind.COSINE_Z
    of_sine = max(math.cos(angle) ** 2 * variance, variance * variance / 2.0)
    return int(_put(rows, at, cosine, math.sin(angle), of_sine, place))


@leaf
def put_scalars(
    rows: Array,
    at: int,
    group: int,
    heading: int,
    fields: int,
    cone: bool,
    place: Array,
    azimuth: float,
    azimuth_var: float,
    elevation: float,
    elevation_var: float,
    toa: float,
    toa_var: float,
    distance: float,
    distance_var: float,
    phase: float,
    phase_var: float,
    forward: float,
    left: float,
    up: float,
) -> int:
    """Write the rows of the scalar quantities that ``fields`` names from ``rows[at]`` on; the
    index after the last one.

    place : (18,) of ``rsu_place``; forward, left, up : lever arm [m]; the rest as measured
    """
    first, c = at, SPEED_OF_LIGHT_MPS
    if fields & _AZIMUTH:
        at = _put_angle(rows, at, Kind.AZIMUTH, azimuth, azimuth_var, place, cone)
    if fields & _ELEVATION:
        at = _put_angle(rows, at, Kind.ELEVATION, elevation, elevation_var, place, cone)
    if fields & _TOA:
        at = _put(rows, at, Kind.TOA, c * toa, c * c * toa_var, place)
    if fields & _RANGE:
        at = _put(rows, at, Kind.RANGE, distance, distance_var, place)
    if fields & _PHASE:
        at = _put(rows, at, Kind.PHASE, phase, phase_var, place)
    for i in range(first, at):
        rows[i, GROUP], rows[i, HEADING], rows[i, BLOCKED] = group, heading, 0.0
        rows[i, LEVER], rows[i, LEVER + 1], rows[i, LEVER + 2] = forward, left, up
    return at


def rsu_place(info: RsuInfo, axes: Array) -> Array:
    """Where an RSU is, for ``put_scalars``: position, ``axes`` (9,) of ``rsu_axes``, where its
    ranges and times count from, what its phases count along."""
    along, master, turns = array_direction(axes), info.position, axes[:3]
    if info.baseline_m > 0.0:
        master = info.position + info.baseline_m / 2.0 * along
        turns = 2.0 * math.pi * info.baseline_m / info.wavelength_m * along
    return np.concatenate([info.position, axes, master, turns])


def put_measurement(
    rows: Array, at: int, m: RsuMeasurement, cone: bool, place: Array, group: int, heading: int
) -> int:
    """Write the rows of one RSU measurement, without biases, from ``rows[at]`` on; the index after
    the last one. A position fix of its antenna becomes two decorrelated LINEAR rows."""
    fields = int(m.fields)
    at = put_scalars(
        rows,
        at,
        group,
        heading,
        fields,
        cone,
        place,
        m.azimuth_rad,
        m.azimuth_var,
        m.elevation_rad,
        m.elevation_var,
        m.toa_s,
        m.toa_var,
        m.range_m,
        m.range_var,
        m.phase_difference_rad,
        m.phase_difference_var,
        *m.lever_arm,
    )
    if fields & _POSITION:
        fix = linear_rows(m.position[:2], m.position_cov[:2, :2], np.eye(2, N_CORE), group)
        fix[:, HEADING:BLOCKED] = heading, *m.lever_arm
        rows[at : at + 2] = fix
        at += 2
    return at


def couple(rows: Array, kinds: tuple[Kind, ...], coupling: Coupling) -> None:
    """Write the slow and coloured errors of an RSU into the first rows of its measurement, whose
    ``kinds`` they are."""
    for row, kind in zip(rows, kinds, strict=False):
        row[VARIANCE] *= coupling.inflation.get(kind, 1.0)
        row[BIAS] = coupling.bias.get(kind, -1)
        row[COMMON] = coupling.common.get(kind, -1)


def rsu_rows(
    m: RsuMeasurement,
    info: RsuInfo,
    axes: Array,
    group: int,
    coupling: Coupling = UNCOUPLED,
    heading: int = -1,
) -> Array:
    """Rows (m, ROW_WIDTH) of one RSU measurement.

    axes : (9,) of ``rsu_axes``
    heading : state index of the device's heading, by which its lever arm turns; -1: none
    """
    rows = np.empty((ROWS_MAX, ROW_WIDTH))
    cone, place = info.angle_convention is _CONE, rsu_place(info, axes)
    end = put_measurement(rows, 0, m, cone, place, group, heading)
    couple(rows, scalar_kinds(int(m.fields), info.angle_convention), coupling)
    return rows[:end]


def linear_rows(value: Array, cov: Array, H: Array, group: int) -> Array:
    """Rows of a linear measurement ``value = H x + noise`` with full covariance, decorrelated by
    its Cholesky factor.

    value (m,), cov (m, m) positive definite, H (m, 6) of the core states. Raises ``LinAlgError``
    where cov is not.
    """
    L = np.linalg.cholesky((cov + cov.T) / 2.0)
    rows = np.zeros((len(value), ROW_WIDTH))
    rows[:, KIND] = Kind.LINEAR
    rows[:, VALUE] = np.linalg.solve(L, value)
    rows[:, VARIANCE] = rows[:, GATE_VARIANCE] = 1.0
    rows[:, BIAS] = rows[:, COMMON] = rows[:, HEADING] = -1
    rows[:, GROUP] = group
    rows[:, ORIGIN : ORIGIN + N_CORE] = np.linalg.solve(L, H)
    return rows


def speed_row(speed_mps: float, variance: float, group: int) -> Array:
    """Row (1, ROW_WIDTH) of a ground-speed measurement."""
    row = np.zeros((1, ROW_WIDTH))
    row[0, :ORIGIN] = Kind.SPEED, speed_mps, variance, variance, -1, -1, group
    row[0, HEADING] = -1
    return row
