"""Fusion and gating of the extended Kalman filter."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from filter_rows import NO_GATE, linear_row, random_spd
from netpos.filters import ekf, fusion
from netpos.filters.measurement import (
    GATE_VARIANCE,
    GROUP,
    ORIGIN,
    VALUE,
    VARIANCE,
)
from netpos.messages.values import Array
from scipy.stats import chi2


def fused(x: Array, P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array, float]:
    """``ekf.fuse`` of all rows on copies; what is not its own is left alone."""
    mean, cov, inputs = x.copy(), P.copy(), (nu.copy(), H.copy(), R.copy())
    work = np.full_like(ekf.workspace(x.size, nu.size), np.nan)
    distance = ekf.fuse(mean, cov, nu, H, R, np.ones(nu.size), work)
    for given, before in zip((nu, H, R), inputs, strict=True):
        np.testing.assert_array_equal(given, before)
    return mean, cov, distance


def updated(
    x: Array, P: Array, rows: Array, height_m: float, gate: Array, iterations: int
) -> tuple[Array, Array, Array, float, int]:
    """``ekf.update`` on copies, all scratch memory spoiled: mean, cov, accepted, nis, used."""
    mean, cov, before = x.copy(), P.copy(), rows.copy()
    accepted = np.full(int(rows[:, GROUP].max()) + 1, 9.0)
    work = np.full_like(ekf.workspace(x.size + 1, len(rows) + 2), np.nan)
    nis, used = ekf.update(mean, cov, rows, height_m, gate, iterations, accepted, work)
    np.testing.assert_array_equal(rows, before)  # the caller's rows are left alone
    return mean, cov, accepted, nis, used


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


def exact_fuse(x: Array, P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """The batch update in rational arithmetic: no rounding at all."""
    x, P, nu, H, R = (
        np.vectorize(Fraction, otypes=[object])(A) for A in (x, P, nu, H, np.diag(R))
    )
    PH = P @ H.T
    M = np.hstack([H @ PH + R, nu[:, None], PH.T])
    for i in range(len(M)):
        M[i] = M[i] / M[i, i]
        for j in range(len(M)):
            if j != i:
                M[j] = M[j] - M[j, i] * M[i]
    solved = M[:, len(M) :]
    return (x + PH @ solved[:, 0]).astype(float), (P - PH @ solved[:, 1:]).astype(float)


@pytest.mark.parametrize("seed", range(3))
def test_first_update_of_an_unknown_clock_is_exact(seed: int) -> None:
    """100 us of clock (3e4 m) against a TOA of 1 cm: 13 orders of magnitude, to rounding."""
    rng = np.random.default_rng(seed)
    F = np.eye(6)
    F[0, 2] = F[1, 3] = F[4, 5] = 0.1
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
        P[0, 1] = P[1, 0] = value
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
    assert P[0, 0] == pytest.approx(1e-10, rel=1e-6)
    assert x[0] == pytest.approx(1.0, rel=1e-12)


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


def two_states() -> tuple[Array, Array]:
    return np.zeros(6), np.diag([4.0, 9.0, 1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize("iterations", [1, 8])
@pytest.mark.parametrize(("factor", "accepted"), [(1 - 1e-9, True), (1 + 1e-9, False)])
@pytest.mark.parametrize("dof", [1, 2, 3])
def test_gate_at_its_boundary(dof: int, factor: float, accepted: bool, iterations: int) -> None:
    """A group whose squared distance is just inside or just outside the quantile."""
    mean, cov = two_states()
    gate = np.append(0.0, chi2.ppf(0.99, np.arange(1, 4)))
    value = math.sqrt(gate[dof] * factor * (4.0 + 0.5))  # only the first row is off
    rows = np.array([linear_row(np.eye(6)[i], value * (i == 0), 0.5, 0) for i in range(dof)])
    x, P, taken, nis, used = updated(mean, cov, rows, 0.0, gate, iterations)
    assert bool(taken[0]) is accepted
    assert used == (dof if accepted else 0)
    if accepted:
        assert nis == pytest.approx(gate[dof])
        assert x[0] > 0.0
    else:
        assert nis == 0.0
        np.testing.assert_array_equal(x, mean)
        np.testing.assert_array_equal(P, cov)


def test_gate_has_one_threshold_per_number_of_rows_and_the_last_for_more() -> None:
    mean, cov = np.zeros(6), np.eye(6)
    rows = np.array([linear_row(np.eye(6)[i], 2.0, 1.0, 0) for i in range(4)])  # NIS 2 per row
    for gate, accepted in (([0, 0, 0, 8.1], 1.0), ([0, 0, 0, 7.9], 0.0), ([0, 9, 9, 9, 7.9], 0.0)):
        assert updated(mean, cov, rows, 0.0, np.array(gate, float), 1)[2].tolist() == [accepted]


def test_every_group_has_the_threshold_of_its_own_size() -> None:
    mean, cov = np.zeros(6), np.eye(6)
    sizes = (1, 2, 1)  # NIS 2 per row
    rows = [
        linear_row(np.eye(6)[i], 2.0, 1.0, group)
        for i, group in enumerate(g for g, size in enumerate(sizes) for _ in range(size))
    ]
    for gate, taken in (([0, 2.1, 3.9, 99], [1, 0, 1]), ([0, 1.9, 4.1, 99], [0, 1, 0])):
        result = updated(mean, cov, np.array(rows), 0.0, np.array(gate, float), 1)
        assert result[2].tolist() == taken


def test_gate_looks_at_the_gate_variance_and_the_update_at_the_variance() -> None:
    mean, cov = np.zeros(6), np.eye(6)
    one = linear_row(np.eye(6)[0], 4.0, 99.0, 0)
    one[GATE_VARIANCE] = 3.0
    gate = np.array([0.0, 4.001])
    x, P, taken, nis, _ = updated(mean, cov, one[None], 0.0, gate, 1)
    assert taken.tolist() == [1.0]
    assert nis == pytest.approx(16 / 4)
    assert x[0] == pytest.approx(4.0 / 100)
    assert P[0, 0] == pytest.approx(99 / 100)
    gate[1] = 3.999
    assert updated(mean, cov, one[None], 0.0, gate, 8)[2].tolist() == [0.0]


@pytest.mark.parametrize("iterations", [1, 8])
@pytest.mark.parametrize("bad", [0, 1, 2])
def test_a_group_is_rejected_as_a_whole_and_alone(bad: int, iterations: int) -> None:
    """The rejected group's good row must not enter; the other groups' rows must."""
    mean, cov = two_states()
    gate = np.append(0.0, chi2.ppf(0.999, np.arange(1, 4)))
    rows = []
    for group in range(3):
        off = 100.0 if group == bad else 0.1
        rows.append(linear_row(np.eye(6)[2 * group], 0.2, 0.5, group))
        rows.append(linear_row(np.eye(6)[2 * group + 1], off, 0.5, group))
    x, _, taken, nis, used = updated(mean, cov, np.array(rows), 0.0, gate, iterations)
    assert taken.tolist() == [float(g != bad) for g in range(3)]
    kept = np.array([r for r in rows if r[GROUP] != bad])
    assert used == 4
    expected = updated(mean, cov, _renumbered(kept), 0.0, NO_GATE, iterations)
    np.testing.assert_array_equal(x, expected[0])
    assert nis == expected[3]
    np.testing.assert_array_equal(x[2 * bad : 2 * bad + 2], 0.0)


def _renumbered(rows: Array) -> Array:
    rows = rows.copy()
    rows[:, GROUP] = np.unique(rows[:, GROUP], return_inverse=True)[1]
    return rows


def test_groups_may_differ_in_size_and_their_order_does_not_matter() -> None:
    mean, cov = two_states()
    cov[0, 1] = cov[1, 0] = 2.0
    a = [linear_row(np.eye(6)[0], 1.0, 0.5, 0)]
    b = [linear_row(np.eye(6)[1], v, 0.7, 1) for v in (-0.5, 0.3, 0.4)]
    forward = updated(mean, cov, np.array(a + b), 0.0, NO_GATE, 1)
    swapped = [r.copy() for r in b + a]
    for r in swapped:
        r[GROUP] = 1 - r[GROUP]
    backward = updated(mean, cov, np.array(swapped), 0.0, NO_GATE, 1)
    np.testing.assert_allclose(forward[0], backward[0], rtol=1e-12)
    np.testing.assert_allclose(forward[1], backward[1], rtol=1e-12, atol=1e-15)
    assert forward[3] == pytest.approx(backward[3], rel=1e-12)
    assert forward[2].tolist() == backward[2].tolist() == [1.0, 1.0]


def coloured_rows(rng: np.random.Generator, sizes: tuple[int, ...]) -> Array:
    """Linear rows in groups of the given sizes with random values, variances, gate variances."""
    groups = [g for g, size in enumerate(sizes) for _ in range(size)]
    rows = [linear_row(rng.normal(size=6), rng.normal(), rng.uniform(1, 3), g) for g in groups]
    out = np.array(rows)
    out[:, GATE_VARIANCE] = out[:, VARIANCE] * rng.uniform(0.2, 0.9, len(rows))
    return out


def distance_by_numpy(x: Array, P: Array, rows: Array, column: int) -> float:
    """Squared Mahalanobis distance of linear rows with the variances in ``column``."""
    H = rows[:, ORIGIN : ORIGIN + 6]
    S = H @ P @ H.T + np.diag(rows[:, column])
    nu = rows[:, VALUE] - H @ x
    return float(nu @ np.linalg.inv(S) @ nu)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("iterations", [1, 8])
@pytest.mark.parametrize("coloured", [(), (0,), (1, 2), (0, 1, 2)])
@pytest.mark.parametrize("rejected", [None, 0, 2])
def test_nis_is_that_of_the_gate_variances_of_what_was_accepted(
    rejected: int | None, coloured: tuple[int, ...], iterations: int, seed: int
) -> None:
    """Groups of which some have correlated errors; one of them may lie far off."""
    rng = np.random.default_rng(seed)
    x, P, rows = rng.normal(size=6), random_spd(rng, 6), coloured_rows(rng, (1, 4, 2))
    white = ~np.isin(rows[:, GROUP], coloured)
    rows[white, GATE_VARIANCE] = rows[white, VARIANCE]
    if rejected is not None:
        rows[rows[:, GROUP] == rejected, VALUE] += 1e4
    kept = rows[rows[:, GROUP] != (-1 if rejected is None else rejected)]
    gate = np.full(5, 1e3)
    mean, cov, accepted, nis, used = updated(x, P, rows, 0.0, gate, iterations)
    assert accepted.tolist() == [float(g != rejected) for g in range(3)]
    assert used == len(kept)
    assert nis == pytest.approx(distance_by_numpy(x, P, kept, GATE_VARIANCE), rel=1e-9)
    expected = fused(
        x,
        P,
        kept[:, VALUE] - kept[:, ORIGIN : ORIGIN + 6] @ x,
        kept[:, ORIGIN : ORIGIN + 6].copy(),
        kept[:, VARIANCE].copy(),
    )
    np.testing.assert_allclose(mean, expected[0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(cov, expected[1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("before", [0, 2])
@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_gate_of_correlated_rows_at_its_boundary(size: int, before: int, seed: int) -> None:
    """All rows of a group off, H and P full: just inside and just outside, wherever it stands."""
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=6), random_spd(rng, 6)
    rows = coloured_rows(rng, (before, size, 1) if before else (size, 1))
    group = 1 if before else 0
    limit = distance_by_numpy(x, P, rows[rows[:, GROUP] == group], GATE_VARIANCE)
    for factor, taken in ((1 + 1e-9, 1.0), (1 - 1e-9, 0.0)):
        gate = np.full(7, limit * factor)
        work, accepted = ekf.workspace(6, len(rows)), np.full(group + 2, 9.0)
        mean, cov = x.copy(), P.copy()
        used = ekf.gate(mean, cov, rows, 0.0, gate, 1, accepted, work)
        assert accepted[group] == taken
        assert used == sum(accepted[int(g)] for g in rows[:, GROUP])
        np.testing.assert_array_equal(mean, x)  # gating changes nothing
        np.testing.assert_array_equal(cov, P)


@pytest.mark.parametrize("iterations", [1, 8])
@pytest.mark.parametrize("limits", [[0.0, math.inf], [0.0, 1.0, 1.0, math.inf]])
def test_an_open_gate_accepts_whatever_comes(limits: list[float], iterations: int) -> None:
    rows = coloured_rows(np.random.default_rng(0), (1, 3, 2))
    rows[:, VALUE] += 1e9
    result = updated(np.zeros(6), np.eye(6), rows, 0.0, np.array(limits), iterations)
    assert result[2].tolist() == [1.0, 1.0, 1.0]
    assert result[4] == 6
    assert result[3] == pytest.approx(
        distance_by_numpy(np.zeros(6), np.eye(6), rows, GATE_VARIANCE), rel=1e-9
    )


@pytest.mark.parametrize("iterations", [1, 8])
def test_nothing_accepted_changes_nothing(iterations: int) -> None:
    """All groups rejected, of every size: mean and cov are the prior's, bit for bit."""
    rng = np.random.default_rng(1)
    x, P, rows = rng.normal(size=6), random_spd(rng, 6), coloured_rows(rng, (1, 2, 3))
    rows[:, VALUE] += 1e4
    mean, cov, accepted, nis, used = updated(x, P, rows, 0.0, np.full(4, 9.0), iterations)
    np.testing.assert_array_equal(mean, x)
    np.testing.assert_array_equal(cov, P)
    assert accepted.tolist() == [0.0, 0.0, 0.0]
    assert (nis, used) == (0.0, 0)
