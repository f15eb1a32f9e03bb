"""How well a state fits: distances and misfits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from curved_rows import log_posterior_cost, range_problem
from filter_rows import random_spd
from netpos.filters import fit
from netpos.filters.measurement import VARIANCE, curvature_variance, linearise


@pytest.mark.parametrize("seed", range(5))
def test_distance2_is_the_mahalanobis_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cov, d = random_spd(rng, 7), rng.normal(size=7)
    before = cov.copy(), d.copy()
    assert fit.distance2(cov, d) == pytest.approx(d @ np.linalg.inv(cov) @ d, rel=1e-9)
    np.testing.assert_array_equal(cov, before[0])
    np.testing.assert_array_equal(d, before[1])


def test_distance2_leaves_out_what_is_known_exactly() -> None:
    """A perfect clock has zero rows; two states that always agree are one."""
    assert fit.distance2(np.diag([4.0, 0.0, 9.0]), np.array([2.0, 0.0, 6.0])) == 5.0
    same = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
    assert fit.distance2(same, np.array([2.0, 2.0, 3.0])) == pytest.approx(10.0)


def test_distance2_keeps_the_tiniest_true_variance() -> None:
    cov = np.array([[1e9, 0.5 * math.sqrt(1e-3)], [0.5 * math.sqrt(1e-3), 1e-12]])
    d = np.array([1e3, 2e-6])
    sd = np.sqrt(np.diag(cov))
    correlation = cov / np.outer(sd, sd)
    assert fit.distance2(cov, d) == pytest.approx(
        (d / sd) @ np.linalg.inv(correlation) @ (d / sd), rel=1e-9
    )


@pytest.mark.parametrize("seed", range(5))
def test_misfit_is_twice_the_negative_log_posterior(seed: int) -> None:
    mean, cov, rows = range_problem(seed)
    x = mean + np.random.default_rng(seed).normal(size=6)
    expected = log_posterior_cost(rows, mean, cov, 0.0, x)
    assert fit.misfit(mean, cov, rows, rows[:, VARIANCE].copy(), 0.0, x) == pytest.approx(
        expected, rel=1e-9
    )


def test_surprise_is_what_scipy_makes_of_it() -> None:
    mean, cov, rows = range_problem(3)
    innovation, H = linearise(rows, mean, 0.0)
    bent = [curvature_variance(row, mean, cov, 0.0) for row in rows]
    S = H @ cov @ H.T + np.diag(rows[:, VARIANCE] + bent)
    distance, size = fit.surprise(mean, cov, rows, 0.0)
    assert distance == pytest.approx(innovation @ np.linalg.solve(S, innovation), rel=1e-9)
    assert size == pytest.approx(np.linalg.slogdet(2.0 * np.pi * S)[1], rel=1e-9)
