"""Figures of walks over runs, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.messages.values import Array
from netpos.reproduction.petukhov.walk_figures import (
    FAR_M,
    LOST_M,
    Figures,
    Scores,
    ratio_at_same_instants,
)

TIMES = 0.1 * np.arange(30)
NAN = math.nan


def scores(error_m: Array | float, first: int = 0) -> Scores:
    """A run along x whose first estimates are not scored, with a covariance of 0.01 m^2."""
    error = np.zeros((len(TIMES), 2))
    error[:, 0] = error_m
    error[:first] = NAN
    return Scores.of(error, np.tile(0.01 * np.eye(2), (len(TIMES), 1, 1)))


def test_scores_by_hand() -> None:
    run = scores(0.2, first=4)
    assert np.isnan(run.error2[:4]).all()
    np.testing.assert_allclose(run.error2[4:], 0.04)
    np.testing.assert_allclose(run.nees[4:], 4.0)


def test_a_covariance_that_is_unknown_counts_as_an_error_only() -> None:
    cov = np.tile(np.eye(2), (len(TIMES), 1, 1))
    cov[3] = 0.0
    run = Scores.of(np.ones((len(TIMES), 2)), cov)
    assert np.isnan(run.nees[3])
    assert run.error2[3] == 2.0


def test_figures_by_hand() -> None:
    figures = Figures.of(TIMES, [scores(0.1, first=10), scores(0.3, first=20)])
    assert figures.runs == 2
    assert figures.rmse_m == pytest.approx(math.sqrt((20 * 0.01 + 10 * 0.09) / 30))
    assert figures.error_max_m == pytest.approx(0.3)
    assert figures.nees.mean == pytest.approx((20 * 1.0 + 10 * 9.0) / 30)
    assert figures.decided_s == pytest.approx((1.5, 1.95))
    assert figures.unscored == 0.5
    assert figures.lost == 0


@pytest.mark.parametrize(("end_m", "lost"), [(LOST_M - 1e-6, 0), (LOST_M + 1e-6, 1), (NAN, 1)])
def test_lost_is_off_or_without_an_estimate_at_the_end(end_m: float, lost: int) -> None:
    error = np.full(len(TIMES), 0.01)
    error[-20:] = end_m
    assert Figures.of(TIMES, [scores(0.01), scores(error)]).lost == lost


def test_one_bad_run_is_not_the_median() -> None:
    runs = [scores(0.1, first=10), scores(0.2), scores(9.0), scores(NAN)]
    assert Figures.of(TIMES, runs).median_rmse_m == pytest.approx(0.2)


def test_far_off_at_first_is_not_lost_but_counted() -> None:
    error = np.full(len(TIMES), 0.01)
    error[5] = FAR_M + 0.1
    figures = Figures.of(TIMES, [scores(0.01), scores(error)])
    assert figures.lost == 0
    assert figures.share_above(FAR_M) == 0.5
    assert figures.share_above(FAR_M + 0.2) == 0.0


def test_a_ratio_is_of_the_instants_both_have() -> None:
    """The first errors of the one that starts earlier do not count."""
    early = np.full(len(TIMES), 0.2)
    early[:10] = 5.0
    above = Figures.of(TIMES, [scores(early)])
    below = Figures.of(TIMES, [scores(0.1, first=10)])
    assert ratio_at_same_instants(above, below) == pytest.approx(2.0)
    assert above.rmse_m / below.rmse_m > 10.0


def test_a_ratio_without_common_instants_is_none() -> None:
    ended = np.full(len(TIMES), 0.1)
    ended[10:] = NAN
    one, other = (Figures.of(TIMES, [run]) for run in (scores(ended), scores(0.1, first=10)))
    assert ratio_at_same_instants(one, other) is None


def test_runs_without_any_estimate_have_no_figures() -> None:
    with pytest.raises(ValueError, match="at least one estimate"):
        Figures.of(TIMES, [scores(NAN)])
