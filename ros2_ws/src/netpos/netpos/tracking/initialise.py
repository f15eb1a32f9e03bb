"""The first fix: the most probable state behind the first measurements, with the covariance it
deserves.

A maximum a posteriori fit of [x, y, vx, vy, clock, drift], and of the height where it is unknown,
at the newest stamp to all measurements of a short window: Gauss-Newton from several starts, under
a prior as wide as the coverage of the RSUs, the initial speed and the clock allow. It takes any
mixture of angles, times, ranges and fixes, and it waits while the measurements leave the position
open.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from netpos.common.least_squares import minimise
from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.fit import map_cost
from netpos.estimation.fusion import workspace
from netpos.estimation.iteration import iterate_from
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    BLOCKED,
    COMMON,
    GROUP,
    HEADING,
    HEIGHT,
    KIND,
    LEVER,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
    wrap,
)
from netpos.estimation.mixture.gaussians import Mixture, mode_of
from netpos.estimation.mixture.reduction import reduced
from netpos.estimation.mixture.ridge import Fit, components_of, inverse
from netpos.estimation.mixture.ring import RING_MERGE_COST
from netpos.estimation.mixture.window import Window, normal_equations
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.sensors.table import BY_KIND
from netpos.estimation.state import N_CORE
from netpos.messages.values import Array
from netpos.tracking import wrong_rsu
from netpos.tracking.config import TrackerConfig
from netpos.tracking.models import carries_modes
from netpos.tracking.rsus import Rsu

_REFINED = 12
_ATTEMPT_NS = 100_000_000
# Odds of another heading this much worse in cost (chi-square 0.99, 2 dof) rule it out; places that
# cannot be told apart are waited for from the same share on, and carried along below it.
_RIVAL_COST, _RIVAL_SHARE = 9.21, 0.01
_ANY_CLOCK_S = 1.0
_CONTRADICTS = 9.0  # mean squared residual over variance
_NEAREST_M = 1.0
_HEADINGS = 16
_HEADING_SD_MAX = 0.5
# Columns behind those of a row: what ``Initialiser.add`` is told of its slow errors.
_BIAS_VAR, _SHARED_VAR, _LASTS, _COMMON_STATE = range(ROW_WIDTH, ROW_WIDTH + 4)
_RAY_M = (2.0, 6.0, 15.0, 40.0, 100.0)
_RAYS_REACH_M = 150.0  # where devices are farther from the RSUs, the rays are longer
_CIRCLE = tuple(2.0 * math.pi * i / 12 for i in range(12))


class Problem(NamedTuple):
    """What ``normal_equations`` takes after the state."""

    window: Window
    prior: Array
    prior_var: Array


class _Solution(NamedTuple):
    """A problem and its minima, best first. log_odds: of what it takes for granted, and the log
    density of the states that it has more than others, where these are 0."""

    problem: Problem
    fits: list[Fit]
    log_odds: float = 0.0

    def mixture(self, misfit: float, n: int, is_possible: Callable[[Array], bool]) -> Mixture:
        """The posterior of the first ``n`` states; a ``misfit`` above 1 enlarges all variances."""

        def equations(state: Array) -> tuple[float, Array, Array]:
            cost, b, A = normal_equations(state, *self.problem)
            return cost / misfit, b / misfit, A / misfit

        fits = [(cost / misfit, mean, cov * misfit) for cost, mean, cov in self.fits]
        means, covs, log_weights = components_of(equations, fits, is_possible)
        return Mixture(means[:, :n], covs[:, :n, :n], log_weights + self.log_odds)


def joined(mixtures: Sequence[Mixture]) -> Mixture:
    """Several mixtures as one, normalised; what is alike is merged."""
    every = Mixture(*(np.concatenate(parts) for parts in zip(*mixtures, strict=True)))
    reduced_: Mixture = reduced(every, RING_MERGE_COST)
    return reduced_


def has_modes(mixture: Mixture, share: float) -> bool:
    """Whether more than one mode carries more than ``share``."""
    sums = np.bincount(mode_of(mixture), np.exp(mixture.log_weights))
    return bool((sums > share).sum() > 1)


def _solve(state: Array, problem: Problem) -> Fit:
    """Levenberg-Marquardt from one start: cost, state, covariance of the fit."""
    cost, state, A = minimise(
        lambda x: normal_equations(x, *problem), state, lambda A, b: inverse(A) @ b
    )
    return cost, state, inverse(A)


class Initialiser:
    """Collects rows until they determine a position."""

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._window: deque[tuple[int, Array, tuple[Rsu, ...]]] = deque()
        self._next_attempt_ns = 0
        self.missing = ""
        """What a first fix lacks, for people; empty before the first attempt."""

    @property
    def _states(self) -> int:
        """Number of states of a first fix."""
        return N_CORE + (self._config.device_height_sd_m > 0.0)

    def copy(self) -> Initialiser:
        """An independent copy."""
        twin = Initialiser(self._config)
        twin._window = self._window.copy()
        twin._next_attempt_ns = self._next_attempt_ns
        twin.missing = self.missing
        return twin

    def add(
        self,
        stamp_ns: int,
        rows: Array,
        bias_var: Array,
        rsus: tuple[Rsu, ...],
        shared: Array | None = None,
    ) -> None:
        """Take the rows (m, ROW_WIDTH) of one epoch; ``bias_var`` (m,) is the variance of the
        biases in each. ``shared`` (m, 2): variance of the error that each row has in common with
        all of its COMMON state, and 1 where it is the same at the next epoch; None: of none."""
        if shared is None:
            shared = np.zeros((len(rows), 2))
        slow = np.column_stack([bias_var, shared, rows[:, COMMON]])
        rows = rows.copy()
        rows[:, BIAS] = rows[:, COMMON] = rows[:, HEADING] = -1
        rows[rows[:, HEIGHT] > 0, HEIGHT] = N_CORE
        self._window.append((stamp_ns, np.column_stack([rows, slow]), rsus))
        oldest = stamp_ns - int(self._config.initial_window_s * 1e9)
        while self._window[0][0] < oldest:
            self._window.popleft()

    def solve(self) -> Mixture | None:
        """State (6,) at the newest stamp, the height of the device over its mean as the seventh
        where it is unknown, as a mixture: a place that is a thin arc is a row of components, and
        places that cannot be told apart are modes. None while the position is open, or for most
        of the window while there are several modes.

        Of three or more RSUs one may err grossly: what the others say is a part of the posterior.
        Where the measurements contradict each other and leaving out one RSU makes them agree, the
        fix is that of the others. Otherwise another clock offset may make them agree: the declared
        one is that of a device just switched on.
        """
        newest = self._window[-1][0]
        if newest < self._next_attempt_ns:
            return None
        self._next_attempt_ns = newest + _ATTEMPT_NS
        rows, ages = self._stacked()
        agreed = self._solution(rows, ages)
        if not agreed.fits:
            self.missing = f"no place in front of the RSUs fits {self._heard(rows)}"
            return None
        solutions, agrees = [agreed], self._consistent(agreed.fits[0], len(rows))
        if not agrees:
            solutions = self._without_one(rows, ages) or self._any_clock(rows, ages) or solutions
        cost, _, cov = solutions[0].fits[0]
        misfit = max(1.0, cost / len(rows))
        lacks = self._lacks(rows, cov, misfit)
        if lacks:
            self.missing = lacks
            return None
        if agrees and self._config.isolate_rsus:
            solutions += self._one_errs(rows, agreed.problem)
        n = self._states
        mixture = joined([s.mixture(misfit, n, self._plausible) for s in solutions])
        waited_s = (newest - self._window[0][0]) * 1e-9
        waits = waited_s < 0.8 * self._config.initial_window_s or not carries_modes(self._config)
        if waits and has_modes(mixture, _RIVAL_SHARE):
            self.missing = f"more than one place fits {self._heard(rows)}; waiting for more"
            return None
        return mixture

    def _lacks(self, rows: Array, cov: Array, misfit: float) -> str:
        """What a fit of the covariance ``cov`` lacks, for people; empty where it lacks nothing."""
        sd_m = math.sqrt(float(np.linalg.eigvalsh(cov[:2, :2])[-1]))
        limit_m = self._config.initial_position_sd_max_m
        if sd_m > limit_m and misfit < _CONTRADICTS:
            return (
                f"{self._heard(rows)} leave a position sd of {sd_m:.1f} m "
                f"(initial_position_sd_max_m: {limit_m:g}); another RSU or quantity is needed"
            )
        if sd_m * math.sqrt(misfit) > limit_m:
            return (
                f"{self._heard(rows)} contradict each other by {math.sqrt(misfit):.3g} sd; are"
                " they in m, rad and s, and the RSUs where RsuInfo says?"
            )
        return ""

    def excess_cost(self, stamp_ns: int, mean: Array, var: Array) -> float:
        """How much worse the window fits where the device is at ``mean`` (6,), with variances
        ``var`` (6,), at ``stamp_ns`` than where it fits best: chi-square with 2 degrees of freedom
        for the true position. 0 without measurements of the time."""
        age_s = (stamp_ns - self._window[-1][0]) * 1e-9 if self._window else math.inf
        if age_s > self._config.initial_window_s:
            return 0.0
        rows, ages = self._stacked()
        problem = self._problem(rows, ages)
        fits = self._fits(rows, problem)
        if not fits:
            return 0.0
        var = var.copy()
        var[:2] += age_s**2 * var[2:4]
        var = np.append(var, problem.prior_var[len(var) :])
        start = mean = np.append(mean, problem.prior[len(mean) :])
        start = start.copy()
        start[4] = _clock_at(start, rows, self._config.device_height_m)
        cost = _solve(start, problem._replace(prior=mean, prior_var=var))[0]
        return max(0.0, cost - fits[0][0])

    def _stacked(self) -> tuple[Array, Array]:
        """The rows of the window, and their ages [s], <= 0, against the newest."""
        newest = self._window[-1][0]
        rows = np.vstack([entry[1] for entry in self._window])
        ages = [np.full(len(entry[1]), (entry[0] - newest) * 1e-9) for entry in self._window]
        return rows, np.concatenate(ages)

    def _heard(self, rows: Array) -> str:
        """What was measured, by whom."""
        kinds = sorted({BY_KIND[int(kind)].name for kind in rows[:, KIND]})
        rsus = sorted({rsu.info.rsu_id for entry in self._window for rsu in entry[2]})
        return f"{', '.join(kinds)} of {', '.join(rsus) or 'no RSU'}"

    def _consistent(self, fit: Fit, rows: int) -> bool:
        """Whether the cost of a fit is one that true measurements have."""
        return bool(fit[0] <= chi_square_bound(rows, 1.0 - self._config.gate_probability))

    def _solution(self, rows: Array, ages: Array) -> _Solution:
        problem = self._problem(rows, ages)
        return _Solution(problem, self._fits(rows, problem))

    def _without_one(self, rows: Array, ages: Array) -> list[_Solution]:
        """Solutions with a consistent fit without one of the RSUs, best first; none of fewer than
        three RSUs."""
        placed = wrong_rsu.placed(rows)
        origins = np.unique(rows[placed, ORIGIN:AXES], axis=0)
        if len(origins) < wrong_rsu.FEWEST:
            return []
        solutions = []
        for origin in origins:
            keep = ~placed | (rows[:, ORIGIN:AXES] != origin).any(axis=1)
            others = self._solution(rows[keep], ages[keep])
            fits = [fit for fit in others.fits if self._consistent(fit, int(keep.sum()))]
            if fits:
                solutions.append(others._replace(fits=fits))
        return sorted(solutions, key=lambda solution: solution.fits[0][0])

    def _any_clock(self, rows: Array, ages: Array) -> list[_Solution]:
        """The solution with a consistent fit whatever the clock offset is, if there is one."""
        if not any(BY_KIND[int(kind)].has_clock for kind in np.unique(rows[:, KIND])):
            return []
        problem = self._problem(rows, ages)
        problem.prior_var[4] = (SPEED_OF_LIGHT_MPS * _ANY_CLOCK_S) ** 2
        fits = [fit for fit in self._fits(rows, problem) if self._consistent(fit, len(rows))]
        return [_Solution(problem, fits)] if fits else []

    def _one_errs(self, rows: Array, problem: Problem) -> list[_Solution]:
        """Solutions in which one of the RSUs errs grossly, of at least three."""
        found = []
        for case in wrong_rsu.cases(*problem):
            changed = Problem(case.window, case.prior, case.prior_var)
            found.append(_Solution(changed, self._fits(rows, changed), case.log_odds))
        return [solution for solution in found if solution.fits]

    def _problem(self, rows: Array, ages: Array) -> Problem:
        cfg = self._config
        c = SPEED_OF_LIGHT_MPS
        origins = np.array([r.info.position[:2] for e in self._window for r in e[2]])
        fixes = rows[rows[:, KIND] == Kind.LINEAR]
        centre = origins.mean(axis=0) if len(origins) else np.zeros(2)
        reach = cfg.coverage_radius_m if len(origins) or not len(fixes) else 1e6
        if len(origins):
            reach = max(reach, float(np.linalg.norm(origins - centre, axis=1).max()))
        prior = np.array([*centre, 0.0, 0.0, 0.0, c * cfg.clock_drift_mean])
        sd = np.array([reach, reach, *([cfg.initial_speed_sd_mps] * 2)])
        clock_sd = c * np.array([cfg.clock_offset_sd_s, max(cfg.clock_drift_sd, 1e-15)])
        prior_var = np.concatenate([sd, np.maximum(clock_sd, 1e-6)]) ** 2
        if cfg.device_height_sd_m > 0.0:
            prior = np.append(prior, 0.0)
            prior_var = np.append(prior_var, cfg.device_height_sd_m**2)
        shared, shared_var = _shared_errors(rows, ages)
        window = Window(ages, _bias_inflated(rows), shared, shared_var, cfg.device_height_m)
        return Problem(window, prior, prior_var)

    def _fits(self, rows: Array, problem: Problem) -> list[Fit]:
        """Solutions from the most promising starts, best first."""
        scored: list[tuple[float, int, Array]] = []
        for xy in _starts(rows, problem.prior[:2], math.sqrt(problem.prior_var[0])):
            state = problem.prior.copy()
            state[:2] = xy
            state[4] = _clock_at(state, rows, self._config.device_height_m)
            scored.append((normal_equations(state, *problem)[0], len(scored), state))
        fits = [_solve(state, problem) for _, _, state in sorted(scored)[:_REFINED]]
        fits = [fit for fit in fits if _is_sound(fit) and self._plausible(fit[1])]
        return sorted(fits, key=lambda fit: fit[0])

    def _plausible(self, state: Array) -> bool:
        """Not behind an array without a back, and not on top of an RSU that measures angles only,
        where an angle fits anything."""
        heard = {r.info.rsu_id: r for e in self._window for r in e[2]}
        ranged = {
            tuple(row[ORIGIN:AXES])
            for e in self._window
            for row in e[1]
            if BY_KIND[int(row[KIND])].is_range
        }
        for rsu in heard.values():
            dx, dy = state[:2] - rsu.info.position[:2]
            up = state[N_CORE : self._states].sum()
            dz = self._config.device_height_m + up - rsu.info.position[2]
            near = dx * dx + dy * dy + dz * dz < _NEAREST_M**2
            if not rsu.in_front(dx, dy) or (near and tuple(rsu.info.position) not in ranged):
                return False
        return True


def with_heading(
    mean: Array, cov: Array, rows: Array, height_m: float
) -> tuple[Array, Array] | None:
    """A fix mean (6,), cov (6, 6) that ignored the lever arms of ``rows`` (m, ROW_WIDTH), and the
    heading they speak for: mean (7,), cov (7, 7); None where they leave it open."""
    levers = rows[rows[:, HEADING] >= 0, LEVER:BLOCKED]
    if not levers.any():
        return None
    rows = rows.copy()
    rows[:, BIAS] = rows[:, COMMON] = -1
    rows[rows[:, HEADING] >= 0, HEADING] = 6
    rows[:, GROUP] = 0
    reach = 30.0 * float(np.hypot(levers[:, 0], levers[:, 1]).max())  # the fix tells no heading
    prior = np.zeros((7, 7))
    prior[:6, :6] = cov + reach**2 * np.diag([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    prior[6, 6] = math.pi**2
    variance, work = rows[:, VARIANCE].copy(), workspace(7, len(rows))
    candidates = []
    for k in range(_HEADINGS):
        start = np.append(mean, 2.0 * math.pi * k / _HEADINGS)
        x, P = iterate_from(start, start, prior, rows, variance, height_m, 30, work)
        candidates.append((map_cost(x, P, rows, variance, height_m, x), k, x, P))
    candidates.sort(key=lambda c: c[:2])
    cost, _, x, P = candidates[0]
    far = 5.0 * math.sqrt(P[6, 6])
    if P[6, 6] > _HEADING_SD_MAX**2 or any(
        c[0] < cost + _RIVAL_COST and abs(wrap(c[2][6] - x[6])) > far for c in candidates
    ):
        return None
    x[6] = wrap(float(x[6]))
    return x, P


def _is_sound(fit: Fit) -> bool:
    """Whether the fit is finite and its position covariance survived rounding."""
    cost, _, cov = fit
    return bool(math.isfinite(cost) and np.linalg.eigvalsh(cov[:2, :2])[0] > 0.0)


def _bias_inflated(rows: Array) -> Array:
    """Rows with a variance under which averaging many biased values never beats the bias.

    A bias shared by k rows of the same sensor counts k times in each, so that their mean keeps the
    bias' variance.
    """
    rows, bias_var = rows[:, :ROW_WIDTH].copy(), rows[:, _BIAS_VAR]
    sensors, sensor = np.unique(rows[:, [KIND, *range(ORIGIN, AXES)]], axis=0, return_inverse=True)
    count = np.bincount(sensor.reshape(-1), minlength=len(sensors))
    rows[:, VARIANCE] += count[sensor.reshape(-1)] * bias_var
    return rows


def _shared_errors(rows: Array, ages_s: Array) -> tuple[Array, Array]:
    """``Window.shared`` and ``Window.shared_var`` of rows with their slow errors."""
    shared = np.full(len(rows), -1)
    has = rows[:, _SHARED_VAR] > 0.0
    if not has.any():
        return shared, np.zeros(0)
    since_s = np.where(rows[has, _LASTS] > 0.0, 1.0, ages_s[has])  # of an age of its own, or all
    names = np.column_stack([rows[has, _COMMON_STATE], since_s])
    _, first, shared[has] = np.unique(names, axis=0, return_index=True, return_inverse=True)
    return shared, rows[has, _SHARED_VAR][first]


def _starts(rows: Array, centre: Array, reach_m: float) -> list[Array]:
    """Positions to start from: along measured bearings, around measured ranges, the centre of the
    RSUs, from which a device is about ``reach_m`` away."""
    starts, rays_m = [centre], [r * max(1.0, reach_m / _RAYS_REACH_M) for r in _RAY_M]
    seen = set()
    for row in rows:
        kind = Kind(int(row[KIND]))
        key = (kind, *row[ORIGIN:AXES])
        if key in seen or kind is Kind.SPEED:
            continue
        seen.add(key)
        origin = row[ORIGIN : ORIGIN + 2]
        if kind in (Kind.AZIMUTH, Kind.COSINE_Y):
            A = row[AXES : AXES + 9].reshape(3, 3)
            angle = row[VALUE] if kind is Kind.AZIMUTH else math.asin(np.clip(row[VALUE], -1, 1))
            ray = A.T @ np.array([math.cos(angle), math.sin(angle), 0.0])
            starts += [origin + r * ray[:2] for r in rays_m]
        elif kind is Kind.TDOA:
            starts += _on_hyperbola(row, rays_m[-1])
        elif BY_KIND[kind].is_range and not BY_KIND[kind].has_clock:
            starts += [origin + row[VALUE] * np.array([math.cos(a), math.sin(a)]) for a in _CIRCLE]
        elif BY_KIND[kind].is_range:
            starts += [origin + 30.0 * np.array([math.cos(a), math.sin(a)]) for a in _CIRCLE[::3]]
    fix = rows[rows[:, KIND] == Kind.LINEAR]
    if len(fix) >= 2:
        H = fix[:, ORIGIN : ORIGIN + 2]
        starts.append(np.linalg.lstsq(H, fix[:, VALUE], rcond=None)[0])
    return starts


def _on_hyperbola(row: Array, farthest_m: float) -> list[Array]:
    """Horizontal positions, nearer than ``farthest_m`` to the RSU, from which a time difference of
    arrival would read as it does: in polar coordinates around the RSU, in the direction e,
    r = (D^2 - v^2) / (2 (e b - v)), with the reference at b, D away, and the value v."""
    between, value = row[AXES : AXES + 2], float(row[VALUE])
    excess = float(between @ between) - value * value
    found = []
    for angle in _CIRCLE:
        direction = np.array([math.cos(angle), math.sin(angle)])
        slope = 2.0 * (float(direction @ between) - value)
        if abs(slope) > 1e-9 and 0.0 < excess / slope < farthest_m:
            found.append(row[ORIGIN : ORIGIN + 2] + excess / slope * direction)
    return found


def _clock_at(state: Array, rows: Array, height_m: float) -> float:
    """Clock offset [m] that fits the TOA rows best at the position of ``state``."""
    toa = rows[rows[:, KIND] == Kind.TOA]
    if not len(toa):
        return 0.0
    d = np.column_stack([state[0] - toa[:, ORIGIN], state[1] - toa[:, ORIGIN + 1]])
    distance = np.hypot(np.hypot(d[:, 0], d[:, 1]), height_m - toa[:, ORIGIN + 2])
    return float(np.average(toa[:, VALUE] - distance, weights=1.0 / toa[:, VARIANCE]))
