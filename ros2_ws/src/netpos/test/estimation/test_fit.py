"""How well a state fits: distances and costs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from curved_rows import bends, log_posterior_cost, range_problem, values_of_a_bend
from filter_rows import random_spd
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    GATE_VARIANCE,
    HEADING,
    KIND,
    ORIGIN,
    ROW_WIDTH,
    SAME_BEND,
    VALUE,
    VARIANCE,
    Kind,
    curvature_variance,
    linearise,
    second_order_variance,
)
from netpos.estimation.state import POSITION
from netpos.estimation.update import fit
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array


def neg2_log_likelihood(mean: Array, cov: Array, rows: Array) -> tuple[float, float]:
    """Of all rows."""
    predicted, index = predicted_rows(mean, cov, rows, 0.0), np.arange(len(rows))
    found: tuple[float, float] = fit.neg2_log_likelihood(mean, cov, rows, 0.0, predicted, index)
    return found


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
    assert fit.map_cost(mean, cov, rows, rows[:, VARIANCE].copy(), 0.0, x) == pytest.approx(
        expected, rel=1e-9
    )


@pytest.mark.parametrize("more", [0.0, 3.0])
def test_surprise_is_what_scipy_makes_of_it(more: float) -> None:
    """What linearising leaves out: shared with ``more`` values in the distance, and that of a
    single value in the determinant."""
    mean, cov, rows = range_problem(3)
    rows[:, SAME_BEND] = more
    innovation, H = linearise(rows, mean, 0.0)
    innovation -= bends(mean, cov, rows)
    bent = np.array([second_order_variance(row, mean, cov, 0.0) for row in rows])
    single = H @ cov @ H.T + np.diag(rows[:, VARIANCE] + bent)
    S = single + np.diag((values_of_a_bend(mean, rows) - 1.0) * bent)
    distance, size = neg2_log_likelihood(mean, cov, rows)
    assert distance == pytest.approx(innovation @ np.linalg.solve(S, innovation), rel=1e-9)
    assert size == pytest.approx(np.linalg.slogdet(2.0 * np.pi * single)[1], rel=1e-9)


def test_a_bearing_does_not_bend_along_itself() -> None:
    """The Hessian by central differences; ranges and tilted arrays as at their largest."""
    mean, cov = np.array([4.0, -3.0, 0.0, 0.0, 0.0, 0.0]), random_spd(np.random.default_rng(4), 6)
    row = np.zeros((1, ROW_WIDTH))
    row[0, VALUE], row[0, VARIANCE], row[0, GATE_VARIANCE] = -0.6, 1e-4, 1e-4
    row[0, BIAS] = row[0, COMMON] = row[0, HEADING] = -1.0
    row[0, ORIGIN : ORIGIN + 2] = 1.0, 0.5
    row[0, AXES : AXES + 9] = np.eye(3).ravel()

    def azimuth(x: float, y: float) -> float:
        return math.atan2(y - 0.5, x - 1.0)

    e, hessian = 1e-4 * np.eye(2), np.empty((2, 2))
    for i, j in np.ndindex(2, 2):
        corners = [
            a * b * azimuth(*(mean[POSITION] + a * e[i] + b * e[j]))
            for a in (1, -1)
            for b in (1, -1)
        ]
        hessian[i, j] = sum(corners) / 4e-8
    bent = hessian @ cov[POSITION, POSITION]
    _, gradient = linearise(row, mean, 0.0)
    S = gradient[0] @ cov @ gradient[0] + 1e-4 + 0.5 * np.trace(bent @ bent)
    innovation = -0.6 - azimuth(4.0, -3.0)
    distance, size = neg2_log_likelihood(mean, cov, row)
    assert distance == pytest.approx(innovation**2 / S, rel=1e-5)
    assert size == pytest.approx(math.log(2.0 * math.pi * S), rel=1e-5)
    at_most = curvature_variance(row[0], mean, cov, 0.0)
    assert second_order_variance(row[0], mean, cov, 0.0) < at_most
    row[0, AXES + 8] = 0.9
    at_most = curvature_variance(row[0], mean, cov, 0.0)
    assert second_order_variance(row[0], mean, cov, 0.0) == at_most
    mean, cov, rows = range_problem(3)
    ranges = rows[rows[:, KIND] == Kind.RANGE]
    assert len(ranges) > 0
    for row in ranges:
        at_most = curvature_variance(row, mean, cov, 0.0)
        assert second_order_variance(row, mean, cov, 0.0) == at_most


def test_rows_that_are_left_out_say_nothing() -> None:
    mean, cov, rows = range_problem(3)
    predicted = predicted_rows(mean, cov, rows, 0.0)
    some = fit.neg2_log_likelihood(mean, cov, rows, 0.0, predicted, np.array([0, 2]))
    assert some == pytest.approx(neg2_log_likelihood(mean, cov, rows[[0, 2]]), rel=1e-12)
