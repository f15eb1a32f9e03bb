"""Where a range and a phase difference of one anchor put a device, sector by sector."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.factor import factor
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    HEIGHT,
    KIND,
    LEVER,
    ORIGIN,
    VALUE,
    VARIANCE,
    Kind,
    predict_row,
)
from netpos.estimation.state import N_CORE, X
from netpos.messages.values import Array

TWO_PI = 2.0 * math.pi
_LINEAR = float(Kind.LINEAR)
_EDGE_SDS = 3.0  # a phase may lie this far beyond end-fire


@leaf
def phase_scale(phase: Array) -> float:
    """2 pi L / lambda of a phase row: the largest unwrapped phase."""
    x, y, z = phase[AXES], phase[AXES + 1], phase[AXES + 2]
    return math.sqrt(x * x + y * y + z * z)


@leaf
def admissible(phase: Array, turns: int) -> bool:
    """Whether a phase row may have so many turns: in front of the array, or beyond by its
    noise."""
    edge = phase_scale(phase) + _EDGE_SDS * math.sqrt(phase[GATE_VARIANCE])
    return bool(abs(phase[VALUE] + TWO_PI * turns) <= edge)


@leaf
def nearest_turns(phase: Array, excess: float) -> int:
    """Admissible number of turns nearest to what would make up for ``excess``, predicted minus
    measured; none is always admissible."""
    turns = round(excess / TWO_PI)
    toward = -1 if turns > 0 else 1
    while turns != 0 and not admissible(phase, turns):
        turns += toward
    return turns


@kernel
def place(
    ranged: Array, phase: Array, turns: int, height_m: float, point: Array, cov: Array
) -> bool:
    """Position (2,) and covariance (2, 2) behind a range row and a phase row of one level array
    with ``turns``; False where there is none.

    With s = unwrapped phase / scale, h = L/2, |d| from the middle of the array follows from the
    range R to the master by |d| = s h + sqrt(s^2 h^2 + R^2 - h^2); x = s |d|; y is in front.
    petukhov:eq.14, 15 do the same without the plane wave of eq. 5.
    """
    scale = phase_scale(phase)
    if not admissible(phase, turns):
        return False
    ux, uy = phase[AXES] / scale, phase[AXES + 1] / scale
    sd = math.sqrt(phase[VARIANCE]) / scale
    most = math.sqrt(max(1.0 - 2.0 * sd, 0.0))  # nearer to end-fire the noise hides the angle
    s = min(max((phase[VALUE] + TWO_PI * turns) / scale, -most), most)
    half = (ranged[ORIGIN] - phase[ORIGIN]) * ux + (ranged[ORIGIN + 1] - phase[ORIGIN + 1]) * uy
    r = ranged[VALUE]
    if r <= abs(half):
        return False
    d = s * half + math.sqrt(s * s * half * half + r * r - half * half)
    dz = height_m + phase[LEVER + 2] - phase[ORIGIN + 2]
    y2 = d * d * (1.0 - s * s) - dz * dz
    if y2 <= 0.0:
        return False
    x, y = s * d, math.sqrt(y2)
    point[0] = phase[ORIGIN] + x * ux - y * uy
    point[1] = phase[ORIGIN + 1] + x * uy + y * ux
    state, by_range, by_phase = np.zeros(N_CORE), np.zeros(N_CORE), np.zeros(N_CORE)
    state[X.PX], state[X.PY] = point[0], point[1]
    _level_gradient(ranged, state, height_m, by_range)
    _level_gradient(phase, state, height_m, by_phase)
    det = by_range[X.PX] * by_phase[X.PY] - by_range[X.PY] * by_phase[X.PX]
    if det == 0.0:
        return False
    for i in range(2):
        sign = 1.0 if i == 0 else -1.0
        a, b = sign * by_phase[1 - i] / det, -sign * by_range[1 - i] / det
        by_range[2 + i], by_phase[2 + i] = a, b
    for i in range(2):
        for j in range(2):
            cov[i, j] = by_range[2 + i] * by_range[2 + j] * ranged[VARIANCE]
            cov[i, j] += by_phase[2 + i] * by_phase[2 + j] * phase[VARIANCE]
    return True


@kernel
def _level_gradient(row: Array, state: Array, height_m: float, h: Array) -> None:
    """Gradient of a row by the position, whatever biases and levers it has."""
    plain = row.copy()
    plain[BIAS] = plain[COMMON] = plain[HEADING] = -1.0
    plain[HEIGHT] = 0.0
    predict_row(plain, state, height_m, h)


@leaf
def _by_height(phase: Array, point: Array, height_m: float) -> tuple[float, float]:
    """Derivative of ``place`` by the height of the device, at ``point`` (2,): it moves along the
    boresight."""
    scale = phase_scale(phase)
    ux, uy = phase[AXES] / scale, phase[AXES + 1] / scale
    dz = height_m + phase[LEVER + 2] - phase[ORIGIN + 2]
    ahead = (point[1] - phase[ORIGIN + 1]) * ux - (point[0] - phase[ORIGIN]) * uy
    slope = dz / max(ahead, 1e-3)
    return slope * uy, -slope * ux


@leaf
def _height_over(phase: Array, mean: Array) -> float:
    """What the state mean (n,) says of the height over the nominal one; 0 where it is known."""
    height = int(phase[HEIGHT])
    return float(mean[height]) if height > 0 else 0.0


@kernel
def init_hypothesis(
    mean: Array,
    cov: Array,
    ranged: Array,
    phase: Array,
    turns: int,
    speed_sd: float,
    height_m: float,
) -> float:
    """Put a device whose other states are those of mean (n,), cov (n, n) where range and phase
    with ``turns`` say, in place, with an open velocity. An unknown height stays as it is.

    Returns the log of the area the fix leaves, its weight if the device may be anywhere; -inf,
    and nothing changed, where there is no such place.
    """
    point, square, height = np.empty(2), np.empty((2, 2)), int(phase[HEIGHT])
    above_m = height_m + _height_over(phase, mean)
    if not place(ranged, phase, turns, above_m, point, square):
        return -math.inf
    for i in range(X.CLOCK):  # position and velocity
        for j in range(mean.size):
            cov[i, j] = cov[j, i] = 0.0
    for i in range(2):
        v = X.VX + i
        mean[i], mean[v] = point[i], 0.0
        cov[v, v] = speed_sd * speed_sd
        for j in range(2):
            cov[i, j] = square[i, j]
    if height > 0:
        by_height, var = _by_height(phase, point, above_m), cov[height, height]
        for i in range(2):
            cov[i, height] = cov[height, i] = by_height[i] * var
            for j in range(2):
                cov[i, j] += by_height[i] * by_height[j] * var
    return 0.5 * math.log(cov[0, 0] * cov[1, 1] - cov[0, 1] * cov[1, 0])


@kernel
def to_fix(own: Array, at: int, mean: Array, height_m: float) -> bool:
    """Replace range and phase, rows ``at - 1`` and ``at``, by the position they give, as two
    decorrelated LINEAR rows: a tangent would not reach round a circle. Where the height is
    unknown they hold how the position changes with it, at ``mean`` (n,). False where there is
    none."""
    point, cov, height = np.empty(2), np.empty((2, 2)), own[at, HEIGHT]
    above = _height_over(own[at], mean)
    if not place(own[at - 1], own[at], 0, height_m + above, point, cov):
        return False
    by_height = (0.0, 0.0)
    if height > 0.0:
        by_height = _by_height(own[at], point, height_m + above)
        point[0] -= by_height[0] * above
        point[1] -= by_height[1] * above
    L = factor(cov)
    value = point[0] / L[0, 0]
    h00, h10, h11 = 1.0 / L[0, 0], -L[1, 0] / (L[0, 0] * L[1, 1]), 1.0 / L[1, 1]
    for i in range(2):
        row = own[at - 1 + i]
        group = row[GROUP]
        row[:] = 0.0
        row[KIND], row[GROUP] = _LINEAR, group
        row[VARIANCE] = row[GATE_VARIANCE] = 1.0
        row[BIAS] = row[COMMON] = row[HEADING] = -1.0
        row[HEIGHT] = height
    own[at - 1, VALUE], own[at - 1, ORIGIN] = value, h00
    own[at, VALUE] = h10 * point[0] + h11 * point[1]
    own[at, ORIGIN], own[at, ORIGIN + 1] = h10, h11
    own[at - 1, ORIGIN + N_CORE] = -h00 * by_height[0]
    own[at, ORIGIN + N_CORE] = -h10 * by_height[0] - h11 * by_height[1]
    return True
