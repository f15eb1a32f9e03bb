"""The square-root filter against the plain one, exact arithmetic and petukhov's down-dates."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from netpos.estimation import sigma
from netpos.estimation.forms import srukf, ukf
from netpos.estimation.measurement import Kind
from netpos.estimation.motion import NO_BIAS, Model, Parameter, ProcessNoise, motion_parameters
from netpos.estimation.state import POSITION
from netpos.messages.values import Array

Maker = Callable[..., Array]
OPEN = np.array([np.inf])


def epoch(row: Maker) -> Array:
    near, far = (50.0, 10.0, 6.0), (-30.0, 60.0, 6.0)
    return np.array(
        [
            row(Kind.AZIMUTH, 2.9, 0.002, 0, origin=near, gate_variance=0.001),
            row(Kind.TOA, 75.0, 4.0, 0, origin=near),
            row(Kind.AZIMUTH, -1.1, 0.003, 1, origin=far),
            row(Kind.RANGE, 70.0, 2.0, 1, origin=far, bias=6, gate_variance=5.0),
        ]
    )


def is_lower_factor(L: Array) -> bool:
    return bool((np.triu(L, 1) == 0.0).all() and (np.diag(L) >= 0.0).all())


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("n", [1, 2, 6, 12])
def test_up_and_down_date(n: int, sign: float, random_cov: Maker) -> None:
    rng = np.random.default_rng(n)
    x, P = rng.normal(size=n), random_cov(rng, n)
    if sign < 0.0:
        P += np.outer(x, x)
    L = np.linalg.cholesky(P)
    assert srukf.cholesky_update(L, x.copy(), sign)
    np.testing.assert_allclose(
        L, np.linalg.cholesky(P + sign * np.outer(x, x)), rtol=1e-9, atol=1e-12
    )
    assert is_lower_factor(L)


def test_down_date_to_the_edge(random_cov: Maker) -> None:
    """Refused where the result would be singular or worse, and L is left alone."""
    L = np.linalg.cholesky(random_cov(np.random.default_rng(4), 5))
    inside = L @ np.array([0.0, 0.6, 0.0, 0.0, 0.8])
    for scale, possible in ((1.0 - 1e-9, True), (1.0, False), (1.0 + 1e-9, False)):
        down = L.copy()
        assert srukf.cholesky_update(down, scale * inside, -1.0) is possible
        assert possible or (down == L).all()
    known = np.diag([1.0, 0.0])  # nothing can be taken from what is known
    assert not srukf.cholesky_update(known, np.array([0.5, 0.1]), -1.0)
    assert (known == np.diag([1.0, 0.0])).all()
    assert srukf.cholesky_update(known, np.array([0.6, 0.0]), -1.0)
    np.testing.assert_allclose(known, np.diag([0.8, 0.0]), rtol=1e-15)


def test_factor_of_singular_covariances() -> None:
    """White acceleration has rank one per axis, the paper's noise no position at all."""
    w = np.array([0.005, 0.0, 0.1, 0.0, 0.0, 0.0])
    for cov in (np.outer(w, w), np.diag([0.0, 0.0, 1.0, 4.0, 0.0, 9.0]), np.zeros((6, 6))):
        L = srukf.factor(cov)
        assert is_lower_factor(L)
        np.testing.assert_allclose(srukf.covariance(L), cov, rtol=1e-9, atol=1e-18)
        assert np.linalg.matrix_rank(L) == np.linalg.matrix_rank(cov)


def test_factor_equals_cholesky(random_cov: Maker) -> None:
    cov = random_cov(np.random.default_rng(5), 9, 100.0)
    np.testing.assert_allclose(srukf.factor(cov), np.linalg.cholesky(cov), rtol=1e-12)


