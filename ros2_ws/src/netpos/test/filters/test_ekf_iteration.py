"""Iterated updates: the most probable state, its misfit, gates where the model bends."""

from __future__ import annotations

import math

import numpy as np
import pytest
from filter_rows import NO_GATE, random_spd, row
from netpos.filters import ekf, fit, fusion
from netpos.filters.measurement import (
    GATE_VARIANCE,
    GROUP,
    VALUE,
    VARIANCE,
    Kind,
    curvature_variance,
    linearise,
)
from netpos.messages.values import Array
from scipy.optimize import brentq, least_squares
from scipy.stats import chi2


def scratch(n: int, m: int) -> Array:
    """A workspace full of what must not be read."""
    return np.full_like(ekf.workspace(n, m), np.nan)


def iterated(
    mean: Array, cov: Array, rows: Array, variance: Array, iterations: int
) -> tuple[Array, Array]:
    """``ekf.iterate`` on the ground; its arguments are left alone."""
    given = mean, cov, rows, variance
    before = [a.copy() for a in given]
    x, P = ekf.iterate(*given, 0.0, iterations, scratch(mean.size, len(rows)))
    for a, b in zip(given, before, strict=True):
        np.testing.assert_array_equal(a, b)
    return x, P


def fused(x: Array, P: Array, innovation: Array, H: Array, variance: Array) -> tuple[Array, Array]:
    mean, cov, m = x.copy(), P.copy(), innovation.size
    ekf.fuse(mean, cov, innovation, H, variance.copy(), np.ones(m), scratch(x.size, m))
    return mean, cov


def updated(
    x: Array, P: Array, rows: Array, height_m: float, gate: Array, iterations: int
) -> tuple[Array, Array, Array, float, int]:
    """``ekf.update`` on copies: mean, cov, accepted, nis, used."""
    mean, cov, accepted = x.copy(), P.copy(), np.full(int(rows[:, GROUP].max()) + 1, 9.0)
    work = scratch(x.size, len(rows))
    nis, used = ekf.update(mean, cov, rows, height_m, gate, iterations, accepted, work)
    return mean, cov, accepted, nis, used


def passes(mean: Array, cov: Array, rows: Array, threshold: float, iterations: int) -> bool:
    """The decision on one group with its gate variances as they are (``gate`` adds the
    curvature)."""
    n, m = mean.size, len(rows)
    work = scratch(n, m)
    innovation, H = linearise(rows, mean, 0.0)
    work[fusion.W_INNOVATION, :m] = innovation
    work[fusion.W_GATE_VARIANCE, :m] = rows[:, GATE_VARIANCE]
    work[fusion.W_COV + n : fusion.W_COV + n + m, :n] = H
    work[fusion.W_COV + n + m : fusion.W_COV + n + 2 * m, :n] = H @ cov
    return bool(ekf._passes(mean, cov, rows, 0, m, 0.0, threshold, iterations, work))


def log_posterior_cost(rows: Array, mean: Array, cov: Array, height: float, x: Array) -> float:
    """Twice the negative log posterior, plainly."""
    innovation, _ = linearise(rows, x, height)
    return float(
        (x - mean) @ np.linalg.inv(cov) @ (x - mean) + np.sum(innovation**2 / rows[:, VARIANCE])
    )


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
    expected = fused(mean, cov, innovation, H, rows[:, VARIANCE])
    for iterations in (0, 1):
        x, P = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), iterations)
        np.testing.assert_array_equal(x, expected[0])
        np.testing.assert_array_equal(P, expected[1])


def test_two_iterations_linearise_once_more_at_the_result() -> None:
    mean, cov, rows = range_problem(1)
    mean, cov = np.array([7.0, 6.9, 1.0, 0, 0, 0]), cov / 30.0
    variance = rows[:, VARIANCE].copy()
    innovation, H = linearise(rows, mean, 0.0)
    first, _ = fused(mean, cov, innovation, H, variance)
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


