"""Cost of a state against all measurements of a window, in parts of which the accelerations of the
device and of its clock are constant. Each measurement may be an outlier."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.common.least_squares import minimiser
from netpos.estimation.compile import kernel, leaf, linked_kernel
from netpos.estimation.factor import solve
from netpos.estimation.measurement import VALUE, VARIANCE, is_cyclic, predict_row, wrap
from netpos.estimation.mixture.outliers import tail_log
from netpos.estimation.mixture.ridge import Line
from netpos.estimation.sensors.row import group_end
from netpos.estimation.state import X
from netpos.messages.values import Array

Indices = npt.NDArray[np.int64]

_PEAK_LOG = -0.5 * math.log(2.0 * math.pi)  # of a Gaussian of variance 1
_NO_LINE = Line(np.zeros(2), np.zeros(2), math.inf)
_MOVES = ((int(X.PX), int(X.VX)), (int(X.PY), int(X.VY)), (int(X.CLOCK), int(X.DRIFT)))


class Window(NamedTuple):
    """Measurements of a short time.

    ages_s (m,) : when each was made, <= 0 before the stamp of the state
    rows (m, ROW_WIDTH) : groups are numbered through; the slow errors in them are states behind
        those of the device
    height_m : nominal height of the device
    first, part_s : index of the accelerations [m/s^2] of the device, two, and of its clock, in
        ``parts`` of so many seconds each, the newest first
    outliers (m,) : probability that a row belongs to a measurement that is one
    """

    ages_s: Array
    rows: Array
    height_m: float
    first: int
    part_s: float
    parts: int
    outliers: Array


class Problem(NamedTuple):
    """The fit of a state (n,) to a window of measurements, and to what is known beforehand: its
    ``prior`` (n,), with the variances ``prior_var`` (n,)."""

    window: Window
    prior: Array
    prior_var: Array

    def equations(self, state: Array) -> tuple[float, Array, Array]:
        """``normal_equations`` at ``state`` (n,)."""
        found: tuple[float, Array, Array] = normal_equations(state, self)
        return found

    def minimum(self, start: Array, line: Line | None = None) -> tuple[float, Array, Array]:
        """Cost, state and normal matrix (n, n) of the minimum to which ``start`` (n,) leads, with
        those of a ``line``, where there is one."""
        found: tuple[float, Array, Array] = _minimum(start, self, line or _NO_LINE)
        return found

    def without_outliers(self) -> Problem:
        """As it is if no measurement is an outlier."""
        window = self.window._replace(outliers=np.zeros_like(self.window.outliers))
        return self._replace(window=window)

    def scaled(self, factor: float) -> Problem:
        """With variances of the measurements that are ``factor`` times as large."""
        rows = self.window.rows.copy()
        rows[:, VARIANCE] *= factor
        return self._replace(window=self.window._replace(rows=rows))


@leaf
def _moved(age_s: float, part: int, part_s: float) -> tuple[float, float]:
    """By how many seconds an acceleration of one ``part`` changes the speed at ``age_s`` <= 0, and
    by how many s^2 the place."""
    since = -age_s - part * part_s
    lasts = min(since, part_s)
    if lasts <= 0.0:
        return 0.0, 0.0
    return -lasts, lasts * (since - 0.5 * lasts)


@kernel
def normal_equations(state: Array, problem: Problem) -> tuple[float, Array, Array]:
    """Cost, gradient (n,) and Gauss-Newton Hessian (n, n) of the fit at ``state`` (n,).

    A measurement costs -2 ln of its density over that of a Gaussian at its peak: d with a squared
    distance d that is small, and hardly more with any that is large, where it is an outlier. The
    Hessian has it as far as it is none.
    """
    window, prior, prior_var = problem
    rows, n, m = window.rows, state.size, window.rows.shape[0]
    A = np.diag(1.0 / prior_var)
    difference = prior - state
    b = difference / prior_var
    cost = float((difference * b).sum())
    residual, H = _linearised(state, window)
    named = np.empty(n, np.int64)
    start = 0
    while start < m:
        stop = group_end(rows, start)
        variance = rows[start:stop, VARIANCE]
        share = window.outliers[start]
        density_log, sound = _density_log(share, residual[start:stop], variance)
        cost -= 2.0 * density_log
        for i in range(start, stop):
            h, w = H[i], sound / variance[i - start]
            slope = w * residual[i]
            if residual[i] ** 2 > variance[i - start]:
                slope += (1.0 - sound) / residual[i]
            _add_row(h, slope, w, named, b, A)
        start = stop
    for a in range(n):
        for c in range(a):
            A[c, a] = A[a, c]
    return cost, b, A


@kernel
def _on_line(state: Array, given: tuple[Problem, Line]) -> tuple[float, Array, Array]:
    """``normal_equations`` with those of a Gaussian along a line."""
    problem, line = given
    cost, b, A = normal_equations(state, problem)
    u, weight = line.direction, 1.0 / line.sd**2
    off = u[0] * (line.centre[0] - state[0]) + u[1] * (line.centre[1] - state[1])
    for i in range(2):
        b[i] += weight * off * u[i]
        for j in range(2):
            A[i, j] += weight * u[i] * u[j]
    return cost + weight * off * off, b, A


_minimise = linked_kernel(minimiser(_on_line, solve))


@kernel
def _minimum(start: Array, problem: Problem, line: Line) -> tuple[float, Array, Array]:
    found: tuple[float, Array, Array] = _minimise(start, (problem, line))
    return found


@leaf
def _add_row(h: Array, slope: float, weight: float, named: Indices, b: Array, A: Array) -> None:
    """What a row with the derivatives ``h`` (n,) adds to the gradient and to the lower triangle
    of the Hessian. Few are not 0: it names one or two of the slow errors. ``named`` (n,) is
    memory."""
    count = 0
    for a in range(h.size):
        if h[a] != 0.0:
            named[count] = a
            count += 1
    for j in range(count):
        a = named[j]
        b[a] += slope * h[a]
        for k in range(j + 1):
            A[a, named[k]] += weight * h[a] * h[named[k]]


@kernel
def outliers_of(state: Array, window: Window) -> tuple[float, float]:
    """How many measurements are outliers at ``state`` (n,), and what they cost."""
    rows, (residual, _) = window.rows, _linearised(state, window)
    count, cost, start = 0.0, 0.0, 0
    while start < residual.size:
        stop = group_end(rows, start)
        variance = rows[start:stop, VARIANCE]
        share = window.outliers[start]
        density_log, sound = _density_log(share, residual[start:stop], variance)
        count += 1.0 - sound
        cost -= 2.0 * (1.0 - sound) * density_log
        start = stop
    return count, cost


@kernel
def typical_scale(state: Array, window: Window) -> float:
    """By how much variances would have to be larger, at least 1, for half of the rows to be within
    one standard deviation at ``state`` (n,)."""
    residual, _ = _linearised(state, window)
    return max(1.0, float(np.median(residual**2 / window.rows[:, VARIANCE])))


@kernel
def _linearised(state: Array, window: Window) -> tuple[Array, Array]:
    """Residuals (m,) at ``state`` (n,) and derivatives (m, n) of what is predicted."""
    rows, m = window.rows, window.rows.shape[0]
    residual, H, past = np.empty(m), np.zeros((m, state.size)), state.copy()
    for i in range(m):
        h, age = H[i], window.ages_s[i]
        past[:] = state
        for place, rate in _MOVES:
            past[place] += state[rate] * age
        for part in range(window.parts):
            faster, farther = _moved(age, part, window.part_s)
            for k in range(3):
                (place, rate), at = _MOVES[k], window.first + 3 * part + k
                past[place] += farther * state[at]
                past[rate] += faster * state[at]
        residual[i] = rows[i, VALUE] - predict_row(rows[i], past, window.height_m, h)
        if is_cyclic(rows[i]):
            residual[i] = wrap(residual[i])
        for part in range(window.parts):
            faster, farther = _moved(age, part, window.part_s)
            for k in range(3):
                (place, rate), at = _MOVES[k], window.first + 3 * part + k
                h[at] += farther * h[place] + faster * h[rate]
        for place, rate in _MOVES:
            h[rate] += age * h[place]
    return residual, H


@leaf
def _density_log(share: float, residual: Array, variance: Array) -> tuple[float, float]:
    """Log density of one measurement with a ``residual`` (m,) and its ``variance`` (m,), over that
    of a Gaussian at its peak, and the probability that it is no outlier; a ``share`` of those like
    it are."""
    sound = 0.0
    for i in range(residual.size):
        sound -= 0.5 * residual[i] ** 2 / variance[i]
    if share <= 0.0:
        return sound, 1.0
    outlier = math.log(share)
    for i in range(residual.size):
        outlier += tail_log(residual[i] ** 2 / variance[i], 1.0) - _PEAK_LOG
    if outlier < sound:
        odds = math.exp(outlier - sound)
        return sound + math.log1p(odds), 1.0 / (1.0 + odds)
    odds = math.exp(sound - outlier)
    return outlier + math.log1p(odds), odds / (1.0 + odds)
