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
from collections.abc import Sequence

import numpy as np

from netpos.estimation.densities import Density, held
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    GROUP,
    HEADING,
    HEIGHT,
    KIND,
    ORIGIN,
    REFERENCE,
    Kind,
)
from netpos.estimation.mixture.gaussians import Mixture, mode_of, moments
from netpos.estimation.mixture.outliers import share_of_outliers
from netpos.estimation.mixture.reduction import PART_MERGE_COST, reduced
from netpos.estimation.mixture.ridge import Fit, log_weight_of
from netpos.estimation.mixture.window import Window
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.sensors.table import BY_KIND
from netpos.estimation.state import N_CORE
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import carries_modes, slow_states, state_of_fit
from netpos.tracking.first_fix import wrong_rsu
from netpos.tracking.first_fix.fit import Problem, Solution, is_sound, minima
from netpos.tracking.first_fix.starts import clock_at, starts_of
from netpos.tracking.rsus.rsu import Rsu, SlowErrors

_REFINED = 12
_ATTEMPT_NS = 100_000_000
_LEAST_SPAN_S = 0.1  # of a window
_PART_S, _PARTS_MAX = 0.75, 8  # of the window, in which accelerations are constant
_RETRY_SHARE = 0.05  # the next attempt comes after so much of the time waited
# Places that cannot be told apart are waited for from this share on, and carried along below it.
_MODE_SHARE = 0.01
_ANY_CLOCK_S = 1.0
_CONTRADICTS = 9.0  # mean squared residual over variance
_TELLING = 3  # values of an RSU, of which one can be told to be an outlier
_NEAREST_M = 1.0
_LEAST_SD = 1e-9  # of a slow error


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

    @property
    def _risk(self) -> float:
        return 1.0 - self._config.gate_probability

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

        Of three values of an RSU one may be an outlier. Of three or more RSUs one may err
        grossly: what the others say is a part of the posterior. Where the measurements
        contradict each other and leaving out one RSU makes them agree, the fix is that of
        the others. Otherwise another clock offset may make them agree: the declared one is
        that of a device just switched on. Where nothing does, they are less certain than
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
        solutions, agrees = [agreed], agreed.is_consistent(self._risk)
        if not agrees:
            solutions = self._that_agree(rows, ages, errors_sd) or self._without_outliers(agreed)
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
        if waits and has_modes(mixture, _MODE_SHARE):
            return f"more than one place fits {self._heard(rows)}; waiting for more"
        return mixture

    def _that_agree(self, rows: Array, ages: Array, errors_sd: Array) -> list[Solution]:
        """Consistent solutions of measurements that contradict each other: without one of the
        RSUs, or else with another clock; none where there are none."""
        without = self._without_one(rows, ages, errors_sd)
        return without or self._any_clock(rows, ages, errors_sd)

    def _without_outliers(self, solution: Solution) -> list[Solution]:
        """The solution if none of the measurements is an outlier: none where they contradict each
        other is."""
        return [self._solution(solution.problem.without_outliers()) or solution]

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
        start[4] = clock_at(start, rows, self._config.device_height_m)
        there = minima(start, problem._replace(prior=mean, prior_var=var))
        return max(0.0, min(cost for cost, _, _ in there) - found.best[0])

    def _stacked(self, slow: SlowErrors) -> tuple[Array, Array, Array]:
        """The rows of the window, their groups numbered through, their ages [s], <= 0, against the
        newest, and the sd of the slow errors that are states of the fit."""
        newest = self._window[-1][0]
        rows = np.vstack([entry[1] for entry in self._window])
        ages = np.concatenate(
            [np.full(len(entry[1]), (entry[0] - newest) * 1e-9) for entry in self._window]
        )
        measurements = np.column_stack([ages, rows[:, GROUP]])
        rows[:, GROUP] = np.unique(measurements, axis=0, return_inverse=True)[1].reshape(-1)
        return rows, ages, _name_states_of_fit(rows, ages, slow)

    def _heard(self, rows: Array) -> str:
        """What was measured, by whom."""
        kinds = sorted({BY_KIND[int(kind)].name for kind in rows[:, KIND]})
        rsus = sorted({rsu.info.rsu_id for entry in self._window for rsu in entry[2]})
        return f"{', '.join(kinds)} of {', '.join(rsus) or 'no RSU'}"

    def _without_one(self, rows: Array, ages: Array, errors_sd: Array) -> list[Solution]:
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
            if others is not None and others.is_consistent(self._risk):
                solutions.append(others)
        return sorted(solutions, key=lambda solution: solution.best[0])

    def _any_clock(self, rows: Array, ages: Array, errors_sd: Array) -> list[Solution]:
        """The solution with a consistent fit whatever the clock offset is, if there is one."""
        if not any(BY_KIND[int(kind)].has_clock for kind in np.unique(rows[:, KIND])):
            return []
        problem = self._problem(rows, ages, errors_sd)
        problem.prior_var[4] = (SPEED_OF_LIGHT_MPS * _ANY_CLOCK_S) ** 2
        found = self._solution(problem)
        return [found] if found and found.is_consistent(self._risk) else []

    def _one_errs(self, rows: Array, problem: Problem) -> list[Solution]:
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
        height_m, outliers = cfg.device_height_m, _outlier_shares(rows)
        window = Window(ages, rows, height_m, first, span_s / parts, parts, outliers)
        return Problem(window, prior, prior_var)

    def _solution(self, problem: Problem) -> Solution | None:
        """What is found from the most promising starts; None where that is nothing."""
        starts = self._starts(problem)
        free = [fit for start in starts for fit in minima(start, problem) if is_sound(fit)]
        nearer = [log_weight_of(fit) for fit in free if self._is_on_rsu(fit[1])]
        # on top of an RSU anything fits: the distances of the starts are as good
        constrained = [
            fit
            for start in (starts if nearer else [])
            for fit in self._constrained(start, problem)
            if is_sound(fit) and self._plausible(fit[1])
        ]
        free = [fit for fit in free if self._plausible(fit[1])]
        if not free and not constrained:
            return None
        return Solution(problem, free, constrained, max(nearer, default=-math.inf))

    def _starts(self, problem: Problem) -> list[Array]:
        """The starts (n,) that cost least."""
        rows, sound = problem.window.rows, problem.without_outliers()
        scored: list[tuple[float, int, Array]] = []
        for xy in starts_of(rows, problem.prior[:2], math.sqrt(problem.prior_var[0])):
            state = problem.prior.copy()
            state[:2] = xy
            state[4] = clock_at(state, rows, self._config.device_height_m)
            scored.append((sound.equations(state)[0], len(scored), state))
        return [state for _, _, state in sorted(scored)[:_REFINED]]

    def _constrained(self, start: Array, problem: Problem) -> list[Fit]:
        """The most probable states that are as far from the nearest RSU as ``start``."""
        origins = np.array([r.info.position[:2] for e in self._window for r in e[2]])
        away = start[:2] - origins[np.argmin(np.hypot(*(start[:2] - origins).T))]
        far = float(np.hypot(*away))
        if far < _NEAREST_M:
            return []
        return minima(start, problem, along=away / far)

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


def _outlier_shares(rows: Array) -> Array:
    """The probability of each of ``rows`` (m, ROW_WIDTH) that it is an outlier (m,): 0 where its
    RSU has measured the quantity fewer than three times. Nobody can tell an outlier from a wrong
    RSU then."""
    sources = np.column_stack([rows[:, KIND], rows[:, ORIGIN:AXES]])
    _, which, counts = np.unique(sources, axis=0, return_inverse=True, return_counts=True)
    shares = np.array([share_of_outliers(row) for row in rows])
    return np.where(counts[which.reshape(-1)] < _TELLING, 0.0, shares)


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
