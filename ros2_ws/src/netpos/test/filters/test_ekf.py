"""Prediction, gating and update against the batch forms of the same equations."""

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
    linearise,
)
from netpos.messages.values import Array
from scipy.optimize import least_squares
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


def log_posterior_cost(rows: Array, mean: Array, cov: Array, height: float, x: Array) -> float:
    """Twice the negative log posterior, plainly."""
    innovation, _ = linearise(rows, x, height)
    return float(
        (x - mean) @ np.linalg.inv(cov) @ (x - mean) + np.sum(innovation**2 / rows[:, VARIANCE])
    )


# prediction and fusion


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


# gating


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


# iteration


def range_problem(seed: int) -> tuple[Array, Array, Array]:
    """A wide prior, two precise ranges and a bearing: strongly curved."""
    rng = np.random.default_rng(seed)
    mean = np.array([10.0, 8.0, 1.0, 0.0, 0.0, 0.0]) + rng.normal(size=6) * 0.5
    cov = np.diag([30.0, 20.0, 1.0, 1.0, 1.0, 1.0])
    cov[0, 2] = cov[2, 0] = 2.0
    rows = np.array(
        [
            row(Kind.RANGE, 10.0, 0.01, 0, np.array([0.0, 0.0, 0.0])),
            row(Kind.RANGE, 9.0, 0.01, 1, np.array([12.0, 0.0, 0.0])),
            row(Kind.AZIMUTH, 0.9, 0.01, 2, np.array([0.0, 0.0, 0.0])),
        ]
    )
    return mean, cov, rows


@pytest.mark.parametrize("seed", range(5))
def test_iteration_finds_the_most_probable_state(seed: int) -> None:
    """SciPy's minimiser of the same cost, and its curvature at the minimum, are the oracle."""
    mean, cov, rows = range_problem(seed)
    x, P = ekf.iterate(mean, cov, rows, rows[:, VARIANCE], 0.0, 30)
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
    expected = ekf.fuse(mean, cov, innovation, H, rows[:, VARIANCE])
    for iterations in (0, 1):
        x, P = ekf.iterate(mean, cov, rows, rows[:, VARIANCE], 0.0, iterations)
        np.testing.assert_array_equal(x, expected[0])
        np.testing.assert_array_equal(P, expected[1])


def test_two_iterations_linearise_once_more_at_the_result() -> None:
    mean, cov, rows = range_problem(1)
    mean, cov = np.array([7.0, 6.9, 1.0, 0, 0, 0]), cov / 30.0
    variance = rows[:, VARIANCE]
    innovation, H = linearise(rows, mean, 0.0)
    first, _ = ekf.fuse(mean, cov, innovation, H, variance)
    assert log_posterior_cost(rows, mean, cov, 0.0, first) < log_posterior_cost(
        rows, mean, cov, 0.0, mean
    )  # no halving in this example
    innovation, H = linearise(rows, first, 0.0)
    # Gauss-Newton on the information form
    information = np.linalg.inv(cov) + H.T @ np.diag(1 / variance) @ H
    gradient = H.T @ (innovation / variance) - np.linalg.solve(cov, first - mean)
    second = first + np.linalg.solve(information, gradient)
    x, P = ekf.iterate(mean, cov, rows, variance, 0.0, 2)
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
    variance = rows[:, VARIANCE]
    plain, _ = ekf.iterate(mean, cov, rows, variance, 0.0, 1)
    best = min(log_posterior_cost(rows, mean, cov, 0.0, x) for x in (mean, plain))
    x, _ = ekf.iterate(mean, cov, rows, variance, 0.0, 8)
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
        x, P = ekf.iterate(mean, cov, rows, rows[:, VARIANCE], 0.0, iterations)
        sd = np.sqrt(np.diag(P_expected))
        np.testing.assert_allclose((x - expected) / sd, 0.0, atol=1e-5, err_msg=str(seed))
        np.testing.assert_allclose(P / np.outer(sd, sd), P_expected / np.outer(sd, sd), atol=1e-5)
        seen |= set(halvings)
    if iterations > 1:
        assert {0, 1, 2} <= seen
    if iterations == 8:
        assert max(seen) >= 6


@pytest.mark.parametrize("seed", range(5))
def test_distance2_is_the_mahalanobis_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cov, d = random_spd(rng, 7), rng.normal(size=7)
    before = cov.copy(), d.copy()
    assert ekf.distance2(cov, d) == pytest.approx(d @ np.linalg.inv(cov) @ d, rel=1e-9)
    np.testing.assert_array_equal(cov, before[0])
    np.testing.assert_array_equal(d, before[1])


def test_distance2_leaves_out_what_is_known_exactly() -> None:
    """A perfect clock has zero rows; two states that always agree are one."""
    assert ekf.distance2(np.diag([4.0, 0.0, 9.0]), np.array([2.0, 0.0, 6.0])) == 5.0
    same = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
    assert ekf.distance2(same, np.array([2.0, 2.0, 3.0])) == pytest.approx(10.0)


