"""The compiled unscented filter, by factors and by covariances, against the textbook's sums in
NumPy, exact arithmetic and petukhov's down-dates."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from netpos.estimation.forms import sigma, srukf, ukf
from netpos.estimation.measurement import BIAS, KIND, ORIGIN, VALUE, Kind
from netpos.estimation.motion import (
    NO_BIAS,
    Model,
    Parameter,
    ProcessNoise,
    motion_parameters,
    noise,
    propagate,
)
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array

Maker = Callable[..., Array]
OPEN = np.array([np.inf])
HEIGHT = 1.5


def textbook_points(mean: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Merwe's points and weights for alpha 1, beta 2, kappa 3 - n."""
    n = mean.size
    L = np.linalg.cholesky(3.0 * cov)
    points = np.vstack([mean, mean + L.T, mean - L.T])
    mean_weights = np.full(2 * n + 1, 1.0 / 6.0)
    mean_weights[0] = (3.0 - n) / 3.0
    cov_weights = mean_weights.copy()
    cov_weights[0] += 1.0 - 1.0 + 2.0
    return points, mean_weights, cov_weights


def is_lower_factor(L: Array) -> bool:
    return bool((np.triu(L, 1) == 0.0).all() and (np.diag(L) >= 0.0).all())


def value_of(row: Array, x: Array) -> float:
    """Azimuth and range from unrotated RSUs, with the row's own bias."""
    d = np.array([x[X.PX], x[X.PY], HEIGHT]) - row[ORIGIN : ORIGIN + 3]
    kind = int(row[KIND])
    if kind == Kind.LINEAR:
        return float(row[ORIGIN : ORIGIN + 6] @ x[:6])
    value = math.atan2(d[1], d[0]) if kind == Kind.AZIMUTH else math.sqrt(d @ d)
    if kind == Kind.TOA:
        value += x[X.CLOCK]
    return value + (x[int(row[BIAS])] if row[BIAS] >= 0 else 0.0)


def textbook_moments(mean: Array, cov: Array, rows: Array) -> tuple[Array, Array, Array]:
    """Innovation, its covariance without noise, covariance with the state; angles by atan2 of
    the weighted sums."""
    points, wm, wc = textbook_points(mean, cov)
    y = np.array([[value_of(row, x) for row in rows] for x in points])
    angle = rows[:, KIND] == Kind.AZIMUTH
    average = wm @ y
    average[angle] = np.arctan2(wm @ np.sin(y[:, angle]), wm @ np.cos(y[:, angle]))
    away, innovation = y - average, rows[:, VALUE] - average
    away[:, angle] = np.angle(np.exp(1j * away[:, angle]))
    innovation[angle] = np.angle(np.exp(1j * innovation[angle]))
    return innovation, away.T @ np.diag(wc) @ away, (points - mean).T @ np.diag(wc) @ away


def textbook_update(mean: Array, cov: Array, rows: Array) -> tuple[Array, Array]:
    innovation, S, cross = textbook_moments(mean, cov, rows)
    S = S + np.diag(rows[:, 2])
    K = cross @ np.linalg.inv(S)
    return mean + K @ innovation, cov - K @ S @ K.T


