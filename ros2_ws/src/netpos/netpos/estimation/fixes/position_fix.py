"""A position from one epoch of measurements: iterated weighted least squares in space.

deng2022:eq.2-6: z - f(r0) = H x + noise, x = (H' P H)^-1 H' P z, again from r0 + x until x is
small. Weights are 1 / sigma^2, angles in radians and their residuals wrapped. Ranges alone leave
the height open where all stations stand at about one height: the normal matrix then loses its
rank on the way, and the fix is refused rather than given.

Times of arrival share a clock offset nobody knows: a fourth unknown, eliminated from the normal
equations (its Schur complement), so that only their differences count.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.measurement import (
    AXES,
    KIND,
    ORIGIN,
    VALUE,
    VARIANCE,
    Kind,
    has_clock,
    is_angle,
    is_range,
    wrap,
)
from netpos.estimation.spatial.space import value_at
from netpos.messages.values import Array

MAX_ITERATIONS = 100
STEP_M = 1e-3
"""A fix has converged once its step is shorter."""
SD_MAX_M = 1e3
"""A geometry that leaves a direction less certain than this is none."""
_LONGEST_STEP_M = 50.0
_HALVINGS = 6


class FixStatus(IntEnum):
    """Why a fix is one, or none."""

    CONVERGED = 0
    TOO_FEW = 1  # fewer quantities than unknowns
    GEOMETRY = 2  # the measurements leave a direction open
    NOT_CONVERGED = 3


_CONVERGED, _TOO_FEW, _GEOMETRY, _NOT_CONVERGED = 0, 1, 2, 3  # plain integers for the kernels


class Fix(NamedTuple):
    """position (3,) m and cov (3, 3) m^2, of use only where ``status`` is CONVERGED."""

    position: Array
    cov: Array
    status: int
    iterations: int


@leaf
def _invert(A: Array, out: Array) -> bool:
    """``out`` = A^-1 of a symmetric (3, 3) matrix; False where it is not positive definite."""
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    c01 = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    c02 = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    determinant = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    minor = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    scale = A[0, 0] * A[1, 1] * A[2, 2]
    if not (A[0, 0] > 0.0 and minor > 0.0 and determinant > 1e-13 * scale):
        return False
    out[0, 0] = c00 / determinant
    out[0, 1] = out[1, 0] = c01 / determinant
    out[0, 2] = out[2, 0] = c02 / determinant
    out[1, 1] = (A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]) / determinant
    out[1, 2] = out[2, 1] = (A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]) / determinant
    out[2, 2] = minor / determinant
    return True


@leaf
def _normal_equations(rows: Array, at: Array, A: Array, b: Array) -> float:
    """A = H' P H (3, 3) and b = H' P (z - f) (3,) at the position ``at``, the clock of the times
    of arrival eliminated; returns the cost."""
    A[:] = 0.0
    b[:] = 0.0
    cost = 0.0
    clock, late, reference = 0.0, 0.0, 0.0  # times count from the first: nothing cancels
    c0, c1, c2 = 0.0, 0.0, 0.0
    for i in range(rows.shape[0]):
        value, g0, g1, g2 = value_at(rows[i], at[0], at[1], at[2])
        residual = rows[i, VALUE] - value
        if is_angle(rows[i]):
            residual = wrap(residual)
        if has_clock(rows[i]):
            reference = residual if clock == 0.0 else reference
            residual -= reference
        weight = 1.0 / rows[i, VARIANCE]
        g = (g0, g1, g2)
        cost += weight * residual * residual
        for r in range(3):
            b[r] += weight * residual * g[r]
            for c in range(3):
                A[r, c] += weight * g[r] * g[c]
        if has_clock(rows[i]):
            clock += weight
            late += weight * residual
            c0, c1, c2 = c0 + weight * g0, c1 + weight * g1, c2 + weight * g2
    if clock > 0.0:
        u = (c0, c1, c2)
        cost -= late * late / clock
        for r in range(3):
            b[r] -= u[r] * late / clock
            for c in range(3):
                A[r, c] -= u[r] * u[c] / clock
    return cost


@kernel
def fix_position(rows: Array, start: Array) -> Fix:
    """Fix of ``rows`` (m, ROW_WIDTH) from ``start`` (3,) m. Says so where there is none; never
    raises."""
    at = start.copy()
    A, b, cov = np.empty((3, 3)), np.empty(3), np.zeros((3, 3))
    unknowns = 3
    for i in range(rows.shape[0]):
        if has_clock(rows[i]):
            unknowns = 4
    if rows.shape[0] < unknowns:
        return Fix(at, cov, _TOO_FEW, 0)
    cost = _normal_equations(rows, at, A, b)
    for iteration in range(1, MAX_ITERATIONS + 1):
        if not _invert(A, cov):
            return Fix(at, cov, _GEOMETRY, iteration)
        step = np.zeros(3)
        for r in range(3):
            for c in range(3):
                step[r] += cov[r, c] * b[c]
        length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        if length < STEP_M:
            open_m = math.sqrt(max(cov[0, 0], cov[1, 1], cov[2, 2]))
            return Fix(at, cov, _CONVERGED if open_m < SD_MAX_M else _GEOMETRY, iteration)
        share = min(1.0, _LONGEST_STEP_M / length)
        before = cost
        for _ in range(_HALVINGS):
            trial = at + share * step
            cost = _normal_equations(rows, trial, A, b)
            if cost <= before:
                break
            share *= 0.5
        at = trial
    return Fix(at, cov, _NOT_CONVERGED, MAX_ITERATIONS)


@kernel
def start_of(rows: Array, height_m: float) -> Array:
    """Where to start a fix (3,): along angles and range of the nearest station that has both, else
    between the stations at the height ``height_m``."""
    start = np.zeros(3)
    nearest, count = math.inf, 0
    for i in range(rows.shape[0]):
        if is_range(rows[i]):
            start[:2] += rows[i, ORIGIN : ORIGIN + 2]
            count += 1
    start /= max(count, 1)
    start[2] = height_m
    for i in range(2, rows.shape[0]):
        angles = (
            int(rows[i - 2, KIND]) == Kind.AZIMUTH and int(rows[i - 1, KIND]) == Kind.ELEVATION
        )
        same = (
            rows[i, ORIGIN] == rows[i - 2, ORIGIN]
            and rows[i, ORIGIN + 1] == rows[i - 2, ORIGIN + 1]
        )
        ranged = is_range(rows[i]) and not has_clock(rows[i])
        if not (angles and same and ranged and rows[i, VALUE] < nearest):
            continue
        nearest = rows[i, VALUE]
        azimuth, elevation = rows[i - 2, VALUE], rows[i - 1, VALUE]
        level = nearest * math.cos(elevation)
        u = (level * math.cos(azimuth), level * math.sin(azimuth), nearest * math.sin(elevation))
        for c in range(3):
            start[c] = rows[i, ORIGIN + c]
            for r in range(3):
                start[c] += rows[i, AXES + 3 * r + c] * u[r]
    return start