def test_distance2_keeps_the_tiniest_true_variance() -> None:
    cov = np.array([[1e9, 0.5 * math.sqrt(1e-3)], [0.5 * math.sqrt(1e-3), 1e-12]])
    d = np.array([1e3, 2e-6])
    sd = np.sqrt(np.diag(cov))
    correlation = cov / np.outer(sd, sd)
    assert ekf.distance2(cov, d) == pytest.approx(
        (d / sd) @ np.linalg.inv(correlation) @ (d / sd), rel=1e-9
    )


@pytest.mark.parametrize("seed", range(5))
def test_misfit_is_twice_the_negative_log_posterior(seed: int) -> None:
    mean, cov, rows = range_problem(seed)
    x = mean + np.random.default_rng(seed).normal(size=6)
    expected = log_posterior_cost(rows, mean, cov, 0.0, x)
    assert ekf.misfit(mean, cov, rows, rows[:, VARIANCE], 0.0, x) == pytest.approx(
        expected, rel=1e-9
    )


def curved_group() -> tuple[Array, Array, Array]:
    """A range across a prior 20 m wide sideways: far by the tangent, near in truth."""
    mean, cov = np.array([30.0, 1e-3, 0, 0, 0, 0]), np.diag([0.01, 400.0, 1, 1, 1, 1.0])
    truth = math.hypot(30.0, 20.0)  # one sd sideways
    return mean, cov, np.array([row(Kind.RANGE, truth, 0.01, 0, np.zeros(3))])


def test_curved_group_passes_by_its_most_probable_state_only_when_iterating() -> None:
    mean, cov, rows = curved_group()
    threshold = chi2.ppf(0.999, 1)
    assert not ekf.passes(mean, cov, rows, 0.0, threshold, 1)
    assert ekf.passes(mean, cov, rows, 0.0, threshold, 20)
    x, _ = ekf.iterate(mean, cov, rows, rows[:, VARIANCE], 0.0, 20)
    cost = log_posterior_cost(rows, mean, cov, 0.0, x)
    assert ekf.passes(mean, cov, rows, 0.0, cost * 1.0001, 20)
    assert not ekf.passes(mean, cov, rows, 0.0, cost * 0.9999, 20)


def test_gate_threshold_itself_is_inside_and_one_iteration_decides_by_the_tangent() -> None:
    """y 0.5 m, range 36 m with 2 m sd: 8.7 by the tangent, 4.9 at the state the EKF ends in."""
    mean, cov, rows = curved_group()
    mean[1], rows[0, VALUE], rows[0, VARIANCE], rows[0, GATE_VARIANCE] = 0.5, 36.0, 4.0, 4.0
    innovation, H = linearise(rows, mean, 0.0)
    nis = ekf.group_nis(cov, innovation, H, rows[:, GATE_VARIANCE])
    x, _ = ekf.iterate(mean, cov, rows, rows[:, VARIANCE], 0.0, 1)
    assert ekf.misfit(mean, cov, rows, rows[:, VARIANCE], 0.0, x) < 0.6 * nis
    for iterations in (0, 1):
        assert ekf.passes(mean, cov, rows, 0.0, nis, iterations)
        assert not ekf.passes(mean, cov, rows, 0.0, np.nextafter(nis, 0), iterations)
    for iterations in (2, 8):
        x, _ = ekf.iterate(mean, cov, rows, rows[:, VARIANCE], 0.0, iterations)
        cost = ekf.misfit(mean, cov, rows, rows[:, VARIANCE], 0.0, x)
        assert cost < 0.6 * nis
        assert ekf.passes(mean, cov, rows, 0.0, cost, iterations)
        assert not ekf.passes(mean, cov, rows, 0.0, np.nextafter(cost, 0), iterations)
        assert ekf.passes(mean, cov, rows, 0.0, nis, iterations)


def test_update_adds_the_curvature_to_both_variances() -> None:
    """half of (sideways variance / range)^2: 400^2 / 2 / 30^2."""
    mean, cov, rows = curved_group()
    before = rows.copy()
    x, P, _, nis, _ = ekf.update(mean, cov, rows, 0.0, NO_GATE, 1)
    np.testing.assert_array_equal(rows, before)  # the caller's rows are left alone
    variance = 0.01 + 400.0**2 / 2 / 30.0**2
    innovation, H = linearise(rows, mean, 0.0)
    expected = ekf.fuse(mean, cov, innovation, H, np.array([variance]))
    np.testing.assert_allclose(x, expected[0], rtol=1e-7)
    np.testing.assert_allclose(P, expected[1], rtol=1e-7, atol=1e-9)
    S = float((H @ cov @ H.T)[0, 0]) + variance
    assert nis == pytest.approx(innovation[0] ** 2 / S, rel=1e-6)


def test_height_of_the_device_reaches_every_stage() -> None:
    """An RSU 3 m up: with the right height the range fits, with another it does not."""
    mean, cov = np.array([4.0, 0, 0, 0, 0, 0]), 0.01 * np.eye(6)
    rows = np.array([row(Kind.RANGE, 5.0, 1e-4, 0, np.array([0.0, 0.0, 3.0]))])
    gate = np.array([0.0, 9.0])
    for iterations in (1, 8):
        good = ekf.update(mean, cov, rows, 0.0, gate, iterations)
        assert good[2].tolist() == [1.0]
        assert good[3] == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(good[0], mean, atol=1e-12)
        assert ekf.update(mean, cov, rows, -3.0, gate, iterations)[2].tolist() == [0.0]