def epoch(row: Maker) -> Array:
    """Azimuth, TOA and biased range of two RSUs, one group each."""
    near, far = (50.0, 10.0, 6.0), (-30.0, 60.0, 6.0)
    return np.array(
        [
            row(Kind.AZIMUTH, 2.9, 0.002, 0, origin=near, gate_variance=0.001),
            row(Kind.TOA, 75.0, 4.0, 0, origin=near, gate_variance=3.0),
            row(Kind.AZIMUTH, -1.1, 0.003, 1, origin=far),
            row(Kind.RANGE, 70.0, 2.0, 1, origin=far, bias=6, gate_variance=5.0),
        ]
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [7, 12, 20])
def test_update_equals_the_textbook(n: int, seed: int, row: Maker, random_cov: Maker) -> None:
    """Azimuth spreads of about a hundredth of a radian: atan2 of sums is the mean to third
    order."""
    rng = np.random.default_rng(seed)
    mean, cov, rows = rng.normal(size=n), random_cov(rng, n, 1e-5), epoch(row)
    expected_mean, expected_cov = textbook_update(mean, cov, rows)
    innovation, S, _ = textbook_moments(mean, cov, rows)
    by_factor, L = mean.copy(), np.linalg.cholesky(cov)
    nis, dof = ukf.update(mean, cov, rows, HEIGHT, OPEN, np.zeros(2))
    assert srukf.update(by_factor, L, rows, HEIGHT, OPEN, np.zeros(2)) == (nis, dof)
    assert is_lower_factor(L)
    for state, P in ((mean, cov), (by_factor, L @ L.T)):
        np.testing.assert_allclose(state, expected_mean, rtol=0, atol=1e-11)
        np.testing.assert_allclose(P, expected_cov, rtol=0, atol=1e-15)
    gate_S = S + np.diag([0.001, 3.0, 0.003, 5.0])
    assert dof == 4
    assert nis == pytest.approx(innovation @ np.linalg.solve(gate_S, innovation), rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_update_with_wide_prior_equals_the_textbook(
    seed: int, row: Maker, random_cov: Maker
) -> None:
    """Ranges only: where they bend, what the regression leaves over counts."""
    rng = np.random.default_rng(seed)
    mean, cov, rows = rng.normal(size=8), random_cov(rng, 8, 200.0), epoch(row)[[1, 3]]
    expected_mean, expected_cov = textbook_update(mean, cov, rows)
    ukf.update(mean, cov, rows, HEIGHT, OPEN, np.zeros(2))
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-9)
    np.testing.assert_allclose(cov, expected_cov, rtol=1e-9, atol=1e-9)
    assert (cov == cov.T).all()


def textbook_predict(
    mean: Array, cov: Array, dt: float, motion: Array, bias: Array
) -> tuple[Array, Array]:
    points, wm, wc = textbook_points(mean, cov)
    for point in points:
        propagate(point, dt, motion, bias)
    moved, Q = wm @ points, np.empty_like(cov)
    noise(moved, dt, motion, bias, Q)
    return moved, (points - moved).T @ np.diag(wc) @ (points - moved) + Q


