"""Fusion of two estimates against sampled errors, closed forms and a general minimiser."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from netpos.estimation.intersection import METHODS, fuse_pair
from netpos.messages.values import Array
from scipy.optimize import minimize_scalar

Maker = Callable[..., Array]
N = 4


def joint(rng: np.random.Generator, correlation: float) -> Array:
    """Covariance (2 N, 2 N) of two errors; ``correlation`` in [0, 1): how much they share."""
    root = rng.normal(size=(2 * N, 2 * N)) / np.sqrt(2 * N)
    own = root @ root.T + 0.1 * np.eye(2 * N)
    own[:N, N:] = own[N:, :N] = 0.0
    shared = rng.normal(size=(N, N))
    common = np.tile(shared @ shared.T, (2, 2))
    mixed: Array = (1.0 - correlation) * own + correlation * common
    return mixed


def true_cov(gain_a: Array, gain_b: Array, both: Array) -> Array:
    gains = np.hstack([gain_a, gain_b])
    result: Array = gains @ both @ gains.T
    return result


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", range(3))
def test_gains_add_up_to_one(method: str, seed: int, random_cov: Maker) -> None:
    """What both know is kept: the fusion has no bias."""
    rng = np.random.default_rng(seed)
    a, b = random_cov(rng, N), random_cov(rng, N)
    pair = fuse_pair(a, 0.3 * a, b, 0.6 * b, method)
    np.testing.assert_allclose(pair.gain_a + pair.gain_b, np.eye(N), atol=1e-9)
    assert (pair.cov == pair.cov.T).all()
    assert np.linalg.eigvalsh(pair.cov)[0] > 0.0


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.95])
@pytest.mark.parametrize("seed", range(5))
def test_ci_is_never_overconfident(seed: int, correlation: float) -> None:
    both = joint(np.random.default_rng(seed), correlation)
    zero = np.zeros((N, N))
    pair = fuse_pair(both[:N, :N], zero, both[N:, N:], zero, "ci")
    spare = pair.cov - true_cov(pair.gain_a, pair.gain_b, both)
    assert np.linalg.eigvalsh(spare)[0] > -1e-9


def test_independent_is_overconfident_where_errors_are_shared() -> None:
    both = joint(np.random.default_rng(1), 0.9)
    zero = np.zeros((N, N))
    pair = fuse_pair(both[:N, :N], zero, both[N:, N:], zero, "independent")
    spare = pair.cov - true_cov(pair.gain_a, pair.gain_b, both)
    assert np.linalg.eigvalsh(spare)[0] < -0.1


@pytest.mark.parametrize("seed", range(5))
def test_split_ci_is_honest_and_better_than_ci(seed: int) -> None:
    """Own parts are independent, the rest is the same error twice: the worst case."""
    rng = np.random.default_rng(seed)
    both = joint(rng, 0.5)
    shared = both[:N, N:]
    own_a, own_b = both[:N, :N] - shared, both[N:, N:] - shared
    a, b = both[:N, :N], both[N:, N:]
    pair = fuse_pair(a, own_a, b, own_b, "split_ci")
    spare = pair.cov - true_cov(pair.gain_a, pair.gain_b, both)
    assert np.linalg.eigvalsh(spare)[0] > -1e-9
    zero = np.zeros((N, N))
    plain = fuse_pair(a, zero, b, zero, "ci")
    assert np.linalg.slogdet(pair.cov)[1] < np.linalg.slogdet(plain.cov)[1]
    expected = pair.gain_a @ own_a @ pair.gain_a.T + pair.gain_b @ own_b @ pair.gain_b.T
    np.testing.assert_allclose(pair.own, expected, atol=1e-12)


def test_split_ci_at_its_ends(random_cov: Maker) -> None:
    """All own: independent. Nothing own: covariance intersection."""
    rng = np.random.default_rng(4)
    a, b, zero = random_cov(rng, N), random_cov(rng, N), np.zeros((N, N))
    exact = np.linalg.inv(np.linalg.inv(a) + np.linalg.inv(b))
    np.testing.assert_allclose(fuse_pair(a, a, b, b, "split_ci").cov, exact, rtol=1e-9)
    np.testing.assert_allclose(fuse_pair(a, zero, b, zero, "independent").cov, exact, rtol=1e-9)
    split, plain = (fuse_pair(a, zero, b, zero, name) for name in ("split_ci", "ci"))
    np.testing.assert_allclose(split.cov, plain.cov, rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_ci_weight_is_that_of_a_general_minimiser(seed: int, random_cov: Maker) -> None:
    rng = np.random.default_rng(seed)
    a, b, zero = random_cov(rng, N), random_cov(rng, N), np.zeros((N, N))

    def log_det(w: float) -> float:
        information = w * np.linalg.inv(a) + (1.0 - w) * np.linalg.inv(b)
        return float(-np.linalg.slogdet(information)[1])

    best = minimize_scalar(log_det, bounds=(0.0, 1.0), method="bounded")
    pair = fuse_pair(a, zero, b, zero, "ci")
    assert np.linalg.slogdet(pair.cov)[1] == pytest.approx(float(best.fun), abs=1e-4)
    assert pair.weight == pytest.approx(float(best.x), abs=5e-3)


@pytest.mark.parametrize("seed", range(4))
def test_ici_is_honest_about_an_estimate_both_have_fused(seed: int, random_cov: Maker) -> None:
    """Noack 2017: both took the same estimate in; ICI is then tighter than CI and honest."""
    rng = np.random.default_rng(seed)
    common, own_a, own_b = (random_cov(rng, N) for _ in range(3))
    a = np.linalg.inv(np.linalg.inv(own_a) + np.linalg.inv(common))
    b = np.linalg.inv(np.linalg.inv(own_b) + np.linalg.inv(common))
    both = np.block([[a, a @ np.linalg.inv(common) @ b], [b @ np.linalg.inv(common) @ a, b]])
    zero = np.zeros((N, N))
    pair = fuse_pair(a, zero, b, zero, "ici")
    spare = pair.cov - true_cov(pair.gain_a, pair.gain_b, both)
    assert np.linalg.eigvalsh(spare)[0] > -1e-9
    plain = fuse_pair(a, zero, b, zero, "ci")
    assert np.linalg.slogdet(pair.cov)[1] <= np.linalg.slogdet(plain.cov)[1] + 1e-9


def test_ici_gains_of_the_paper(random_cov: Maker) -> None:
    """Noack 2017, eq. 11 and 12: K = P (A^-1 - w G^-1), L = P (B^-1 - (1 - w) G^-1)."""
    rng = np.random.default_rng(11)
    a, b, zero = random_cov(rng, N), 2.0 * random_cov(rng, N), np.zeros((N, N))
    pair = fuse_pair(a, zero, b, zero, "ici")
    G = pair.weight * a + (1.0 - pair.weight) * b
    assert abs(pair.weight - 0.5) > 0.05
    K = np.linalg.solve(np.linalg.inv(pair.cov), np.linalg.inv(a) - pair.weight * np.linalg.inv(G))
    np.testing.assert_allclose(pair.gain_a, K, rtol=1e-6, atol=1e-9)


def test_a_worse_copy_adds_nothing_to_ci() -> None:
    a, zero = np.diag([1.0, 4.0, 9.0, 1.0]), np.zeros((N, N))
    pair = fuse_pair(a, zero, 10.0 * a, zero, "ci")
    np.testing.assert_allclose(pair.cov, a, rtol=1e-5)
    np.testing.assert_allclose(pair.gain_a, np.eye(N), atol=1e-5)


def test_unknown_method_and_singular_covariance() -> None:
    eye, zero = np.eye(2), np.zeros((2, 2))
    with pytest.raises(ValueError, match=r"fusion method must be one of .*, got 'mean'"):
        fuse_pair(eye, zero, eye, zero, "mean")
    with pytest.raises(np.linalg.LinAlgError):
        fuse_pair(zero, zero, eye, zero, "ci")