@pytest.mark.parametrize("kind", list(ProcessNoise))
@pytest.mark.parametrize("model", [Model.CONSTANT_VELOCITY, Model.CONSTANT_TURN])
def test_predict_equals_the_plain_filter(
    model: Model, kind: ProcessNoise, random_cov: Maker
) -> None:
    rng = np.random.default_rng(1)
    motion = motion_parameters(
        model, kind, accel=1.0, velocity_step=0.3, drift_step=0.1, turn_rate=0.1
    )
    n = 6 + int(motion[Parameter.EXTRAS]) + 1
    mean, cov = rng.normal(size=n), random_cov(rng, n)
    other, L = mean.copy(), np.linalg.cholesky(cov)
    bias = np.array([[2.0], [30.0]])
    ukf.predict(mean, cov, 0.4, motion, bias)
    srukf.predict(other, L, 0.4, motion, bias)
    np.testing.assert_allclose(other, mean, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(L @ L.T, cov, rtol=1e-11, atol=1e-11)
    assert is_lower_factor(L)


@pytest.mark.parametrize("dt", [0.0, -1.0])
def test_nothing_moves_without_time(dt: float) -> None:
    mean, L = np.arange(6.0), np.diag(np.arange(1.0, 7.0))
    srukf.predict(mean, L, dt, motion_parameters(accel=1.0), NO_BIAS)
    assert (mean == np.arange(6.0)).all()
    assert (np.diag(np.arange(1.0, 7.0)) == L).all()


@pytest.mark.parametrize("gate_nis", [OPEN, np.array([0.0, 1.0, 30.0])])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("n", [7, 13])
def test_update_equals_the_plain_filter(
    n: int, seed: int, gate_nis: Array, row: Maker, random_cov: Maker
) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, rows = rng.normal(size=n), random_cov(rng, n, 3.0), epoch(row)
    other, L = mean.copy(), np.linalg.cholesky(cov)
    accepted, other_accepted = np.full(2, 9.0), np.full(2, 8.0)
    nis, dof = ukf.update(mean, cov, rows, 1.5, gate_nis, accepted)
    assert srukf.update(other, L, rows, 1.5, gate_nis, other_accepted) == (
        pytest.approx(nis, rel=1e-9),
        dof,
    )
    np.testing.assert_allclose(other, mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(L @ L.T, cov, rtol=1e-9, atol=1e-9)
    assert accepted.tolist() == other_accepted.tolist()
    assert is_lower_factor(L)


def test_nothing_accepted_nothing_changed(row: Maker, random_cov: Maker) -> None:
    rng = np.random.default_rng(0)
    mean, L = rng.normal(size=7), np.linalg.cholesky(random_cov(rng, 7))
    before, L_before, accepted = mean.copy(), L.copy(), np.ones(2)
    assert srukf.update(mean, L, epoch(row), 1.5, np.array([0.0]), accepted) == (0.0, 0)
    assert (mean == before).all()
    assert (L_before == L).all()
    assert accepted.tolist() == [0.0, 0.0]


def test_update_equals_petukhovs_down_dates(row: Maker, random_cov: Maker) -> None:
    """petukhov:eq.26 with the factor of S it omits: L down-dated by the columns of K S_y."""
    rng = np.random.default_rng(3)
    mean, rows = rng.normal(size=7), epoch(row)
    L = np.linalg.cholesky(random_cov(rng, 7))
    _, G, E = sigma.regress(mean, L, rows, 1.5)
    S_factor = np.linalg.cholesky(G @ G.T + E @ E.T + np.diag(rows[:, 2]))
    K_S = L @ G.T @ np.linalg.inv(S_factor).T
    down = L.copy()
    for column in K_S.T:
        assert srukf.cholesky_update(down, column.copy(), -1.0)
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
    """Both forms drift apart by rounding only, and keep their shape."""
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
        ukf.predict(mean, cov, 0.1, motion, NO_BIAS)
        srukf.predict(other, L, 0.1, motion, NO_BIAS)
        ukf.update(mean, cov, rows, 1.5, OPEN, accepted)
        srukf.update(other, L, rows, 1.5, OPEN, accepted)
    np.testing.assert_allclose(other, mean, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(L @ L.T, cov, rtol=1e-9, atol=1e-8)
    assert is_lower_factor(L)
    assert (np.diag(L) > 1e-4).all()
    assert np.hypot(*(mean[POSITION] - p)) < 2.0


def test_an_epoch_without_rows(row: Maker) -> None:
    mean, P = np.arange(6.0), 2.0 * np.eye(6)
    rows = np.array([row(Kind.RANGE, 1.0, 1.0)])[:0]
    assert srukf.update(mean, P, rows, 0.0, OPEN, np.zeros(0)) == (0.0, 0)
    assert mean.tolist() == [0, 1, 2, 3, 4, 5]
    assert (2.0 * np.eye(6) == P).all()
