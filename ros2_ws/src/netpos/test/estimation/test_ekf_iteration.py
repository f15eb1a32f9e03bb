"""Iterated updates: the most probable state, its map_cost, gates where the model bends."""

from __future__ import annotations

import numpy as np
import pytest
from curved_rows import log_posterior_cost, range_problem
from ekf_update import fused, iterated
from filter_rows import row
from netpos.estimation.measurement import (
    VALUE,
    VARIANCE,
    Kind,
    linearise,
)
from netpos.messages.values import Array
from scipy.optimize import least_squares


@pytest.mark.parametrize("seed", range(5))
def test_iteration_finds_the_most_probable_state(seed: int) -> None:
    """SciPy's minimiser of the same cost, and its curvature at the minimum, are the oracle."""
    mean, cov, rows = range_problem(seed)
    x, P = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), 30)
    L = np.linalg.inv(np.linalg.cholesky(cov))

    def residuals(state: Array) -> Array:
        innovation, _ = linearise(rows, state, 0.0)
        return np.concatenate([L @ (state - mean), innovation / np.sqrt(rows[:, VARIANCE])])

    best = least_squares(residuals, mean, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(x, best.x, atol=0.011 * np.sqrt(np.diag(P)).max())
    np.testing.assert_allclose(P, np.linalg.inv(best.jac.T @ best.jac), rtol=0.05, atol=2e-3)


def test_one_iteration_is_the_extended_kalman_update() -> None:
    mean, cov, rows = range_problem(0)
    innovation, H = linearise(rows, mean, 0.0)
    expected = fused(mean, cov, innovation, H, rows[:, VARIANCE].copy())
    for iterations in (0, 1):
        x, P = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), iterations)
        np.testing.assert_array_equal(x, expected[0])
        np.testing.assert_array_equal(P, expected[1])


def test_two_iterations_linearise_once_more_at_the_result() -> None:
    mean, cov, rows = range_problem(1)
    mean, cov = np.array([7.0, 6.9, 1.0, 0, 0, 0]), cov / 30.0
    variance = rows[:, VARIANCE].copy()
    innovation, H = linearise(rows, mean, 0.0)
    first, *_ = fused(mean, cov, innovation, H, variance)
    assert log_posterior_cost(rows, mean, cov, 0.0, first) < log_posterior_cost(
        rows, mean, cov, 0.0, mean
    )  # no halving in this example
    innovation, H = linearise(rows, first, 0.0)
    # Gauss-Newton on the information form
    information = np.linalg.inv(cov) + H.T @ np.diag(1 / variance) @ H
    gradient = H.T @ (innovation / variance) - np.linalg.solve(cov, first - mean)
    second = first + np.linalg.solve(information, gradient)
    x, P = iterated(mean, cov, rows, variance, 2)
    np.testing.assert_allclose(x, second, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(P, np.linalg.inv(information), rtol=1e-7, atol=1e-11)


@pytest.mark.parametrize("seed", range(200))
def test_iterating_never_ends_less_probable_than_the_ekf_or_the_prior(seed: int) -> None:
    rng = np.random.default_rng(seed * 15)
    A = rng.normal(size=(6, 6)) * rng.uniform(0.5, 8)
    mean, cov = rng.normal(size=6) * np.array([20.0, 20, 2, 2, 10, 1]), A @ A.T + 0.1 * np.eye(6)
    truth = mean + np.linalg.cholesky(cov) @ rng.normal(size=6)
    kinds = [Kind(int(k)) for k in rng.integers(4, size=3)]
    rows = np.array(
        [row(k, 0.0, 1e-4 if k < 2 else 0.01, 0, rng.normal(size=3) * [20, 20, 2]) for k in kinds]
    )
    rows[:, VALUE] -= linearise(rows, truth, 0.0)[0]
    variance = rows[:, VARIANCE].copy()
    plain, _ = iterated(mean, cov, rows, variance, 1)
    best = min(log_posterior_cost(rows, mean, cov, 0.0, x) for x in (mean, plain))
    x, _ = iterated(mean, cov, rows, variance, 8)
    assert log_posterior_cost(rows, mean, cov, 0.0, x) <= best * (1 + 1e-6) + 0.05


def iterate_by_the_rule(
    mean: Array, cov: Array, rows: Array, iterations: int
) -> tuple[Array, Array, list[int]]:
    """The rule of ``iterate`` in the information form; also the halvings of each step."""
    precision = np.linalg.inv(cov)

    def cost(x: Array) -> float:
        return log_posterior_cost(rows, mean, cov, 0.0, x)

    last, halvings = mean, []
    P = cov
    for iteration in range(iterations):
        innovation, H = linearise(rows, last, 0.0)
        P = np.linalg.inv(precision + H.T @ np.diag(1 / rows[:, VARIANCE]) @ H)
        x = last + P @ (H.T @ (innovation / rows[:, VARIANCE]) - precision @ (last - mean))
        if iterations == 1:
            return x, P, []
        trials = [last + (x - last) / 2**k for k in range(7)]
        downhill = [k for k, trial in enumerate(trials) if cost(trial) <= cost(last)]
        if not downhill:
            return last, P, [*halvings, 7]
        halvings.append(downhill[0])
        x = trials[downhill[0]]
        if iteration == iterations - 1:
            return x, P, halvings
        if downhill[0] == 0 and np.all(np.abs(x - last) < 0.01 * np.sqrt(np.diag(P))):
            return x, P, halvings
        last = x
    return last, P, halvings


def hard_problem(seed: int) -> tuple[Array, Array, Array]:
    """Angles and ranges around a wide, correlated prior, with RSUs in its midst."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6)) * rng.uniform(0.5, 4)
    mean, cov = rng.normal(size=6) * np.array([5.0, 5, 2, 2, 10, 1]), A @ A.T + 0.1 * np.eye(6)
    truth = mean + np.linalg.cholesky(cov) @ rng.normal(size=6)
    kinds = [Kind(int(k)) for k in rng.integers(4, size=2)]
    rows = np.array(
        [row(k, 0.0, 1e-3 if k < 2 else 0.04, 0, rng.normal(size=3) * [5, 5, 2]) for k in kinds]
    )
    rows[:, VALUE] -= linearise(rows, truth, 0.0)[0]
    return mean, cov, rows


@pytest.mark.parametrize("iterations", [1, 2, 3, 8])
def test_iterations_follow_the_rule(iterations: int) -> None:
    """Full steps, halved steps, steps given up: the kernel and the rule agree on all of them."""
    seen = set()
    for seed in range(150):
        mean, cov, rows = hard_problem(seed)
        expected, P_expected, halvings = iterate_by_the_rule(mean, cov, rows, iterations)
        x, P = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), iterations)
        sd = np.sqrt(np.diag(P_expected))
        np.testing.assert_allclose((x - expected) / sd, 0.0, atol=1e-5, err_msg=str(seed))
        np.testing.assert_allclose(P / np.outer(sd, sd), P_expected / np.outer(sd, sd), atol=1e-5)
        seen |= set(halvings)
    if iterations > 1:
        assert {0, 1, 2} <= seen
    if iterations == 8:
        assert max(seen) >= 6
