"""One RSU that errs grossly: a case that a first fix allows for.

Its errors, one in each quantity and one in everything that others compare with it, are states of
the fit in place of its slow errors: what the RSU says of changes still counts, where it is from
then on does not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation.measurement import AXES, BIAS, KIND, ORIGIN, REFERENCE, VARIANCE, Kind
from netpos.estimation.mixture.window import Problem
from netpos.messages.values import Array

Flags = npt.NDArray[np.bool_]

FEWEST = 3
"""RSUs of which one may be wrong: of two nobody can tell."""

_WRONG = 0.01  # probability
_GROSS_SD = 30.0
_SAME_M = 1e-3  # RSUs nearer to each other are one


class Case(NamedTuple):
    """A fit as it is if one RSU is wrong, and the log odds of that with the log density of the
    errors it may have, where they are 0."""

    problem: Problem
    log_odds: float


def placed(rows: Array) -> Flags:
    """(m,) whether a row is measured from the place of an RSU."""
    there: Flags = ~np.isin(rows[:, KIND], (Kind.LINEAR, Kind.SPEED))
    return there


def cases(problem: Problem) -> Iterator[Case]:
    """The fit once for each RSU that may be wrong; of fewer than three RSUs none."""
    window, prior, prior_var = problem
    references = _references(window.rows)
    own = placed(window.rows)
    origins = window.rows[:, ORIGIN : ORIGIN + 2]
    every = np.vstack([origins[own], references[np.isfinite(references[:, 0])]])
    places = np.unique(np.round(every / _SAME_M), axis=0) * _SAME_M
    if len(places) < FEWEST:
        return
    for place in places:
        rows, states, variances = window.rows.copy(), prior, prior_var
        log_odds = math.log(_WRONG)
        for column, of_it in (
            (BIAS, own & _is_at(origins, place)),
            (REFERENCE, _is_at(references, place)),
        ):
            for kind in np.unique(rows[of_it, KIND]):
                alike = of_it & (rows[:, KIND] == kind)
                slow = rows[alike, column].astype(int)
                slow_var = np.where(slow > 0, prior_var[slow], 0.0)
                variance = _GROSS_SD**2 * float((rows[alike, VARIANCE] + slow_var).mean())
                rows[alike, column] = len(states)
                states, variances = np.append(states, 0.0), np.append(variances, variance)
                log_odds -= 0.5 * math.log(2.0 * math.pi * variance)
        yield Case(Problem(window._replace(rows=rows), states, variances), log_odds)


def _references(rows: Array) -> Array:
    """Horizontal places (m, 2) of the RSUs with which rows compare theirs; not a number where
    there is none."""
    compares = (rows[:, KIND] == Kind.TDOA)[:, None]
    return np.where(compares, rows[:, ORIGIN : ORIGIN + 2] + rows[:, AXES : AXES + 2], math.nan)


def _is_at(places: Array, place: Array) -> Flags:
    """(m,) which of the horizontal ``places`` (m, 2) is ``place`` (2,)."""
    near = np.abs(places - place) < _SAME_M
    return near[:, 0] & near[:, 1]