def curved_group() -> tuple[Array, Array, Array]:
    """A range across a prior 20 m wide sideways: far by the tangent, near in truth."""
    mean, cov = np.array([30.0, 1e-3, 0, 0, 0, 0]), np.diag([0.01, 400.0, 1, 1, 1, 1.0])
    truth = math.hypot(30.0, 20.0)  # one sd sideways
    return mean, cov, np.array([row(Kind.RANGE, truth, 0.01, 0, np.zeros(3))])


def test_curved_group_passes_by_its_most_probable_state_only_when_iterating() -> None:
    mean, cov, rows = curved_group()
    threshold = chi2.ppf(0.999, 1)
    assert not passes(mean, cov, rows, threshold, 1)
    assert passes(mean, cov, rows, threshold, 20)
    x, _ = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), 20)
    cost = log_posterior_cost(rows, mean, cov, 0.0, x)
    assert passes(mean, cov, rows, cost * 1.0001, 20)
    assert not passes(mean, cov, rows, cost * 0.9999, 20)


def test_gate_threshold_itself_is_inside_and_one_iteration_decides_by_the_tangent() -> None:
    """y 0.5 m, range 36 m with 2 m sd: 8.7 by the tangent, 4.9 at the state the EKF ends in."""
    mean, cov, rows = curved_group()
    mean[1], rows[0, VALUE], rows[0, VARIANCE], rows[0, GATE_VARIANCE] = 0.5, 36.0, 4.0, 4.0
    innovation, H = linearise(rows, mean, 0.0)
    # As the kernel rounds it: the last bit decides here.
    nis = innovation[0] ** 2 / (4.0 + (H @ (H @ cov).T).item())
    assert nis == pytest.approx(ekf.group_nis(cov, innovation, H, np.array([4.0])), rel=1e-14)
    x, _ = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), 1)
    assert fit.misfit(mean, cov, rows, rows[:, VARIANCE].copy(), 0.0, x) < 0.6 * nis
    for iterations in (0, 1):
        assert passes(mean, cov, rows, nis, iterations)
        assert not passes(mean, cov, rows, np.nextafter(nis, 0), iterations)
    for iterations in (2, 8):
        x, _ = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), iterations)
        cost = fit.misfit(mean, cov, rows, rows[:, VARIANCE].copy(), 0.0, x)
        assert cost < 0.6 * nis
        assert passes(mean, cov, rows, cost, iterations)
        assert not passes(mean, cov, rows, np.nextafter(cost, 0), iterations)
        assert passes(mean, cov, rows, nis, iterations)


def test_update_adds_the_curvature_to_both_variances() -> None:
    """half of (sideways variance / range)^2: 400^2 / 2 / 30^2."""
    mean, cov, rows = curved_group()
    before = rows.copy()
    x, P, _, nis, _ = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    np.testing.assert_array_equal(rows, before)  # the caller's rows are left alone
    variance = 0.01 + 400.0**2 / 2 / 30.0**2
    innovation, H = linearise(rows, mean, 0.0)
    expected = fused(mean, cov, innovation, H, np.array([variance]))
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
        good = updated(mean, cov, rows, 0.0, gate, iterations)
        assert good[2].tolist() == [1.0]
        assert good[3] == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(good[0], mean, atol=1e-12)
        assert updated(mean, cov, rows, -3.0, gate, iterations)[2].tolist() == [0.0]


def two_variances(mean: Array, cov: Array, rows: Array) -> Array:
    """Variances of an update: the rows' and the curvature's."""
    extra = [curvature_variance(r, mean, cov, 0.0) for r in rows]
    return np.asarray(rows[:, VARIANCE] + extra)


