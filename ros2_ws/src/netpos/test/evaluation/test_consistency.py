"""NEES, NIS and the bounds of their means against closed forms and simulation."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.evaluation.consistency import (
    chi2_mean_bounds,
    nees,
    nees_over_runs,
    nis_test,
    whitened,
)
from scipy.special import gammainc
from scipy.stats import chi2
from scipy.stats import t as student_t


def test_nees_of_a_diagonal_covariance_is_the_sum_of_squared_ratios() -> None:
    error, sd = np.array([[3.0, -4.0]]), np.array([1.5, 2.0])
    values, usable = nees(error, np.diag(sd**2)[None])
    np.testing.assert_allclose(values, [8.0])
    assert usable.tolist() == [True]


def test_nees_does_not_depend_on_the_axes() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    error, cov = np.array([1.0, 2.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    plain, _ = nees(error[None], cov[None])
    turned, _ = nees((turn @ error)[None], (turn @ cov @ turn.T)[None])
    np.testing.assert_allclose(turned, plain, rtol=1e-12)


def test_normalised_errors_have_the_identity_as_covariance() -> None:
    rng = np.random.default_rng(3)
    cov = np.array([[2.0, 0.9], [0.9, 0.5]])
    error = rng.multivariate_normal(np.zeros(2), cov, 20_000)
    normalised, usable = whitened(error, np.tile(cov, (20_000, 1, 1)))
    assert usable.all()
    np.testing.assert_allclose(normalised.T @ normalised / 20_000, np.eye(2), atol=0.03)


def test_unusable_covariances_give_no_nees() -> None:
    cov = np.array([np.eye(2), np.zeros((2, 2)), -np.eye(2), np.full((2, 2), np.nan)])
    values, usable = nees(np.ones((4, 2)), cov)
    assert usable.tolist() == [True, False, False, False]
    np.testing.assert_allclose(values, [2.0])


@pytest.mark.parametrize("n", [1, 10, 500])
def test_bounds_of_two_degrees_leave_2_5_percent_on_each_side(n: int) -> None:
    """Chi-square with 2 n degrees is distributed as the regularised gamma function."""
    low, high = chi2_mean_bounds(2.0, n)
    np.testing.assert_allclose(gammainc(n, n * low / 2), 0.025, rtol=1e-9)
    np.testing.assert_allclose(gammainc(n, n * high / 2), 0.975, rtol=1e-9)


def test_bounds_of_one_sample_have_a_closed_form() -> None:
    """With 2 degrees of freedom the quantile is -2 ln(1 - p)."""
    np.testing.assert_allclose(
        chi2_mean_bounds(2.0, 1), [-2 * np.log(0.975), -2 * np.log(0.025)], rtol=1e-12
    )


def test_nis_of_epochs_with_different_sizes() -> None:
    """The sum of independent chi-square values has the summed degrees of freedom."""
    dof = np.array([2.0, 4.0, 4.0])
    result = nis_test(np.array([1.0, 5.0, 3.0]), dof)
    assert result is not None
    assert result.mean == 3.0
    np.testing.assert_allclose(np.array(result.bounds) * 3, chi2.interval(0.95, 10), rtol=1e-12)


def test_nothing_evaluated_is_no_verdict() -> None:
    assert nis_test(np.zeros(0), np.zeros(0)) is None


def test_many_runs_are_tested_by_the_spread_between_them() -> None:
    """Closed form for runs of equal length: a t-test of the runs' means."""
    sums, counts = np.array([10.0, 30.0, 20.0, 60.0]), np.full(4, 10.0)
    test = nees_over_runs(sums, counts, 2)
    means = sums / counts
    assert test.mean == pytest.approx(means.mean())
    reach = student_t.ppf(0.975, 3) * means.std(ddof=1) / 2.0
    np.testing.assert_allclose(test.bounds, (2.0 - reach, 2.0 + reach))
    assert test.n_eff == pytest.approx(4.0 / (means.std(ddof=1) / 2.0) ** 2)


def test_runs_without_estimates_count_for_nothing() -> None:
    some = nees_over_runs(np.array([10.0, 30.0]), np.array([10.0, 10.0]), 2)
    more = nees_over_runs(np.array([10.0, 0.0, 30.0]), np.array([10.0, 0.0, 10.0]), 2)
    assert more == some
    with pytest.raises(ValueError, match="at least one estimate"):
        nees_over_runs(np.zeros(2), np.zeros(2), 2)


def test_one_run_counts_as_one_value() -> None:
    test = nees_over_runs(np.array([30.0]), np.array([10.0]), 2)
    assert (test.mean, test.n_eff) == (3.0, 1.0)
    np.testing.assert_allclose(test.bounds, chi2.ppf([0.025, 0.975], 2))


@pytest.mark.parametrize("phi", [0.0, 0.9, 0.99])
def test_bounds_over_runs_hold_95_percent_of_consistent_filters(phi: float) -> None:
    """Runs of 50 to 300 errors with correlation within each; 100 runs a trial, 1500 trials."""
    rng = np.random.default_rng(1)
    runs, trials, longest = 100, 1500, 300
    x = rng.normal(size=(2, 4000))
    paths = [x]
    for _ in range(longest - 1):
        paths.append(phi * paths[-1] + np.sqrt(1 - phi**2) * rng.normal(size=x.shape))
    cumulated = np.cumsum([(p**2).sum(axis=0) for p in paths], axis=0)
    kept = 0
    for _ in range(trials):
        chosen, counts = rng.integers(4000, size=runs), rng.integers(50, longest + 1, runs)
        kept += nees_over_runs(cumulated[counts - 1, chosen], counts.astype(float), 2).consistent
    assert 0.93 <= kept / trials <= 0.97
