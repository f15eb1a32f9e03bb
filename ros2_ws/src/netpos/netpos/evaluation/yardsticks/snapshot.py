"""Yardstick: least squares of the measurements of the last second, without a motion model.

Minimise sum ((z - h(x)) / sd)^2 over the position, and the heading where several antennas were
measured. Rows beyond 4 sd of the solution are left out and the rest is solved again. The
covariance is (J' W J)^-1, as if all errors were white. A series of snapshots uses
the fix before as the start of the search, while it is younger than 2 s, and for nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.yardsticks.observations import NS, Kind, Observations, Stamps, residuals
from netpos.messages.values import Array

WINDOW_S = 1.0
GATE_SD = 4.0
START_AGE_S = 2.0
EVERY_S = 0.1
_STARTS = 6  # the best places of the grid, refined
_AS_GOOD = 9.0
_APART_M = 1.0
_HEADINGS = 4
_REPEATS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Space:
    """Which coordinates are unknown: x and y at a given height, or x, y and z.

    height_m : height of the device where ``dimensions`` is 2, else of the search's start
    sd_max_m : a fix with a larger sd is none
    """

    dimensions: int = 2
    height_m: float = 0.0
    sd_max_m: float = 5.0

    def __post_init__(self) -> None:
        if self.dimensions not in (2, 3):
            raise ValueError(f"dimensions must be 2 or 3, got {self.dimensions}")

    def point(self, state: Array) -> Array:
        """(3,) m of a state that begins with the unknown coordinates."""
        return np.append(state[:2], state[2] if self.dimensions == 3 else self.height_m)

    def columns(self, *, heading: bool) -> list[int]:
        """Of x, y, z, heading, those that are unknown."""
        return [*range(self.dimensions), *([3] if heading else [])]


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Solution x, y, (z), (heading) and its covariance, as if all errors were white."""

    state: Array
    cov: Array


def snapshot(seen: Observations, space: Space, start: Array | None = None) -> Fix | None:
    """Least squares of all rows as one instant; None where they do not fix the position: fewer
    rows than unknowns, a singular geometry, too large an sd, or a second solution that fits as
    well (9 more in the sum of squares, 3 sd).

    start : where the search begins; without it a grid of starts is searched, and only then a
        second solution is found
    """
    turns = seen.turns
    columns = space.columns(heading=turns)
    if len(seen) < len(columns):
        return None

    if start is None or len(start) != len(columns):
        by_cost = sorted(_grid(seen, space), key=lambda state: _cost(seen, space, state))
        starts = by_cost[:_STARTS]
    else:
        starts = [start]
    solutions = [_solve(seen, space, state) for state in starts]
    state = min(solutions, key=lambda solution: _cost(seen, space, solution))
    if _ambiguous(seen, space, state, solutions):
        return None
    for _ in range(_REPEATS):
        near = np.abs(_scaled(seen, space, state)[0]) <= GATE_SD
        if near.all() or near.sum() < len(columns):
            break
        seen = seen.take(near)
        if seen.turns != turns:  # one antenna is left, and no heading
            return None
        state = _solve(seen, space, state)
    return _fix(state, _scaled(seen, space, state)[1], space)


def _scaled(seen: Observations, space: Space, state: Array) -> tuple[Array, Array]:
    """Residuals (n,) over their sd, and the derivative of the expected values over the sd."""
    turns = len(state) > space.dimensions
    error, slope = residuals(seen, space.point(state), float(state[-1]) if turns else 0.0)
    return error / seen.sd, slope[:, space.columns(heading=turns)] / seen.sd[:, None]


def _cost(seen: Observations, space: Space, state: Array) -> float:
    return float((_scaled(seen, space, state)[0] ** 2).sum())


def _ambiguous(seen: Observations, space: Space, best: Array, solutions: list[Array]) -> bool:
    """Whether another solution, more than 1 m away, fits nearly as well as the best."""
    limit = _cost(seen, space, best) + _AS_GOOD
    apart = [s for s in solutions if np.linalg.norm((s - best)[: space.dimensions]) > _APART_M]
    return any(_cost(seen, space, solution) < limit for solution in apart)


def _solve(seen: Observations, space: Space, start: Array) -> Array:
    """Levenberg-Marquardt from ``start``."""
    solution = least_squares(
        lambda state: _scaled(seen, space, state)[0],
        start,
        jac=lambda state: -_scaled(seen, space, state)[1],
        method="lm",
        xtol=1e-7,
        ftol=1e-9,
        max_nfev=60,
    )
    return np.asarray(solution.x, dtype=np.float64)


def _fix(state: Array, J: Array, space: Space) -> Fix | None:
    information = J.T @ J
    if not np.linalg.cond(information) < 1e12:
        return None
    cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
    variances = cov.diagonal()[: space.dimensions]
    if not ((variances > 0).all() and variances.max() < space.sd_max_m**2):
        return None
    return Fix(state, cov)


def _grid(seen: Observations, space: Space) -> list[Array]:
    """Starts: the middle of the RSUs, and a ring around it as far as the measurements reach."""
    sites = np.unique(np.vstack([seen.rsu, seen.other[seen.other.any(axis=1)]]), axis=0)
    middle = sites[:, :2].mean(axis=0)
    far = seen.value[seen.kind == Kind.RANGE]
    size = float(np.linalg.norm(np.ptp(sites[:, :2], axis=0)))
    reach = max(float(np.median(far)) if far.size else 0.5 * size, 1.0)
    around = np.arange(8) * np.pi / 4
    ring = np.column_stack([np.cos(around), np.sin(around)])
    level = np.vstack([middle[None], middle + 0.4 * reach * ring, middle + reach * ring])
    heights = np.full((len(level), space.dimensions - 2), space.height_m)
    places = np.hstack([level, heights])
    if not seen.turns:
        return list(places)
    headings = np.arange(_HEADINGS) * 2.0 * np.pi / _HEADINGS
    return [np.append(position, heading) for position in places for heading in headings]


def snapshots(
    seen: Observations, space: Space, *, window_s: float = WINDOW_S, every_s: float = EVERY_S
) -> Trajectory:
    """Snapshots at stamps at least ``every_s`` apart, each of the measurements of the ``window_s``
    before it; stamps without a fix are left out."""
    stamps: list[int] = []
    fixes: list[Fix] = []
    tried_ns: int | None = None
    for stamp in np.unique(seen.stamp_ns).tolist():
        if tried_ns is not None and stamp - tried_ns < round(every_s * NS):
            continue
        tried_ns = stamp
        fresh = bool(fixes) and stamp - stamps[-1] < round(START_AGE_S * NS)
        window = seen.window(stamp - round(window_s * NS), stamp)
        fix = snapshot(window, space, fixes[-1].state if fresh else None)
        if fix is not None:
            stamps.append(stamp)
            fixes.append(fix)
    return trajectory_of(np.array(stamps, dtype=np.int64), fixes, space)


def trajectory_of(stamps: Stamps, fixes: list[Fix], space: Space) -> Trajectory:
    """Fixes as a trajectory; velocities are 0 and the variance of a given height is 0."""
    n, d = len(fixes), space.dimensions
    cov = np.zeros((n, 3, 3))
    heading = np.zeros(n)
    for i, fix in enumerate(fixes):
        cov[i, :d, :d] = fix.cov[:d, :d]
        heading[i] = fix.state[d] if len(fix.state) > d else 0.0
    return Trajectory(
        stamp_ns=stamps,
        position=np.array([space.point(f.state) for f in fixes]).reshape(n, 3),
        velocity=np.zeros((n, 3)),
        heading=heading,
        position_cov=cov,
    )
