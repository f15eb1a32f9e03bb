"""Cholesky factors, also of singular covariances, and eigenvalues against NumPy's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from filter_rows import random_spd
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.estimation.factor import (
    eigenvalues,
    factor,
    factor_in_place,
    inverse,
    solve,
    solve_factored,
    solve_lower,
)
from scipy import linalg


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
@pytest.mark.parametrize("seed", range(3))
def test_factor_is_numpys(seed: int, scale: float) -> None:
    """Of whatever size; what lies above the diagonal is zero to the bit."""
    P = scale * random_spd(np.random.default_rng(seed), 7)
    before = P.copy()
    L = factor(P)
    root = np.sqrt(np.diag(P))[:, None]
    np.testing.assert_allclose(L / root, np.linalg.cholesky(P) / root, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(L, np.tril(L))
    np.testing.assert_array_equal(P, before)


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
@pytest.mark.parametrize(("excess", "known"), [(0.9e-14, True), (1.1e-14, False)])
def test_a_pivot_of_rounding_is_known_exactly(excess: float, known: bool, scale: float) -> None:
    """Two states that agree but for a share of 1e-14; a third that follows both, and its own."""
    P = scale * np.array([[1.0, 1.0, 0.5], [1.0, 1.0 / (1.0 - excess), 0.5], [0.5, 0.5, 2.0]])
    L = factor(P)
    assert bool(L[1, 1] == 0.0) is known
    if known:
        np.testing.assert_array_equal(L[:, 1], 0.0)
    np.testing.assert_allclose(L @ L.T, P, rtol=2e-14)


def test_what_is_known_exactly_has_a_zero_column() -> None:
    """A row and a column of zeros among others: the rest is the factor without them."""
    rest = random_spd(np.random.default_rng(5), 4)
    P = np.zeros((5, 5))
    others = [0, 1, 3, 4]
    P[np.ix_(others, others)] = rest
    L = factor(P)
    np.testing.assert_array_equal(L[2], 0.0)
    np.testing.assert_array_equal(L[:, 2], 0.0)
    np.testing.assert_allclose(L[np.ix_(others, others)], np.linalg.cholesky(rest), rtol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_a_factor_in_place_leaves_and_needs_nothing_above_the_diagonal(seed: int) -> None:
    """The rest of the matrix stays, and half of a solution does not read it: SciPy's."""
    rng = np.random.default_rng(seed)
    S, B = random_spd(rng, 5), rng.normal(size=(5, 3))
    A, X = np.tril(S) + np.triu(np.full((5, 5), 7.0), 1), B.copy()
    factor_in_place(A)
    solve_lower(A, X)
    np.testing.assert_array_equal(np.tril(A), factor(S))
    np.testing.assert_array_equal(A[np.triu_indices(5, 1)], 7.0)
    expected = linalg.solve_triangular(np.linalg.cholesky(S), B, lower=True)
    np.testing.assert_allclose(X, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_solution_is_numpys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S, B = random_spd(rng, 5), rng.normal(size=(5, 3))
    X = B.copy()
    solve_factored(np.linalg.cholesky(S), X)
    np.testing.assert_allclose(X, np.linalg.solve(S, B), rtol=1e-9, atol=1e-12)


def test_along_what_is_known_exactly_the_solution_is_zero() -> None:
    """The rest is solved as if it were not there."""
    rng = np.random.default_rng(4)
    rest, B = random_spd(rng, 3), rng.normal(size=(4, 2))
    others = [0, 2, 3]
    L = np.zeros((4, 4))
    L[np.ix_(others, others)] = np.linalg.cholesky(rest)
    X = B.copy()
    solve_factored(L, X)
    np.testing.assert_array_equal(X[1], 0.0)
    np.testing.assert_allclose(X[others], np.linalg.solve(rest, B[others]), rtol=1e-9)


@settings(max_examples=200, deadline=None)
@given(*[st.floats(-1e6, 1e6)] * 3)
def test_eigenvalues_of_any_symmetric_matrix(xx: float, xy: float, yy: float) -> None:
    scale = max(abs(xx), abs(xy), abs(yy))
    expected = np.linalg.eigvalsh(np.array([[xx, xy], [xy, yy]]))
    np.testing.assert_allclose(eigenvalues(xx, xy, yy), expected, atol=1e-14 * scale + 1e-150)


def test_a_small_eigenvalue_beside_a_large_one_keeps_its_digits() -> None:
    """Of R diag(1, 1e-9) R', with R a turn by 0.3 rad."""
    c, s, small = math.cos(0.3), math.sin(0.3), 1e-9
    matrix = c * c + s * s * small, c * s * (1 - small), s * s + c * c * small
    found = eigenvalues(*matrix)
    np.testing.assert_allclose(found, [small, 1.0], rtol=1e-6)


def test_eigenvalues_of_a_negative_matrix_keep_their_order() -> None:
    assert eigenvalues(-3.0, 0.0, -1.0) == (-3.0, -1.0)
    assert eigenvalues(-0.0, 2.0, -0.0) == (-2.0, 2.0)
    assert eigenvalues(0.0, 0.0, 0.0) == (0.0, 0.0)
    assert eigenvalues(math.inf, 0.0, 1.0)[1] == math.inf


def test_inverse_of_units_that_differ_by_many_orders() -> None:
    rng = np.random.default_rng(1)
    B = rng.normal(size=(6, 6))
    C, sd = B @ B.T + np.eye(6), 10.0 ** np.array([9.0, -9.0, 0.0, 6.0, -6.0, 3.0])
    found = inverse(C * np.outer(sd, sd)) * np.outer(sd, sd)
    np.testing.assert_allclose(found, np.linalg.inv(C), rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("seed", range(3))
def test_one_right_hand_side_is_solved_as_numpy_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, b = random_spd(rng, 5), rng.normal(size=5)
    np.testing.assert_allclose(solve(A, b), np.linalg.solve(A, b), rtol=1e-9, atol=1e-12)


def test_what_is_left_open_has_a_large_inverse_not_a_zero_one() -> None:
    """Only the sum of two numbers is known: their difference is not, though neither is 0."""
    found = inverse(np.array([[4.0, 4.0], [4.0, 4.0]]))
    assert found[0, 0] > 1e10
    assert found.sum() == pytest.approx(0.25, rel=0.1)
