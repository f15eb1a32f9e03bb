"""Prediction, fusion and gating of the extended Kalman filter."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from netpos.filters import ekf
from netpos.filters.measurement import (
    AXES,
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    KIND,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.messages.values import Array
from scipy.stats import chi2

NO_GATE = np.full(13, np.inf)


def random_spd(rng: np.random.Generator, n: int) -> Array:
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


def row(kind: Kind, value: float, variance: float, group: int, origin: Array) -> Array:
    out = np.zeros(ROW_WIDTH)
    out[[KIND, VALUE, VARIANCE, GATE_VARIANCE]] = kind, value, variance, variance
    out[[BIAS, COMMON, GROUP]] = -1, -1, group
    out[ORIGIN:AXES] = origin
    out[AXES:] = np.eye(3).reshape(-1)
    return out


def linear_row(h: Array, value: float, variance: float, group: int) -> Array:
    out = row(Kind.LINEAR, value, variance, group, np.zeros(3))
    out[ORIGIN:] = 0.0
    out[ORIGIN : ORIGIN + 6] = h
    return out


@pytest.mark.parametrize("seed", range(3))
def test_predict(seed: int) -> None:
    rng = np.random.default_rng(seed)
    F, P, Q, x = (
        rng.normal(size=(7, 7)),
        random_spd(rng, 7),
        random_spd(rng, 7),
        rng.normal(size=7),
    )
    mean, cov = ekf.predict(x, P, F, Q)
    np.testing.assert_allclose(mean, F.dot(x), rtol=1e-14)
    np.testing.assert_allclose(cov, np.einsum("ij,jk,lk->il", F, P, F) + Q, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(cov, cov.T)


def test_predict_symmetrises_what_rounding_made_unsymmetric() -> None:
    P = np.array([[2.0, 1.0 + 1e-9], [1.0 - 1e-9, 2.0]])
    _, cov = ekf.predict(np.zeros(2), P, np.eye(2), np.zeros((2, 2)))
    np.testing.assert_allclose(cov, [[2.0, 1.0], [1.0, 2.0]], rtol=1e-15)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("m", [1, 2, 5])
def test_fuse_equals_the_information_form(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=7), random_spd(rng, 7)
    H, R, nu = rng.normal(size=(m, 7)), rng.uniform(0.1, 3.0, m), rng.normal(size=m)
    before = x.copy(), P.copy()
    mean, cov = ekf.fuse(x, P, nu, H, R)
    information = np.linalg.inv(P) + H.T @ np.diag(1 / R) @ H
    np.testing.assert_allclose(cov, np.linalg.inv(information), rtol=1e-8, atol=1e-11)
    step = np.linalg.solve(information, H.T @ (nu / R))
    np.testing.assert_allclose(mean, x + step, rtol=1e-8, atol=1e-11)
    np.testing.assert_array_equal(cov, cov.T)
    np.testing.assert_array_equal(x, before[0])  # the prior is left alone
    np.testing.assert_array_equal(P, before[1])


@pytest.mark.parametrize("order", [1, -1])
def test_fuse_stays_positive_definite_when_ill_conditioned(order: int) -> None:
    """Prior variances from 1e-3 to 1e9, measurement variances from 1e-3 to 1e3, 200 times."""
    rng = np.random.default_rng(8)
    P, x = np.diag([1e9, 1e9, 1.0, 1.0, 1e9, 1e-3][::order]), np.zeros(6)
    for _ in range(200):
        H = rng.normal(size=(2, 6))
        x, P = ekf.fuse(x, P, rng.normal(size=2) * 1e-4, H, np.array([1e-3, 1e3]))
        np.testing.assert_array_equal(P, P.T)
        np.linalg.cholesky(P)
    assert np.isfinite(x).all()


def exact_fuse(x: Array, P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """The batch update in rational arithmetic: no rounding at all."""

    def exact(A: Array) -> Any:
        return [[Fraction(float(v)) for v in line] for line in A]

    def times(A: Any, B: Any) -> Any:
        return [
            [sum(a * b for a, b in zip(r, c, strict=True)) for c in zip(*B, strict=True)]
            for r in A
        ]

    def plus(A: Any, B: Any, sign: int = 1) -> Any:
        return [
            [a + sign * b for a, b in zip(r, q, strict=True)] for r, q in zip(A, B, strict=True)
        ]

    def solve(A: Any, B: Any) -> Any:
        M = [r + c for r, c in zip(A, B, strict=True)]
        for i in range(len(M)):
            M[i] = [v / M[i][i] for v in M[i]]
            for j in range(len(M)):
                if j != i:
                    M[j] = plus([M[j]], [[M[j][i] * v for v in M[i]]], -1)[0]
        return [line[len(A) :] for line in M]

    h, p = exact(H), exact(P)
    ph = times(p, exact(H.T))
    s = plus(times(h, ph), exact(np.diag(R)))
    hp = [list(line) for line in zip(*ph, strict=True)]
    mean = plus(exact(x[:, None]), times(ph, solve(s, exact(nu[:, None]))))
    cov = plus(p, times(ph, solve(s, hp)), -1)
    return np.array(mean, dtype=float)[:, 0], np.array(cov, dtype=float)


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
    mean, cov = ekf.fuse(x, P, nu, H, R)
    expected_mean, expected_cov = exact_fuse(x, P, nu, H, R)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-8, atol=5e-6)
    sd = np.sqrt(np.diag(expected_cov))
    np.testing.assert_allclose(cov / np.outer(sd, sd), expected_cov / np.outer(sd, sd), atol=1e-3)
    np.linalg.cholesky(cov)


def test_joseph_form_survives_where_the_short_form_fails() -> None:
    """The same precise value ten times: the variance ends at r / 10, never at 0 or below."""
    P, x = np.diag([1e9] * 6), np.zeros(6)
    H = np.array([[1.0, 0, 0, 0, 0, 0]])
    for _ in range(10):
        x, P = ekf.fuse(x, P, np.array([1.0]) - H @ x, H, np.array([1e-9]))
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
    x, P, taken, nis, used = ekf.update(mean, cov, rows, 0.0, gate, iterations)
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
        assert ekf.update(mean, cov, rows, 0.0, np.array(gate, float), 1)[2].tolist() == [accepted]


def test_every_group_has_the_threshold_of_its_own_size() -> None:
    mean, cov = np.zeros(6), np.eye(6)
    sizes = (1, 2, 1)  # NIS 2 per row
    rows = [
        linear_row(np.eye(6)[i], 2.0, 1.0, group)
        for i, group in enumerate(g for g, size in enumerate(sizes) for _ in range(size))
    ]
    for gate, taken in (([0, 2.1, 3.9, 99], [1, 0, 1]), ([0, 1.9, 4.1, 99], [0, 1, 0])):
        result = ekf.update(mean, cov, np.array(rows), 0.0, np.array(gate, float), 1)
        assert result[2].tolist() == taken


def test_gate_looks_at_the_gate_variance_and_the_update_at_the_variance() -> None:
    mean, cov = np.zeros(6), np.eye(6)
    one = linear_row(np.eye(6)[0], 4.0, 99.0, 0)
    one[GATE_VARIANCE] = 3.0
    gate = np.array([0.0, 4.001])
    x, P, taken, nis, _ = ekf.update(mean, cov, one[None], 0.0, gate, 1)
    assert taken.tolist() == [1.0]
    assert nis == pytest.approx(16 / 4)
    assert x[0] == pytest.approx(4.0 / 100)
    assert P[0, 0] == pytest.approx(99 / 100)
    gate[1] = 3.999
    assert ekf.update(mean, cov, one[None], 0.0, gate, 8)[2].tolist() == [0.0]


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
    x, _, taken, nis, used = ekf.update(mean, cov, np.array(rows), 0.0, gate, iterations)
    assert taken.tolist() == [float(g != bad) for g in range(3)]
    kept = np.array([r for r in rows if r[GROUP] != bad])
    assert used == 4
    expected = ekf.update(mean, cov, _renumbered(kept), 0.0, NO_GATE, iterations)
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
    forward = ekf.update(mean, cov, np.array(a + b), 0.0, NO_GATE, 1)
    swapped = [r.copy() for r in b + a]
    for r in swapped:
        r[GROUP] = 1 - r[GROUP]
    backward = ekf.update(mean, cov, np.array(swapped), 0.0, NO_GATE, 1)
    np.testing.assert_allclose(forward[0], backward[0], rtol=1e-12)
    np.testing.assert_allclose(forward[1], backward[1], rtol=1e-12, atol=1e-15)
    assert forward[3] == pytest.approx(backward[3], rel=1e-12)
    assert forward[2].tolist() == backward[2].tolist() == [1.0, 1.0]
