"""Fusion of the extended Kalman filter."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ekf_update import exact_fuse, fused, updated
from filter_rows import NO_GATE, linear_row, random_spd
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import (
    GROUP,
    VALUE,
)
from netpos.estimation.state import X
from netpos.estimation.update import fusion


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("m", [1, 2, 5])
@pytest.mark.parametrize("n", [6, 7, 9])
def test_fuse_equals_the_information_form(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=n), random_spd(rng, n)
    H, R, nu = rng.normal(size=(m, n)), rng.uniform(0.1, 3.0, m), rng.normal(size=m)
    mean, cov, distance = fused(x, P, nu, H, R)
    information = np.linalg.inv(P) + H.T @ np.diag(1 / R) @ H
    np.testing.assert_allclose(cov, np.linalg.inv(information), rtol=1e-8, atol=1e-11)
    step = np.linalg.solve(information, H.T @ (nu / R))
    np.testing.assert_allclose(mean, x + step, rtol=1e-8, atol=1e-11)
    np.testing.assert_array_equal(cov, cov.T)
    S = H @ P @ H.T + np.diag(R)
    assert distance == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_six_states_are_fused_as_any_number_is(seed: int) -> None:
    """The kernel made for six states against the general one: a seventh that has no part in it."""
    rng = np.random.default_rng(seed)
    x, P, H, nu = rng.normal(size=7), np.eye(7), np.zeros((4, 7)), rng.normal(size=4)
    P[:6, :6], H[:, :6], R = random_spd(rng, 6), rng.normal(size=(4, 6)), rng.uniform(0.1, 1, 4)
    mean, cov, distance = fused(x[:6].copy(), P[:6, :6].copy(), nu, H[:, :6].copy(), R)
    wide_mean, wide_cov, wide_distance = fused(x, P, nu, H, R)
    np.testing.assert_allclose(mean, wide_mean[:6], rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(cov, wide_cov[:6, :6], rtol=1e-14, atol=1e-15)
    assert distance == pytest.approx(wide_distance, rel=1e-14)
    np.testing.assert_array_equal(wide_cov[6], np.eye(7)[6])
    assert wide_mean[6] == x[6]


@pytest.mark.parametrize("n", [6, 8])
def test_fuse_leaves_out_what_is_not_to_be_used(n: int) -> None:
    rng = np.random.default_rng(4)
    x, P = rng.normal(size=n), random_spd(rng, n)
    H, R, nu = rng.normal(size=(4, n)), rng.uniform(0.1, 3.0, 4), rng.normal(size=4)
    mean, cov, work = x.copy(), P.copy(), ekf.workspace(n, 4)
    assert ekf.fuse(mean, cov, nu, H, R, np.zeros(4), work) == 0.0
    np.testing.assert_array_equal(mean, x)  # bit for bit
    np.testing.assert_array_equal(cov, P)
    distance = ekf.fuse(mean, cov, nu, H, R, np.array([0.0, 1.0, 0.0, 1.0]), work)
    expected = fused(x, P, nu[1::2].copy(), H[1::2].copy(), R[1::2].copy())
    np.testing.assert_array_equal(mean, expected[0])
    np.testing.assert_array_equal(cov, expected[1])
    assert distance == expected[2]


@pytest.mark.parametrize("order", [1, -1])
def test_fuse_stays_positive_definite_when_ill_conditioned(order: int) -> None:
    """Prior variances from 1e-3 to 1e9, measurement variances from 1e-3 to 1e3, 200 times."""
    rng = np.random.default_rng(8)
    P, x = np.diag([1e9, 1e9, 1.0, 1.0, 1e9, 1e-3][::order]), np.zeros(6)
    for _ in range(200):
        H = rng.normal(size=(2, 6))
        x, P, _ = fused(x, P, rng.normal(size=2) * 1e-4, H, np.array([1e-3, 1e3]))
        np.testing.assert_array_equal(P, P.T)
        np.linalg.cholesky(P)
    assert np.isfinite(x).all()


@pytest.mark.parametrize("seed", range(3))
def test_first_update_of_an_unknown_clock_is_exact(seed: int) -> None:
    """100 us of clock (3e4 m) against a TOA of 1 cm: 13 orders of magnitude, to rounding."""
    rng = np.random.default_rng(seed)
    F = np.eye(6)
    F[X.PX, X.VX] = F[X.PY, X.VY] = F[X.CLOCK, X.DRIFT] = 0.1
    P = F @ np.diag([25.0, 25.0, 25.0, 25.0, 9e8, 8.1e7]) @ F.T
    P = (P + P.T) / 2
    H = np.zeros((4, 6))
    H[:, :2] = rng.normal(size=(4, 2))
    H[2:, 4] = 1.0
    R = np.array([1e-3, 1e-3, 1e-4, 1e-4])
    nu = np.array([0.1, -0.1, 2e4 + 0.3, 2e4 - 0.2])
    x = rng.normal(size=6)
    mean, cov, _ = fused(x, P, nu, H, R)
    expected_mean, expected_cov = exact_fuse(x, P, nu, H, R)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-8, atol=5e-6)
    sd = np.sqrt(np.diag(expected_cov))
    np.testing.assert_allclose(cov / np.outer(sd, sd), expected_cov / np.outer(sd, sd), atol=1e-3)
    np.linalg.cholesky(cov)


@pytest.mark.parametrize("seed", [12, 35, 105, 133])
def test_update_of_what_rounding_makes_indefinite_is_exact(seed: int) -> None:
    """Sds up to 1e6 and correlations near 1: row by row the covariance ends indefinite, and a
    correlation is off by up to 1; on its factor it is right."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-1, 6, 6)
    A = rng.normal(size=(6, 2))
    P = (A @ A.T + 1e-8 * np.eye(6)) * np.outer(scale, scale)
    P = (P + P.T) / 2
    H, R, x = rng.normal(size=(3, 6)), 10.0 ** rng.uniform(-6, -2, 3), rng.normal(size=6)
    nu = H @ np.linalg.cholesky(P) @ rng.normal(size=6)
    rows = [linear_row(h, v, r, 0) for h, v, r in zip(H, nu + H @ x, R, strict=True)]
    # A row that is rejected must not enter on this way either.
    rows = np.array([linear_row(H[0], 1e15, 1.0, 0), *rows])
    rows[1:, GROUP] = 1
    mean, cov, accepted, _, used = updated(x, P, rows, 0.0, np.array([0, 9.0, 99.0]), 1)
    assert (accepted.tolist(), used) == ([0.0, 1.0], 3)
    expected_mean, expected_cov = exact_fuse(x, P, rows[1:, VALUE] - H @ x, H, R)
    sd = np.sqrt(np.diag(expected_cov))
    np.testing.assert_allclose((mean - expected_mean) / sd, 0.0, atol=1e-5)
    correlation, expected = cov / np.outer(sd, sd), expected_cov / np.outer(sd, sd)
    np.testing.assert_allclose(correlation, expected, atol=1e-5)
    np.testing.assert_array_equal(cov, cov.T)