def slightly_bent(kind: Kind, share: float, variance: float, side: int) -> tuple[Array, ...]:
    """One row whose value at the state the EKF ends in is ``share`` of an sd off the tangent at
    the prior: a state that moves along and across the line of sight."""
    mean, cov = np.array([10.0, 0, 3.0, 0, 0, 0]), np.eye(6)
    cov[0, 1] = cov[1, 0] = cov[2, 3] = cov[3, 2] = 0.9 * side
    rows = np.array([row(kind, 0.0, variance, 0, np.zeros(3))])
    rows[0, GATE_VARIANCE] = variance / 2.0
    rows[0, VALUE] -= linearise(rows, mean, 0.0)[0][0]
    nominal, sd = rows[0, VALUE], math.sqrt(two_variances(mean, cov, rows)[0])

    def away(offset: float) -> float:
        rows[0, VALUE] = nominal + offset
        innovation, H = linearise(rows, mean, 0.0)
        x, _ = fused(mean, cov, innovation, H, np.array([sd**2]))
        return float(abs(linearise(rows, x, 0.0)[0] - innovation + H @ (x - mean))[0] / sd)

    away(brentq(lambda offset: away(offset) - share, 0.0, 0.3 if kind is Kind.AZIMUTH else 3.0))
    return mean, cov, rows


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("kind", "variance"), [(Kind.SPEED, 1.0), (Kind.SPEED, 0.25), (Kind.AZIMUTH, 2.5e-3)]
)
def test_update_iterates_only_where_the_model_bends(
    kind: Kind, variance: float, side: int
) -> None:
    """Just under and just over 2 % of the noise's sd between the row and its tangent, which lies
    above it or below."""
    mean, cov, rows = slightly_bent(kind, 0.02 * (1 - 1e-6), variance, side)
    plain = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    straight = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    np.testing.assert_array_equal(straight[0], plain[0])  # bit for bit
    np.testing.assert_array_equal(straight[1], plain[1])
    mean, cov, rows = slightly_bent(kind, 0.02 * (1 + 1e-6), variance, side)
    plain = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    bent = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    expected = iterated(mean, cov, rows, two_variances(mean, cov, rows), 8)
    np.testing.assert_array_equal(bent[0], expected[0])
    np.testing.assert_array_equal(bent[1], expected[1])
    assert np.abs(bent[0] - plain[0]).max() > 1e-4
    assert bent[3:] == plain[3:]  # nis and number are those of the prior


@pytest.mark.parametrize("iterations", [2, 8])
def test_only_what_was_accepted_is_iterated_with_the_variances_of_the_update(
    iterations: int,
) -> None:
    mean, cov, rows = range_problem(2)
    rows[1, VALUE] += 1e4  # rejected, and in the middle
    rows[:, GATE_VARIANCE] = rows[:, VARIANCE] / 3.0
    result = updated(mean, cov, rows, 0.0, np.array([0.0, 1e3]), iterations)
    kept, variance = rows[::2].copy(), two_variances(mean, cov, rows)[::2].copy()
    expected = iterated(mean, cov, kept, variance, iterations)
    np.testing.assert_array_equal(result[0], expected[0])
    np.testing.assert_array_equal(result[1], expected[1])
    assert result[2].tolist() == [1.0, 0.0, 1.0]
    innovation, H = linearise(kept, mean, 0.0)
    S = H @ cov @ H.T + np.diag(variance - kept[:, VARIANCE] + kept[:, GATE_VARIANCE])
    assert result[3] == pytest.approx(innovation @ np.linalg.inv(S) @ innovation, rel=1e-9)


def test_a_rejected_row_that_bends_is_no_reason_to_iterate() -> None:
    """It bends by 100 times as much of its noise; what is accepted, by just under the limit."""
    mean, cov, rows = slightly_bent(Kind.SPEED, 0.02 * (1 - 1e-6), 1.0, 1)
    far = row(Kind.SPEED, 1e3, 1e-4, 0, np.zeros(3))
    gate, both = np.array([0.0, 9.0]), np.vstack([far, rows])
    both[1, GROUP] = 1
    plain = updated(mean, cov, both, 0.0, gate, 1)
    result = updated(mean, cov, both, 0.0, gate, 8)
    assert result[2].tolist() == [0.0, 1.0]
    np.testing.assert_array_equal(result[0], plain[0])
    np.testing.assert_array_equal(result[1], plain[1])