@pytest.mark.parametrize("kind", list(ProcessNoise))
@pytest.mark.parametrize("model", [Model.CONSTANT_VELOCITY, Model.CONSTANT_TURN])
def test_predict_equals_the_textbook(model: Model, kind: ProcessNoise, random_cov: Maker) -> None:
    rng = np.random.default_rng(3)
    motion = motion_parameters(
        model, kind, accel=1.0, velocity_step=0.3, drift_step=0.1, turn_rate=0.1, drift_density=0.2
    )
    bias = np.array([[2.0], [30.0]])
    n = 7 + int(motion[Parameter.EXTRAS])
    mean, cov, dt = rng.normal(size=n) * 3.0, random_cov(rng, n), 0.7
    by_factor, L = mean.copy(), np.linalg.cholesky(cov)
    expected, expected_cov = textbook_predict(mean, cov, dt, motion, bias)
    ukf.predict(mean, cov, dt, motion, bias)
    srukf.predict(by_factor, L, dt, motion, bias)
    assert (cov == cov.T).all()
    assert is_lower_factor(L)
    for state, P in ((mean, cov), (by_factor, L @ L.T)):
        np.testing.assert_allclose(state, expected, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(P, expected_cov, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("dt", [0.0, -1.0])
def test_nothing_moves_without_time(dt: float) -> None:
    mean, cov = np.arange(6.0), np.diag(np.arange(1.0, 7.0))
    ukf.predict(mean, cov, dt, motion_parameters(accel=1.0), NO_BIAS)
    assert (mean == np.arange(6.0)).all()
    assert (cov == np.diag(np.arange(1.0, 7.0))).all()


def test_angles_at_the_seam(row: Maker, random_cov: Maker) -> None:
    """West of the RSU the azimuth jumps; seen in axes turned by a right angle it does not."""
    rng = np.random.default_rng(1)
    prior, prior_cov = np.array([-20.0, 0.1, 1, 0, 0, 0]), random_cov(rng, 6, 30.0)
    turned = (0, 1, 0, -1, 0, 0, 0, 0, 1)  # u_x = y, u_y = -x: azimuth less pi / 2
    for value in (math.pi - 0.05, -math.pi + 0.05):
        plain = np.array([row(Kind.AZIMUTH, value, 0.01)])
        other = np.array([row(Kind.AZIMUTH, value - math.pi / 2, 0.01, axes=turned)])
        a, b = (prior.copy(), prior_cov.copy()), (prior.copy(), prior_cov.copy())
        nis = ukf.update(*a, plain, 0.0, OPEN, np.zeros(1))[0]
        assert nis == pytest.approx(ukf.update(*b, other, 0.0, OPEN, np.zeros(1))[0], rel=1e-9)
        np.testing.assert_allclose(a[0], b[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(a[1], b[1], rtol=1e-9, atol=1e-9)
        assert abs(a[0][1]) < 5.0


def test_mean_angle_of_narrow_spreads(row: Maker) -> None:
    """About the central point, and across the seam, the mean is that of atan2 of sums."""
    for x in (np.array([-20.0, 1e-9]), np.array([3.0, 4.0])):
        mean, cov = np.concatenate([x, np.zeros(4)]), 1e-10 * np.eye(6)
        rows = np.array([row(Kind.AZIMUTH, 3.0, 1.0)])
        expected, _, _ = textbook_moments(mean, cov, rows)
        innovation, _, _ = sigma.regress(mean, np.linalg.cholesky(cov), rows, HEIGHT)
        assert innovation[0] == pytest.approx(expected[0], abs=4e-15)


@pytest.mark.parametrize("inside", [True, False])
def test_gate_at_its_boundary(inside: bool, row: Maker, random_cov: Maker) -> None:
    """Each group has its own distance, limit by its rows and fate."""
    rng = np.random.default_rng(8)
    prior, prior_cov, rows = rng.normal(size=8), random_cov(rng, 8, 1e-4), epoch(row)
    innovation, S, _ = textbook_moments(prior, prior_cov, rows)
    S += np.diag([0.001, 3.0, 0.003, 5.0])
    first, second = (
        innovation[g] @ np.linalg.solve(S[g, g], innovation[g]) for g in (slice(2), slice(2, 4))
    )
    assert first > second
    limit = (first + second) / 2 if inside else second * (1.0 - 1e-9)
    gate_nis = np.array([0.0, 1e9, limit])
    mean, cov, accepted = prior.copy(), prior_cov.copy(), np.full(2, 9.0)
    nis, dof = ukf.update(mean, cov, rows, HEIGHT, gate_nis, accepted)
    if inside:
        assert accepted.tolist() == [0.0, 1.0]
        assert (nis, dof) == (pytest.approx(second, rel=1e-9), 2)
        expected = textbook_update(prior, prior_cov, rows[2:])
        np.testing.assert_allclose(mean, expected[0], rtol=0, atol=1e-10)
        np.testing.assert_allclose(cov, expected[1], rtol=0, atol=1e-13)
    else:
        assert (nis, dof, accepted.tolist()) == (0.0, 0, [0.0, 0.0])
        assert (mean == prior).all()
        assert (cov == prior_cov).all()
    accepted[:] = 9.0
    for size in (3, 1):  # the last entry serves all larger groups
        short = np.array([0.0, second * (1.0 + 1e-9), second * (1.0 + 1e-9)])[:size]
        short[-1] = second * (1.0 + 1e-9)
        ukf.update(prior.copy(), prior_cov.copy(), rows, HEIGHT, short, accepted)
        assert accepted.tolist() == [0.0, 1.0]


def test_a_bias_elsewhere_changes_nothing(row: Maker, random_cov: Maker) -> None:
    """kappa = 3 - n: the points on an axis do not move apart with each state appended."""
    rng = np.random.default_rng(6)
    rows = epoch(row)[:3]
    mean, cov = rng.normal(size=6), random_cov(rng, 6, 100.0)
    large_mean, large_cov = np.zeros(20), np.diag(np.arange(1.0, 21.0))
    large_mean[:6], large_cov[:6, :6] = mean, cov
    ukf.update(mean, cov, rows, HEIGHT, OPEN, np.zeros(2))
    ukf.update(large_mean, large_cov, rows, HEIGHT, OPEN, np.zeros(2))
    np.testing.assert_allclose(large_mean[:6], mean, rtol=1e-10)
    np.testing.assert_allclose(large_cov[:6, :6], cov, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(np.diag(large_cov)[6:], np.arange(7.0, 21.0), rtol=1e-12)


def test_what_is_known_exactly_stays(row: Maker) -> None:
    """A singular covariance: y and the clock are known."""
    mean, cov = np.array([3.0, 4.0, 0, 0, 7, 0]), np.diag([4.0, 0, 1, 1, 0, 1])
    rows = np.array([row(Kind.RANGE, 6.0, 1.0)])
    ukf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1))
    assert mean[X.PY] == 4.0
    assert mean[X.CLOCK] == 7.0
    assert cov[1].tolist() == [0.0] * 6
    assert np.isfinite(cov).all()
    assert 0.0 < cov[X.PX, X.PX] < 4.0


def test_ill_conditioned_covariance_stays_definite(row: Maker) -> None:
    """P - K S K' turns negative here; a product of factors does not."""
    mean, cov = np.zeros(6), np.diag([1e10, 1e10, 1.0, 1.0, 1e10, 1.0])
    cov[X.PX, X.PY] = cov[X.PY, X.PX] = 1e10 * (1 - 1e-9)
    rows = np.array(
        [
            row(Kind.LINEAR, 1.0, 1e-8, 0, h=(1, 0, 0, 0, 0, 0)),
            row(Kind.LINEAR, 1.0, 1e-8, 0, h=(1, 1, 0, 0, 1, 0)),
        ]
    )
    plain = textbook_update(mean, cov, rows)[1]
    assert np.linalg.eigvalsh(plain).min() < -1e-9
    ukf.update(mean, cov, rows, 0.0, OPEN, np.zeros(1))
    assert np.linalg.eigvalsh(cov).min() > -1e-9
    assert (np.diag(cov) > 0.0).all()
    assert (cov == cov.T).all()


def test_an_epoch_without_rows(row: Maker) -> None:
    mean, P = np.arange(6.0), 2.0 * np.eye(6)
    rows = np.array([row(Kind.RANGE, 1.0, 1.0)])[:0]
    assert ukf.update(mean, P, rows, 0.0, OPEN, np.zeros(0)) == (0.0, 0)
    assert mean.tolist() == [0, 1, 2, 3, 4, 5]
    assert (2.0 * np.eye(6) == P).all()


def test_update_equals_petukhovs_down_dates(row: Maker, random_cov: Maker) -> None:
    """petukhov:eq.26 with the factor of S it omits: P less the squares of the columns of K S_y."""
    rng = np.random.default_rng(3)
    mean, rows = rng.normal(size=7), epoch(row)
    L = np.linalg.cholesky(random_cov(rng, 7))
    _, G, E = sigma.regress(mean, L, rows, 1.5)
    S_factor = np.linalg.cholesky(G @ G.T + E @ E.T + np.diag(rows[:, 2]))
    K_S = L @ G.T @ np.linalg.inv(S_factor).T
    down = np.linalg.cholesky(L @ L.T - K_S @ K_S.T)
    srukf.update(mean, L, rows, 1.5, OPEN, np.zeros(2))
    np.testing.assert_allclose(L, down, rtol=1e-9, atol=1e-12)


def exact_posterior(cov: Array, rows: list[tuple[Array, float]]) -> list[list[Fraction]]:
    """Covariance of a linear update in rational arithmetic, row by row."""
    P = [[Fraction(value) for value in line] for line in cov.tolist()]
    n = len(P)
    for h_float, r in rows:
        h = [Fraction(value) for value in h_float.tolist()]
        Ph = [sum(P[i][j] * h[j] for j in range(n)) for i in range(n)]
        s = sum(h[i] * Ph[i] for i in range(n)) + Fraction(r)
        P = [[P[i][j] - Ph[i] * Ph[j] / s for j in range(n)] for i in range(n)]
    return P


def test_digits_where_the_plain_filter_has_none(row: Maker) -> None:
    """Variances 1e10 are measured to 1e-10, then a second row sees their difference. The factor is
    right to 1e-6; P - K S K', and the Joseph form, have lost everything."""
    prior = np.diag([1e5, 1e5, 1.0, 1.0, 1e5, 1e-5])
    prior[1, 0] = 3e4
    h = [
        np.array([1.0, 0, 0, 0, 0, 0]),
        np.array([1.0, 1, 0, 0, 0, 0]),
        np.array([0, 1.0, 0, 0, 1, 0]),
    ]
    rows = np.array([row(Kind.LINEAR, 0.0, 1e-10, 0, h=h_row) for h_row in h])
    exact = exact_posterior(prior @ prior.T, [(h_row, 1e-10) for h_row in h])
    sd = np.array([math.sqrt(exact[i][i]) for i in range(6)])
    expected = np.array([[float(value) for value in line] for line in exact]) / np.outer(sd, sd)
    L = prior.copy()
    srukf.update(np.zeros(6), L, rows, 0.0, OPEN, np.zeros(1))
    scaled = L / sd[:, None]
    np.testing.assert_allclose(scaled @ scaled.T, expected, rtol=1e-9, atol=1e-6)
    assert np.linalg.eigvalsh(scaled @ scaled.T).min() > 0.0
    P, H = prior @ prior.T, np.array(h)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 1e-10 * np.eye(3))
    plain = P - K @ (H @ P @ H.T + 1e-10 * np.eye(3)) @ K.T
    assert np.linalg.eigvalsh(plain).min() < -1e-9
    assert np.abs(plain / np.outer(sd, sd) - expected).max() > 1.0


def test_ten_thousand_steps(row: Maker) -> None:
    """The factor and the textbook drift apart by rounding only, and the factor keeps its shape."""
    rng = np.random.default_rng(9)
    motion = motion_parameters(noise=ProcessNoise.WHITE_ACCELERATION, accel=0.5, drift_step=1e-3)
    truth = np.array([0.0, 0.0, 1.0, 0.5, 20.0, 0.0])
    mean, cov = truth + rng.normal(size=6), np.diag([25.0, 25, 4, 4, 100, 1])
    other, L, accepted = mean.copy(), np.sqrt(cov), np.zeros(2)
    rows = epoch(row)
    rows[3, 4] = -1.0
    sd = np.sqrt(rows[:, 2])
    for step in range(10_000):
        angle = step * 2e-3
        p = 40.0 * np.array([math.cos(angle), math.sin(angle)])
        for i in (0, 2):
            d = np.array([*p, 1.5]) - rows[i, 7:10]
            rows[i, 1] = math.atan2(d[1], d[0]) + sd[i] * rng.normal()
            rows[i + 1, 1] = math.sqrt(d @ d) + 20.0 * (i == 0) + sd[i + 1] * rng.normal()
        mean, cov = textbook_predict(mean, cov, 0.1, motion, NO_BIAS)
        srukf.predict(other, L, 0.1, motion, NO_BIAS)
        mean, cov = textbook_update(mean, cov, rows)
        srukf.update(other, L, rows, 1.5, OPEN, accepted)
    np.testing.assert_allclose(other, mean, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(L @ L.T, cov, rtol=1e-9, atol=1e-8)
    assert is_lower_factor(L)
    assert (np.diag(L) > 1e-4).all()
    assert np.hypot(*(mean[POSITION] - p)) < 2.0