@pytest.mark.parametrize("n", [6, 8])
def test_no_update_is_off_by_what_rounding_loses(n: int) -> None:
    """As above, most of which row by row end definite, and of those some off by 0.1 sd."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        scale = 10.0 ** rng.uniform(-1, 6, n)
        A = rng.normal(size=(n, 2))
        P = (A @ A.T + 1e-8 * np.eye(n)) * np.outer(scale, scale)
        P = (P + P.T) / 2
        H, R, x = np.zeros((3, n)), 10.0 ** rng.uniform(-6, -2, 3), rng.normal(size=n)
        H[:, :6] = rng.normal(size=(3, 6))
        nu = H @ np.linalg.cholesky(P) @ rng.normal(size=n)
        rows = [linear_row(h[:6], v, r, 0) for h, v, r in zip(H, nu + H @ x, R, strict=True)]
        mean, cov, *_ = updated(x, P, np.array(rows), 0.0, NO_GATE, 1)
        expected_mean, expected_cov = exact_fuse(x, P, np.array(rows)[:, VALUE] - H @ x, H, R)
        sd = np.sqrt(np.diag(expected_cov))
        np.testing.assert_allclose((mean - expected_mean) / sd, 0.0, atol=1e-5)
        correlation, expected = cov / np.outer(sd, sd), expected_cov / np.outer(sd, sd)
        np.testing.assert_allclose(correlation, expected, atol=1e-5)


@pytest.mark.parametrize("iterations", [1, 8])
def test_what_is_known_exactly_stays_so(iterations: int) -> None:
    """A perfect clock: no variance, and a TOA is a range."""
    x, P = np.zeros(6), np.diag([4.0, 9.0, 1.0, 1.0, 0.0, 0.0])
    h = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    mean, cov, *_ = updated(x, P, linear_row(h, 1.0, 1.0, 0)[None], 0.0, NO_GATE, iterations)
    np.testing.assert_allclose(mean, [0.8, 0, 0, 0, 0, 0], rtol=1e-14)
    np.testing.assert_allclose(cov, np.diag([0.8, 9.0, 1.0, 1.0, 0.0, 0.0]), rtol=1e-14)


def test_a_covariance_is_definite_up_to_a_correlation_of_one() -> None:
    P, work = np.diag([4.0, 9.0, 1.0]), ekf.workspace(3, 2)
    for value, definite in ((5.999, True), (6.0 + 1e-9, False), (-5.999, True), (-6.1, False)):
        P[X.PX, X.PY] = P[X.PY, X.PX] = value
        before = P.copy()
        assert fusion.is_definite(P, work) is definite
        np.testing.assert_array_equal(P, before)
    for i, value in ((0, 0.0), (2, -1e-9), (1, math.nan)):
        Q = np.eye(3)
        Q[i, i] = value
        assert not fusion.is_definite(Q, work)
    # no pair is at odds, all three together are
    Q = np.array([[1.0, -0.6, -0.6], [-0.6, 1.0, -0.6], [-0.6, -0.6, 1.0]])
    assert np.linalg.eigvalsh(Q)[0] < 0.0
    assert not fusion.is_definite(Q, work)


@pytest.mark.parametrize("n", [6, 7])
def test_a_variance_has_to_be_more_than_rounding_of_the_prior(n: int) -> None:
    P, work = 2.0 * np.eye(n), ekf.workspace(n, 2)
    for k in (0, n - 1):
        work[fusion.W_COV + k, k] = 1.99e11
        assert fusion.keeps_digits(P, work)
        work[fusion.W_COV + k, k] = 2.01e11
        assert not fusion.keeps_digits(P, work)
        assert fusion.is_definite(P, work)
        work[fusion.W_COV + k, k] = 0.0


def test_a_row_that_says_next_to_nothing_leaves_the_factor_as_it_is() -> None:
    """Potter's denominator does not cancel where a row is worth 1e-12 of the prior."""
    rng = np.random.default_rng(2)
    P, h, x, work = random_spd(rng, 6), rng.normal(size=6), rng.normal(size=6), ekf.workspace(6, 1)
    work[fusion.W_PRIOR], work[fusion.W_COV : fusion.W_COV + 6] = x, P
    work[fusion.W_COV + 6] = h
    work[fusion.W_INNOVATION, 0], work[fusion.W_VARIANCE, 0], work[fusion.W_USE, 0] = (
        1.0,
        1e12,
        1.0,
    )
    mean, cov = np.empty(6), np.empty((6, 6))
    fusion.fuse_by_factor(mean, cov, 1, work)
    Ph, s = P @ h, h @ P @ h + 1e12
    np.testing.assert_allclose(cov, P - np.outer(Ph, Ph) / s, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(mean, x + Ph / s, rtol=1e-9)


def test_joseph_form_survives_where_the_short_form_fails() -> None:
    """The same precise value ten times: the variance ends at r / 10, never at 0 or below."""
    P, x = np.diag([1e9] * 6), np.zeros(6)
    H = np.array([[1.0, 0, 0, 0, 0, 0]])
    for _ in range(10):
        x, P, _ = fused(x, P, np.array([1.0]) - H @ x, H, np.array([1e-9]))
    assert P[X.PX, X.PX] == pytest.approx(1e-10, rel=1e-6)
    assert x[X.PX] == pytest.approx(1.0, rel=1e-12)


def test_group_nis_is_the_full_mahalanobis_distance() -> None:
    rng = np.random.default_rng(3)
    P, H, R, nu = (
        random_spd(rng, 6),
        rng.normal(size=(3, 6)),
        rng.uniform(1, 2, 3),
        rng.normal(size=3),
    )
    S = H @ P @ H.T + np.diag(R)
    assert ekf.group_nis(P, nu, H, R) == pytest.approx(nu @ np.linalg.inv(S) @ nu, rel=1e-10)
