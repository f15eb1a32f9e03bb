"""A first fix as least squares: the problem, how it is minimised, and what its minima say."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from netpos.estimation.chi_square import chi_square_bound
from netpos.estimation.factor import inverse
from netpos.estimation.measurement import GROUP
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.mixture.ridge import Fit, Line, components_of, log_weight_of, on_line
from netpos.estimation.mixture.window import Problem, Window, outliers_of, typical_scale
from netpos.estimation.state import N_CORE
from netpos.messages.values import Array

_RELAXATIONS, _FITS = 5, 1.1
_GRADUATION = 4.0
_LEAST_RISK = 1e-12


class Start(NamedTuple):
    """A state (n,) from which to look for a minimum, and a ``line`` that keeps its position where
    it is along that."""

    state: Array
    line: Line | None = None


class Solution(NamedTuple):
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
    def outliers(self) -> tuple[float, float]:
        """How many measurements are outliers at the best, and what they cost."""
        found: tuple[float, float] = outliers_of(self.best[1], self.problem.window)
        return found

    @property
    def cost(self) -> float:
        """That of the best, without outliers."""
        return self.best[0] - self.outliers[1]

    @property
    def misfit(self) -> float:
        """Cost for each row where it is more than the 1 of true measurements, or 1."""
        return max(1.0, self.cost / len(self.problem.window.rows))

    @property
    def excess(self) -> float:
        """Cost for each row that the states of the fit do not take up."""
        taken = self.problem.prior.size - N_CORE
        return self.cost / max(len(self.problem.window.rows) - taken, 1)

    def is_consistent(self, risk: float) -> bool:
        """Whether the cost of the best is one that true measurements have, with as many outliers
        among them as there may be, but for a ``risk`` that they have not."""
        window = self.problem.window
        fits = self.cost <= chi_square_bound(len(window.rows), risk)
        return bool(fits and self.outliers[0] < _most_outliers(window, risk) + 0.5)

    def mixture(self, is_possible: Callable[[Array], bool]) -> Mixture | None:
        """The posterior of all states; None where more of it is impossible."""
        found = components_of(self.problem, self.minima, self.constrained, is_possible)
        if found is None or np.logaddexp.reduce(found.log_weights) < self.nearer:
            return None
        return found._replace(log_weights=found.log_weights + self.log_odds)

    def relaxed(self, lasting: int, solution_of: Callable[[Problem], Solution | None]) -> Solution:
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
            prior_var = self.problem.prior_var.copy()
            prior_var[:N_CORE] *= factors[1:]
            prior_var[lasting:] *= factors[0]
            found = solution_of(self.problem.scaled(factors[0])._replace(prior_var=prior_var))
            if found is None:
                break
            solution = found._replace(log_odds=self.log_odds)
        return solution

    def _misfits(self, lasting: int) -> Array:
        """Cost of the measurements for each row, and of place, velocity and clock for each of
        their states, where that is more than 1 (1 + N_CORE,)."""
        known = (self.best[1] - self.problem.prior) ** 2 / self.problem.prior_var
        of_rows = (self.cost - known[:lasting].sum()) / len(self.problem.window.rows)
        pairs = known[:N_CORE].reshape(-1, 2).mean(axis=1)
        return np.maximum([of_rows, *np.repeat(pairs, 2)], 1.0)


def minimum(start: Start, problem: Problem) -> Fit:
    """The minimum to which a start leads: cost, state, covariance of the fit."""
    if start.line is not None:
        return on_line(problem, start.state, start.line)
    cost, state, A = problem.minimum(start.state)
    return cost, state, inverse(A)


def sequences(problem: Problem, state: Array) -> list[list[Problem]]:
    """Two sequences of problems that end with this one; each starts where the one before it
    ended, the first at ``state`` (n,). One begins without outliers. The other begins with
    variances as large as the residuals at ``state``, and goes on with smaller ones (graduated
    non-convexity: Blake and Zisserman 1987). Either may lead to an RSU beside which any
    direction fits. Without outliers the problem is its only sequence."""
    if not problem.window.outliers.any():
        return [[problem]]
    scale, graduated = typical_scale(state, problem.window), []
    while scale > _GRADUATION:
        graduated.append(problem.scaled(scale))
        scale /= _GRADUATION
    return [[problem.without_outliers(), problem], [*graduated, problem]]


def minima(starts: Sequence[Start], problem: Problem) -> list[Fit]:
    """Each ``minimum`` to which one of the ``sequences`` leads from one of the starts."""
    found = []
    for start in starts:
        for sequence in sequences(problem, start.state):
            there = start
            for step in sequence:
                fit = minimum(there, step)
                there = start._replace(state=fit[1])
            found.append(fit)
    return found


def is_sound(fit: Fit) -> bool:
    """Whether the fit is finite and its position covariance survived rounding."""
    cost, _, cov = fit
    return bool(math.isfinite(cost) and np.linalg.eigvalsh(cov[:2, :2])[0] > 0.0)


def _most_outliers(window: Window, risk: float) -> int:
    """The number of outliers in a window that is exceeded with the probability ``risk`` at most,
    by the distribution of rare events."""
    _, first = np.unique(window.rows[:, GROUP], return_index=True)
    expected = float(window.outliers[first].sum())
    count, term = 0, math.exp(-expected)
    beyond = 1.0 - term
    while beyond > max(risk, _LEAST_RISK):
        count += 1
        term *= expected / count
        beyond -= term
    return count
