"""The first fix: the most probable state behind the first measurements, with the covariance it
deserves.

A maximum a posteriori fit of [x, y, vx, vy, clock, drift], and of the slow errors in the
measurements (the height too, where it is unknown), at the newest stamp to all measurements of a
short window: Gauss-Newton from several starts, under a prior as wide as the coverage of the RSUs,
the initial speed and the clock allow; in parts of the window device and clock accelerate as
the process noise says. It takes any mixture of angles, times, ranges and fixes, and it waits while
the measurements leave the position open. The track goes on with the slow errors as
the fit found them: what they have in common with the position is not heard twice.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from netpos.common.least_squares import minimise
from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.densities import Density, held
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
    REFERENCE,
    VALUE,
    VARIANCE,
    Kind,
    wrap,
)
from netpos.estimation.mixture.gaussians import Mixture, mode_of, moments
from netpos.estimation.mixture.reduction import PART_MERGE_COST, reduced
from netpos.estimation.mixture.ridge import (
    Fit,
    cholesky_solve,
    components_of,
    inverse,
    log_weight_of,
    on_line,
)
from netpos.estimation.mixture.window import Window, normal_equations
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.rows import drop_biases
from netpos.estimation.sensors.table import BY_KIND
from netpos.estimation.state import N_CORE
from netpos.estimation.update.fit import map_cost
from netpos.estimation.update.fusion import workspace
from netpos.estimation.update.iteration import iterate_from
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import carries_modes, slow_states, state_of_fit
from netpos.tracking.first_fix import wrong_rsu
from netpos.tracking.rsus.rsu import Rsu, SlowErrors

_REFINED = 12
_ATTEMPT_NS = 100_000_000
_LEAST_SPAN_S = 0.1  # of a window
_PART_S, _PARTS_MAX = 0.75, 8  # of the window, in which accelerations are constant
_RETRY_SHARE = 0.05  # the next attempt comes after so much of the time waited
# Odds of another heading this much worse in cost (chi-square 0.99, 2 dof) rule it out; places that
# cannot be told apart are waited for from the same share on, and carried along below it.
_RIVAL_COST, _RIVAL_SHARE = 9.21, 0.01
_ANY_CLOCK_S = 1.0
_CONTRADICTS = 9.0  # mean squared residual over variance
_RELAXATIONS, _FITS = 5, 1.1
_NEAREST_M = 1.0
_HEADINGS = 16
_HEADING_SD_MAX = 0.5
_LEAST_SD = 1e-9  # of a slow error
_RAY_M = (2.0, 6.0, 15.0, 40.0, 100.0)
_RAYS_REACH_M = 150.0  # where devices are farther from the RSUs, the rays are longer
_CIRCLE = tuple(2.0 * math.pi * i / 12 for i in range(12))


class Problem(NamedTuple):
    """What ``normal_equations`` takes after the state."""

    window: Window
    prior: Array
    prior_var: Array

    def equations(self, state: Array) -> tuple[float, Array, Array]:
        """``normal_equations`` at ``state`` (n,)."""
        found: tuple[float, Array, Array] = normal_equations(state, *self)
        return found


class _Solution(NamedTuple):
    """A problem, its minima and the ``constrained`` ones, at some distances from an RSU; there is
    one of either. nearer: log weight of the heaviest minimum that is nearer to an RSU than a
    device can be. log_odds: of what it takes for granted, and the log density of the states that
    it has more than others, where these are 0."""

    problem: Problem
    minima: list[Fit]
    constrained: list[Fit]
    nearer: float
    log_odds: float = 0.0

    @property
    def best(self) -> Fit:
        """The one that fits best."""
        return min((*self.minima, *self.constrained), key=lambda fit: fit[0])

    @property
    def heaviest(self) -> Fit:
        """The minimum that weighs most."""
        return max(self.minima or self.constrained, key=log_weight_of)

    @property
    def cost(self) -> float:
        """That of the best."""
        return self.best[0]

    @property
    def misfit(self) -> float:
        """Cost for each row where it is more than the 1 of true measurements, or 1."""
        return max(1.0, self.cost / len(self.problem.window.rows))

    def mixture(self, is_possible: Callable[[Array], bool]) -> Mixture | None:
        """The posterior of all states; None where more of it is impossible."""
        found = components_of(self.problem.equations, self.minima, self.constrained, is_possible)
        if found is None or np.logaddexp.reduce(found.log_weights) < self.nearer:
            return None
        return found._replace(log_weights=found.log_weights + self.log_odds)

    def relaxed(
        self, lasting: int, solution_of: Callable[[Problem], _Solution | None]
    ) -> _Solution:
        """With variances so much larger that nothing contradicts: of the measurements, and of the
        place, the velocity and the clock beforehand, each by its own misfit. Slow errors, which
        end with the first ``lasting`` states, are as certain as before; the states behind are
        errors of one epoch, a part of the measurements."""
        solution, factors = self, np.ones(1 + N_CORE)
        for _ in range(_RELAXATIONS):
            more = solution._misfits(lasting)
            if more.max() < _FITS:
                break
            factors *= more
            rows, prior_var = self.problem.window.rows.copy(), self.problem.prior_var.copy()
            rows[:, VARIANCE] *= factors[0]
            prior_var[:N_CORE] *= factors[1:]
            prior_var[lasting:] *= factors[0]
            window = self.problem.window._replace(rows=rows)
            problem = self.problem._replace(window=window, prior_var=prior_var)
            found = solution_of(problem)
            if found is None:
                break
            solution = found._replace(log_odds=self.log_odds)
        return solution

    def _misfits(self, lasting: int) -> Array:
        """Cost of the measurements for each row, and of place, velocity and clock for each of
        their states, where that is more than 1 (1 + N_CORE,)."""
        cost, state, _ = self.best
        known = (state - self.problem.prior) ** 2 / self.problem.prior_var
        of_rows = (cost - known[:lasting].sum()) / len(self.problem.window.rows)
        pairs = known[:N_CORE].reshape(-1, 2).mean(axis=1)
        return np.maximum([of_rows, *np.repeat(pairs, 2)], 1.0)


def joined(mixtures: Sequence[Mixture]) -> Mixture:
    """Several mixtures as one, normalised; what is alike is merged."""
    every = Mixture(*(np.concatenate(parts) for parts in zip(*mixtures, strict=True)))
    reduced_: Mixture = reduced(every, PART_MERGE_COST)
    return reduced_


def _cov_of_mode(mixture: Mixture) -> Array:
    """Covariance (2, 2) of the position in the mode that weighs most."""
    modes = mode_of(mixture)
    weights = np.exp(mixture.log_weights - mixture.log_weights.max())
    first = modes == np.argmax(np.bincount(modes, weights))
    _, cov = moments(Mixture(*(part[first] for part in mixture)))
    return np.asarray(cov[:2, :2])


def has_modes(mixture: Mixture, share: float) -> bool:
    """Whether more than one mode carries more than ``share``."""
    sums = np.bincount(mode_of(mixture), np.exp(mixture.log_weights))
    return bool((sums > share).sum() > 1)


def _solve(state: Array, problem: Problem) -> Fit:
    """Levenberg-Marquardt from one start: cost, state, covariance of the fit."""
    cost, state, A = minimise(problem.equations, state, cholesky_solve)
    return cost, state, inverse(A)


class Initialiser:
    """Collects rows until they determine a position."""

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._window: deque[tuple[int, Array, tuple[Rsu, ...]]] = deque()
        self._own = slow_states(config).slow_errors
        self._next_attempt_ns = 0
        self._since_ns = 0
        self.missing = ""
        """What a first fix lacks, for people; empty before the first attempt."""

    def copy(self) -> Initialiser:
        """An independent copy."""
        twin = Initialiser(self._config)
        twin._window = self._window.copy()
        twin._next_attempt_ns = self._next_attempt_ns
        twin._since_ns = self._since_ns
        twin.missing = self.missing
        return twin

    def add(self, stamp_ns: int, rows: Array, rsus: tuple[Rsu, ...]) -> None:
        """Take the rows (m, ROW_WIDTH) of one epoch, which name their slow errors as a track
        does."""
        rows = rows.copy()
        rows[:, HEADING] = -1
        self._window.append((stamp_ns, rows, rsus))
        oldest = stamp_ns - int(self._config.initial_window_s * 1e9)
        while self._window[0][0] < oldest:
            self._window.popleft()
        if len(self._window) == 1:
            self._since_ns = stamp_ns

    def solve(self, slow: SlowErrors | None = None) -> Mixture | None:
        """State (n,) of a track at the newest stamp, with the ``slow`` errors that rows name
        (None: those of the device alone), as a mixture: a place that is a thin arc is a row of
        components, and places that cannot be told apart are modes. None while the position is
        open, or for most of the window while there are several modes.

        Of three or more RSUs one may err grossly: what the others say is a part of the posterior.
        Where the measurements contradict each other and leaving out one RSU makes them agree, the
        fix is that of the others. Otherwise another clock offset may make them agree: the declared
        one is that of a device just switched on. Where nothing does, they are less certain than
        stated.
        """
        newest = self._window[-1][0]
        if newest < self._next_attempt_ns:
            return None
        waited_ns = newest - self._since_ns
        self._next_attempt_ns = newest + max(_ATTEMPT_NS, round(_RETRY_SHARE * waited_ns))
        found = self._posterior(slow or self._own)
        if isinstance(found, str):
            self.missing = found
            return None
        return found

    def _posterior(self, slow: SlowErrors) -> Mixture | str:
        """The fix, or what it lacks, for people."""
        rows, ages, errors_sd = self._stacked(slow)
        nowhere = f"no place in front of the RSUs fits {self._heard(rows)}"
        agreed = self._solution(self._problem(rows, ages, errors_sd))
        if agreed is None:
            return nowhere
        solutions, agrees = [agreed], self._consistent(agreed.cost, len(rows))
        if not agrees:
            solutions = self._that_agree(rows, ages, errors_sd) or solutions
        misfit = solutions[0].misfit
        if misfit > 1.0:
            lasting = N_CORE + int(slow.lasts.sum())
            solutions = [solution.relaxed(lasting, self._solution) for solution in solutions]
        lacks = self._lacks(rows, solutions[0].heaviest[2][:2, :2], misfit)
        if lacks:  # one minimum says so sooner than its mode
            return lacks
        posterior = solutions[0].mixture(self._plausible)
        if posterior is None:
            return nowhere
        lacks = self._lacks(rows, _cov_of_mode(posterior), misfit)
        if lacks:
            return lacks
        if agrees and self._config.isolate_rsus:
            solutions += self._one_errs(rows, solutions[0].problem)
        others = [solution.mixture(self._plausible) for solution in solutions[1:]]
        found = [self._of_track(one, slow) for one in (posterior, *others) if one is not None]
        mixture = joined(found)
        waited_s = (self._window[-1][0] - self._window[0][0]) * 1e-9
        waits = waited_s < 0.8 * self._config.initial_window_s or not carries_modes(self._config)
        if waits and has_modes(mixture, _RIVAL_SHARE):
            return f"more than one place fits {self._heard(rows)}; waiting for more"
        return mixture

    def _that_agree(self, rows: Array, ages: Array, errors_sd: Array) -> list[_Solution]:
        """Consistent solutions of measurements that contradict each other: without one of the
        RSUs, or else with another clock; none where there are none."""
        without = self._without_one(rows, ages, errors_sd)
        return without or self._any_clock(rows, ages, errors_sd)

    def _of_track(self, mixture: Mixture, slow: SlowErrors) -> Mixture:
        """The states of a track, of the components of a fit."""
        n = N_CORE + int(slow.lasts.sum())
        states = [
            state_of_fit(self._config, mean[:n], cov[:n, :n], slow)
            for mean, cov in zip(mixture.means, mixture.covs, strict=True)
        ]
        means, covs = np.array([mean for mean, _ in states]), np.array([cov for _, cov in states])
        return Mixture(means, covs, mixture.log_weights)

    def _lacks(self, rows: Array, cov: Array, misfit: float) -> str:
        """What a fit with the covariance ``cov`` (2, 2) of its position lacks, for people; empty
        where it lacks nothing."""
        sd_m = math.sqrt(float(np.linalg.eigvalsh(cov)[-1]))
        limit_m = self._config.initial_position_sd_max_m
        if sd_m > limit_m and misfit < _CONTRADICTS:
            return (
                f"{self._heard(rows)} leave a position sd of {sd_m:.1f} m "
                f"(initial_position_sd_max_m: {limit_m:g}); another RSU or quantity is needed"
            )
        if sd_m > limit_m:
            return (
                f"{self._heard(rows)} contradict each other by {math.sqrt(misfit):.3g} sd; are"
                " they in m, rad and s, and the RSUs where RsuInfo says?"
            )
        return ""

    def excess_cost(self, stamp_ns: int, mean: Array, var: Array, slow: SlowErrors) -> float:
        """How much worse the window fits where the device is at ``mean`` (6,), with variances
        ``var`` (6,), at ``stamp_ns`` than where it fits best: chi-square with 2 degrees of freedom
        for the true position. 0 without measurements of the time."""
        age_s = (stamp_ns - self._window[-1][0]) * 1e-9 if self._window else math.inf
        if age_s > self._config.initial_window_s:
            return 0.0
        rows, ages, errors_sd = self._stacked(slow)
        problem = self._problem(rows, ages, errors_sd)
        found = self._solution(problem)
        if found is None:
            return 0.0
        var = var.copy()
        var[:2] += age_s**2 * var[2:4]
        var = np.append(var, problem.prior_var[len(var) :])
        start = mean = np.append(mean, problem.prior[len(mean) :])
        start = start.copy()
        start[4] = _clock_at(start, rows, self._config.device_height_m)
        cost = _solve(start, problem._replace(prior=mean, prior_var=var))[0]
        return max(0.0, cost - found.cost)

    def _stacked(self, slow: SlowErrors) -> tuple[Array, Array, Array]:
        """The rows of the window, their ages [s], <= 0, against the newest, and the sd of the slow
        errors that are states of the fit."""
        newest = self._window[-1][0]
        rows = np.vstack([entry[1] for entry in self._window])
        ages = np.concatenate(
            [np.full(len(entry[1]), (entry[0] - newest) * 1e-9) for entry in self._window]
        )
        return rows, ages, _name_states_of_fit(rows, ages, slow)

    def _heard(self, rows: Array) -> str:
        """What was measured, by whom."""
        kinds = sorted({BY_KIND[int(kind)].name for kind in rows[:, KIND]})
        rsus = sorted({rsu.info.rsu_id for entry in self._window for rsu in entry[2]})
        return f"{', '.join(kinds)} of {', '.join(rsus) or 'no RSU'}"

    def _consistent(self, cost: float, rows: int) -> bool:
        """Whether the ``cost`` of a fit is one that true measurements have."""
        return bool(cost <= chi_square_bound(rows, 1.0 - self._config.gate_probability))

    def _without_one(self, rows: Array, ages: Array, errors_sd: Array) -> list[_Solution]:
        """Solutions with a consistent fit without one of the RSUs, best first; none of fewer than
        three RSUs."""
        placed = wrong_rsu.placed(rows)
        origins = np.unique(rows[placed, ORIGIN:AXES], axis=0)
        if len(origins) < wrong_rsu.FEWEST:
            return []
        solutions = []
        for origin in origins:
            keep = ~placed | (rows[:, ORIGIN:AXES] != origin).any(axis=1)
            others = self._solution(self._problem(rows[keep], ages[keep], errors_sd))
            if others is not None and self._consistent(others.cost, int(keep.sum())):
                solutions.append(others)
        return sorted(solutions, key=lambda solution: solution.cost)

    def _any_clock(self, rows: Array, ages: Array, errors_sd: Array) -> list[_Solution]:
        """The solution with a consistent fit whatever the clock offset is, if there is one."""
        if not any(BY_KIND[int(kind)].has_clock for kind in np.unique(rows[:, KIND])):
            return []
        problem = self._problem(rows, ages, errors_sd)
        problem.prior_var[4] = (SPEED_OF_LIGHT_MPS * _ANY_CLOCK_S) ** 2
        found = self._solution(problem)
        return [found] if found and self._consistent(found.cost, len(rows)) else []

    def _one_errs(self, rows: Array, problem: Problem) -> list[_Solution]:
        """Solutions in which one of the RSUs errs grossly, of at least three."""
        found = []
        for case in wrong_rsu.cases(*problem):
            solution = self._solution(Problem(case.window, case.prior, case.prior_var))
            if solution is not None:
                found.append(solution._replace(log_odds=case.log_odds))
        return found

    def _problem(self, rows: Array, ages: Array, errors_sd: Array) -> Problem:
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
        span_s = max(-float(ages.min()), _LEAST_SPAN_S)
        parts = min(math.ceil(span_s / _PART_S), _PARTS_MAX)
        accel = held(cfg.accel_density_mps2_sqrthz, Density.ACCEL)
        walk = c * cfg.clock_walk_density  # 0 where nobody knows it
        turns_sd = parts * [_acceleration_sd(q, span_s / parts) for q in (accel, accel, walk)]
        errors_sd = np.maximum([*errors_sd, *turns_sd], _LEAST_SD)
        prior_var = np.concatenate([sd, np.maximum(clock_sd, 1e-6), errors_sd]) ** 2
        prior = np.append(prior, np.zeros(errors_sd.size))
        first = prior.size - len(turns_sd)
        window = Window(ages, rows, cfg.device_height_m, first, span_s / parts, parts)
        return Problem(window, prior, prior_var)

    def _solution(self, problem: Problem) -> _Solution | None:
        """What is found from the most promising starts; None where that is nothing."""
        starts = self._starts(problem)
        free = [fit for fit in (_solve(start, problem) for start in starts) if _is_sound(fit)]
        nearer = [log_weight_of(fit) for fit in free if self._is_on_rsu(fit[1])]
        # on top of an RSU anything fits: the distances of the starts are as good
        fits = [self._constrained(start, problem) for start in starts] if nearer else []
        minima = [fit for fit in free if self._plausible(fit[1])]
        constrained = [fit for fit in fits if _is_sound(fit) and self._plausible(fit[1])]
        if not minima and not constrained:
            return None
        return _Solution(problem, minima, constrained, max(nearer, default=-math.inf))

    def _starts(self, problem: Problem) -> list[Array]:
        """The starts (n,) that cost least."""
        rows = problem.window.rows
        scored: list[tuple[float, int, Array]] = []
        for xy in _starts(rows, problem.prior[:2], math.sqrt(problem.prior_var[0])):
            state = problem.prior.copy()
            state[:2] = xy
            state[4] = _clock_at(state, rows, self._config.device_height_m)
            scored.append((problem.equations(state)[0], len(scored), state))
        return [state for _, _, state in sorted(scored)[:_REFINED]]

    def _constrained(self, start: Array, problem: Problem) -> Fit:
        """The most probable state that is as far from the nearest RSU as ``start``."""
        origins = np.array([r.info.position[:2] for e in self._window for r in e[2]])
        away = start[:2] - origins[np.argmin(np.hypot(*(start[:2] - origins).T))]
        far = float(np.hypot(*away))
        if far < _NEAREST_M:
            return math.inf, start, np.eye(start.size)
        return on_line(problem.equations, start, away / far)

    def _plausible(self, state: Array) -> bool:
        """Not behind an array without a back, and not on top of an RSU."""
        heard = (rsu for entry in self._window for rsu in entry[2])
        in_front = all(rsu.in_front(*(state[:2] - rsu.info.position[:2])) for rsu in heard)
        return in_front and not self._is_on_rsu(state)

    def _is_on_rsu(self, state: Array) -> bool:
        """Whether ``state`` is nearer to an RSU than a device can be. Any angle fits there: this
        is asked of RSUs that measure no distance, and of the only one that measures times."""
        timed: set[tuple[float, ...]] = set()
        ranged: set[tuple[float, ...]] = set()
        for row in (row for e in self._window for row in e[1]):
            sensor, origin = BY_KIND[int(row[KIND])], tuple(row[ORIGIN:AXES])
            if sensor.is_range:
                (timed if sensor.has_clock else ranged).add(origin)
        if len(timed) > 1:  # what one RSU hears says nothing of the distance
            ranged |= timed
        up = self._config.device_height_m + state[N_CORE : N_CORE + self._own.sd.size].sum()
        places = {tuple(r.info.position) for e in self._window for r in e[2]} - ranged
        return any(math.dist(place, (state[0], state[1], up)) < _NEAREST_M for place in places)


def with_heading(
    mean: Array, cov: Array, rows: Array, height_m: float
) -> tuple[Array, Array] | None:
    """A fix mean (6,), cov (6, 6) that ignored the lever arms of ``rows`` (m, ROW_WIDTH), and the
    heading they speak for: mean (7,), cov (7, 7); None where they leave it open."""
    levers = rows[rows[:, HEADING] >= 0, LEVER:BLOCKED]
    if not levers.any():
        return None
    rows = rows.copy()
    drop_biases(rows)
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


def _acceleration_sd(density: float, part_s: float) -> float:
    """Sd of a constant acceleration [m/s^2] that moves as far in ``part_s`` seconds as white
    acceleration of the ``density`` q does: q^2 T^3 / 3 = (a T^2 / 2)^2."""
    return 2.0 * density / math.sqrt(3.0 * part_s)


def _name_states_of_fit(rows: Array, ages_s: Array, slow: SlowErrors) -> Array:
    """Let ``rows`` (m, ROW_WIDTH) name the ``slow`` errors as states of the fit, in place: behind
    those of the device first those that last, then the others, of every epoch its own. Their
    sd."""
    sd, rank = slow.sd[slow.lasts], np.cumsum(slow.lasts) - 1
    for column in (BIAS, COMMON, REFERENCE, HEIGHT):
        named = np.flatnonzero(rows[:, column] >= slow.first)
        error = rows[named, column].astype(int) - slow.first
        lasts = slow.lasts[error]
        rows[named[lasts], column] = N_CORE + rank[error[lasts]]
        new, error = named[~lasts], error[~lasts]
        if new.size:
            epochs = np.column_stack([error, ages_s[new]])
            _, first, which = np.unique(epochs, axis=0, return_index=True, return_inverse=True)
            rows[new, column] = N_CORE + sd.size + which.reshape(-1)
            sd = np.append(sd, slow.sd[error[first]])
    return sd


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
