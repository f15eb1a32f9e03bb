"""What the measurements of a short window say of a device of which nothing else is known.

A maximum a posteriori fit of [x, y, vx, vy, clock, drift], and of the slow errors in the
measurements (the height too, where it is unknown), at the newest stamp: Levenberg-Marquardt from
several starts, and what lies around the minima as a mixture. Measurements that contradict each
other are explained by one RSU, by the clock, by outliers or by larger variances. The track goes on
with the slow errors as the fit found them: what they have in common with the position is not heard
twice.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np

from netpos.estimation.measurement import AXES, KIND, ORIGIN
from netpos.estimation.mixture.gaussians import Mixture, mode_of, moments
from netpos.estimation.mixture.reduction import PART_MERGE_COST, reduced
from netpos.estimation.mixture.ridge import Fit, across, log_weight_of
from netpos.estimation.mixture.window import Problem
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.sensors.table import BY_KIND
from netpos.estimation.state import N_CORE
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import slow_states, state_of_fit
from netpos.tracking.first_fix import wrong_rsu
from netpos.tracking.first_fix.fit import Solution, Start, is_sound, minima
from netpos.tracking.first_fix.problem import Heard, problem_of, stacked, with_free_clock
from netpos.tracking.first_fix.starts import clock_at, starts_of
from netpos.tracking.first_fix.surroundings import NEAREST_M, Surroundings
from netpos.tracking.rsus.rsu import SlowErrors

_REFINED = 12  # starts
_ANY_CLOCK_S = 1.0
_LEFT = 0.5  # of what measurements contradict, where a clock that walks explains most of it
_CONTRADICTS = 9.0  # mean squared residual over variance


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


class WindowFit:
    """The fit of a window of what was ``heard``, whose rows name the ``slow`` errors."""

    def __init__(self, config: TrackerConfig, heard: Collection[Heard], slow: SlowErrors) -> None:
        self._config, self._slow = config, slow
        self._rows, self._ages_s, self._errors_sd = stacked(heard, slow)
        self._rsus = [rsu for one in heard for rsu in one.rsus]
        heights = slow_states(config).slow_errors.sd.size
        self._surroundings = Surroundings(self._rows, self._rsus, config.device_height_m, heights)
        self._risk = 1.0 - config.gate_probability

    @property
    def sources(self) -> str:
        """What was measured, by whom, for people."""
        kinds = sorted({BY_KIND[int(kind)].name for kind in self._rows[:, KIND]})
        rsus = sorted({rsu.info.rsu_id for rsu in self._rsus})
        return f"{', '.join(kinds)} of {', '.join(rsus) or 'no RSU'}"

    def posterior(self) -> Mixture | str:
        """State (n,) of a track at the newest stamp, with its slow errors, as a mixture: a place
        that is a thin arc is a row of components, and places that cannot be told apart are modes.
        Or what it lacks, for people.

        Of three values of an RSU one may be an outlier. Of three or more RSUs one may err
        grossly: what the others say is a part of the posterior. Where the measurements
        contradict each other and leaving out one RSU makes them agree, the fix is that of
        the others. Otherwise another clock offset may make them agree: the declared one is
        that of a device just switched on; or it walks as nobody knows. Where nothing does, they
        are less certain than stated.
        """
        nowhere = f"no place in front of the RSUs fits {self.sources}"
        agreed = self._solution(self._problem())
        if agreed is None:
            return nowhere
        solutions, agrees = [agreed], agreed.is_consistent(self._risk)
        if not agrees:
            solutions = self._that_agree() or [self._least_contradicting(agreed)]
        misfit = solutions[0].misfit
        if misfit > 1.0:
            lasting = N_CORE + int(self._slow.lasts.sum())
            solutions = [solution.relaxed(lasting, self._solution) for solution in solutions]
        lacks = self._lacks(solutions[0].heaviest[2][:2, :2], misfit)
        if lacks:  # one minimum says so sooner than its mode
            return lacks
        posterior = solutions[0].mixture(self._surroundings.is_possible)
        if posterior is None:
            return nowhere
        lacks = self._lacks(_cov_of_mode(posterior), misfit)
        if lacks:
            return lacks
        if agrees and self._config.isolate_rsus:
            solutions += self._one_errs(solutions[0].problem)
        others = [solution.mixture(self._surroundings.is_possible) for solution in solutions[1:]]
        return joined([self._of_track(one) for one in (posterior, *others) if one is not None])

    def excess_cost(self, age_s: float, mean: Array, var: Array) -> float:
        """How much worse the window fits where the device is at ``mean`` (6,), with variances
        ``var`` (6,), ``age_s`` after its newest stamp than where it fits best: chi-square with 2
        degrees of freedom for the true position."""
        problem = self._problem()
        found = self._solution(problem)
        if found is None:
            return 0.0
        var = var.copy()
        var[:2] += age_s**2 * var[2:4]
        var = np.append(var, problem.prior_var[len(var) :])
        start = mean = np.append(mean, problem.prior[len(mean) :])
        start = start.copy()
        start[4] = clock_at(start, self._rows, self._config.device_height_m)
        there = minima([Start(start)], problem._replace(prior=mean, prior_var=var))
        return max(0.0, min(cost for cost, _, _ in there) - found.best[0])

    def _problem(self) -> Problem:
        return problem_of(self._config, self._rsus, self._rows, self._ages_s, self._errors_sd)

    def _that_agree(self) -> list[Solution]:
        """Consistent solutions of measurements that contradict each other: without one of the
        RSUs, or else with another clock; none where there are none."""
        return self._without_one() or self._any_clock()

    def _least_contradicting(self, agreed: Solution) -> Solution:
        """Of measurements that contradict each other the solution whose clock walks as nobody
        knows, if that explains them, or most of what they contradict. Or else the one that
        ``agreed`` on one clock. None of them is an outlier then: none is where they contradict
        each other."""
        walking = self._any_walk()
        if walking is not None and walking.is_consistent(self._risk):
            return walking
        plain = self._without_outliers(agreed)
        if walking is None:
            return plain
        walking = self._without_outliers(walking)
        return walking if walking.excess < _LEFT * plain.excess else plain

    def _without_outliers(self, solution: Solution) -> Solution:
        """The solution if none of the measurements is an outlier."""
        return self._solution(solution.problem.without_outliers()) or solution

    def _without_one(self) -> list[Solution]:
        """Solutions with a consistent fit without one of the RSUs, best first; none of fewer than
        three RSUs."""
        rows, placed = self._rows, wrong_rsu.placed(self._rows)
        origins = np.unique(rows[placed, ORIGIN:AXES], axis=0)
        if len(origins) < wrong_rsu.FEWEST:
            return []
        solutions = []
        for origin in origins:
            keep = ~placed | (rows[:, ORIGIN:AXES] != origin).any(axis=1)
            ages_s = self._ages_s[keep]
            others = self._solution(
                problem_of(self._config, self._rsus, rows[keep], ages_s, self._errors_sd)
            )
            if others is not None and others.is_consistent(self._risk):
                solutions.append(others)
        return sorted(solutions, key=lambda solution: solution.best[0])

    def _any_clock(self) -> list[Solution]:
        """The solution with a consistent fit whatever the clock offset is, if there is one."""
        if not any(BY_KIND[int(kind)].has_clock for kind in np.unique(self._rows[:, KIND])):
            return []
        problem = self._problem()
        problem.prior_var[4] = (SPEED_OF_LIGHT_MPS * _ANY_CLOCK_S) ** 2
        found = self._solution(problem)
        return [found] if found and found.is_consistent(self._risk) else []

    def _any_walk(self) -> Solution | None:
        """The solution whatever the clock offset is at each instant; None where it is known how
        the clock walks, or where no two RSUs hear the device at one instant."""
        if self._config.clock_walk_density > 0.0:
            return None
        free = with_free_clock(self._rows, self._ages_s, self._errors_sd)
        if free is None:
            return None
        return self._solution(problem_of(self._config, self._rsus, *free))

    def _one_errs(self, problem: Problem) -> list[Solution]:
        """Solutions in which one of the RSUs errs grossly, of at least three."""
        found = []
        for case in wrong_rsu.cases(problem):
            solution = self._solution(case.problem)
            if solution is not None:
                found.append(solution._replace(log_odds=case.log_odds))
        return found

    def _lacks(self, cov: Array, misfit: float) -> str:
        """What a fit with the covariance ``cov`` (2, 2) of its position lacks, for people; empty
        where it lacks nothing."""
        sd_m = math.sqrt(float(np.linalg.eigvalsh(cov)[-1]))
        limit_m = self._config.initial_position_sd_max_m
        if sd_m > limit_m and misfit < _CONTRADICTS:
            return (
                f"{self.sources} leave a position sd of {sd_m:.1f} m "
                f"(initial_position_sd_max_m: {limit_m:g}); another RSU or quantity is needed"
            )
        if sd_m > limit_m:
            return (
                f"{self.sources} contradict each other by {math.sqrt(misfit):.3g} sd; are"
                " they in m, rad and s, and the RSUs where RsuInfo says?"
            )
        return ""

    def _of_track(self, mixture: Mixture) -> Mixture:
        """The states of a track, of the components of a fit."""
        n = N_CORE + int(self._slow.lasts.sum())
        states = [
            state_of_fit(self._config, mean[:n], cov[:n, :n], self._slow)
            for mean, cov in zip(mixture.means, mixture.covs, strict=True)
        ]
        means, covs = np.array([mean for mean, _ in states]), np.array([cov for _, cov in states])
        return Mixture(means, covs, mixture.log_weights)

    def _solution(self, problem: Problem) -> Solution | None:
        """What is found from the most promising starts; None where that is nothing."""
        around, starts = self._surroundings, self._starts(problem)
        free = _sound([Start(state) for state in starts], problem)
        nearer = [log_weight_of(fit) for fit in free if around.is_on_rsu(fit[1])]
        # on top of an RSU anything fits: the distances of the starts are as good
        at_distances = self._at_distances(starts) if nearer else []
        constrained = [fit for fit in _sound(at_distances, problem) if around.is_possible(fit[1])]
        free = [fit for fit in free if around.is_possible(fit[1])]
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

    def _at_distances(self, starts: Sequence[Array]) -> list[Start]:
        """The starts (n,) that stay as far from the nearest RSU as they are."""
        found = []
        for state in starts:
            away = self._surroundings.from_nearest(state[:2])
            far = float(np.hypot(*away))
            if far >= NEAREST_M:
                found.append(Start(state, across(state, away / far)))
        return found


def _sound(starts: Sequence[Start], problem: Problem) -> list[Fit]:
    return [fit for fit in minima(starts, problem) if is_sound(fit)]
