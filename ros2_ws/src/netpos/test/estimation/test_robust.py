"""Robust weights and the mixture for late ranges, against brute-force integration and Gaussian
sums."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.estimation.update import robust
from netpos.messages.values import Array
from scipy import integrate, optimize, special, stats

# S, R, prior, mean excess
MIXTURES = [
    (1.0, 0.09, 0.2, 10.0),
    (4.0, 1.0, 0.5, 5.0),
    (25.0, 0.25, 0.05, 30.0),
    (0.3, 0.2999, 0.3, 1.0),
]
INNOVATIONS = [-3.0, -0.5, 0.0, 0.7, 2.0, 3.5, 6.0, 12.0]


# weights


def test_huber_is_one_in_the_middle_and_linear_beyond() -> None:
    assert robust.huber_factor(0.0, 1, 1.345) == 1.0
    assert robust.huber_factor(1.345**2 * (1 - 1e-12), 1, 1.345) == 1.0
    assert robust.huber_factor(100.0, 1, 1.345) == pytest.approx(10.0 / 1.345)
    assert robust.huber_factor(4 * 1.345**2, 4, 1.345) == pytest.approx(1.0)
    assert robust.huber_factor(4 * 100.0, 4, 1.345) == pytest.approx(10.0 / 1.345)


def test_reweighting_with_huber_finds_the_minimum_of_its_cost() -> None:
    """The fixed point of weighted means is Huber's location estimate, minimised here directly."""
    rng = np.random.default_rng(3)
    z = np.append(rng.normal(size=20), [9.0, 12.0, -30.0])
    k, x = 1.345, 0.0
    for _ in range(200):
        w = np.array([1.0 / robust.huber_factor((v - x) ** 2, 1, k) for v in z])
        x = float((w * z).sum() / w.sum())

    def cost(x: float) -> float:
        r = np.abs(z - x)
        return float(np.where(r <= k, r * r / 2, k * r - k * k / 2).sum())

    assert x == pytest.approx(optimize.minimize_scalar(cost, tol=1e-12).x, abs=1e-6)


@pytest.mark.parametrize(("m", "nu"), [(1, 3.0), (2, 4.0), (5, 1.0)])
def test_reweighting_with_student_t_finds_the_most_likely_location(m: int, nu: float) -> None:
    rng = np.random.default_rng(4)
    z = stats.multivariate_t(shape=np.eye(m), df=nu, seed=rng).rvs(30).reshape(30, m)
    x = np.zeros(m)
    for _ in range(500):
        w = np.array([1.0 / robust.student_t_factor(float((v - x) @ (v - x)), m, nu) for v in z])
        x = (w[:, None] * z).sum(axis=0) / w.sum()
    t = stats.multivariate_t(shape=np.eye(m), df=nu)
    best = optimize.minimize(lambda x: -np.atleast_1d(t.logpdf(z - x)).sum(), x, tol=1e-12)
    np.testing.assert_allclose(x, best.x, atol=1e-5)


def test_student_t_factor_is_the_inverse_of_the_expected_weight() -> None:
    """Posterior mean of the gamma weight by numerical integration."""
    m, nu, d2 = 2, 4.0, 13.0

    def posterior(w: float) -> float:
        return (
            float(stats.gamma.pdf(w, nu / 2, scale=2 / nu)) * w ** (m / 2) * math.exp(-w * d2 / 2)
        )

    norm = integrate.quad(posterior, 0, np.inf)[0]
    mean = integrate.quad(lambda w: w * posterior(w), 0, np.inf)[0] / norm
    assert robust.student_t_factor(d2, m, nu) == pytest.approx(1.0 / mean, rel=1e-7)


# the mixture


def brute_force(
    r: float, S: float, R: float, prior: float, blocked: stats.rv_continuous
) -> tuple[float, float, float]:
    """Probability of a blocked path, mean and variance of the prior error by integration over it.

    ``blocked``: distribution of noise + excess.
    """
    A = S - R
    x = np.linspace(-14, 14, 400_001) * math.sqrt(A)
    p0 = (1 - prior) * stats.norm.pdf(x, 0, math.sqrt(A)) * stats.norm.pdf(r - x, 0, math.sqrt(R))
    p1 = prior * stats.norm.pdf(x, 0, math.sqrt(A)) * blocked.pdf(r - x)
    total = (p0 + p1).sum()
    mean = float((x * (p0 + p1)).sum() / total)
    return float(p1.sum() / total), mean, float(((x - mean) ** 2 * (p0 + p1)).sum() / total)


def check_posterior(
    r: float, S: float, R: float, excess: tuple[float, float, float], expected: tuple[float, ...]
) -> None:
    """(M) and the equivalent measurement give the moments ``expected``."""
    A = S - R
    probability, E, V = excess
    assert probability == pytest.approx(expected[0], rel=1e-6, abs=1e-12)
    assert A / S * (r - E) == pytest.approx(expected[1], rel=1e-6, abs=1e-9)
    posterior_var = A - A * A / S + (A / S) ** 2 * V
    assert posterior_var == pytest.approx(expected[2], rel=1e-6)
    shift, variance = robust.equivalent_measurement(r, S, R, E, V)
    if math.isinf(variance):
        assert V >= S * (1 - 1e-3)
        assert expected[2] >= A * (1 - 1e-3)
        return
    gain = A / (A + variance)
    assert variance >= R * (1 - 1e-12)
    assert gain * (r - shift) == pytest.approx(expected[1], rel=1e-6, abs=1e-9)
    assert (1 - gain) * A == pytest.approx(expected[2], rel=1e-6)


@pytest.mark.parametrize(("S", "R", "prior", "mean"), MIXTURES)
@pytest.mark.parametrize("r", INNOVATIONS)
def test_exponential_excess_by_integration(
    r: float, S: float, R: float, prior: float, mean: float
) -> None:
    blocked = stats.exponnorm(mean / math.sqrt(R), scale=math.sqrt(R))
    expected = brute_force(r, S, R, prior, blocked)
    check_posterior(r, S, R, robust.exponential_excess(r, S, prior, mean), expected)


def kalman(x: Array, P: Array, h: Array, z: float, R: float) -> tuple[Array, Array]:
    S = float(h @ P @ h) + R
    K = P @ h / S
    return x + K * (z - float(h @ x)), P - np.outer(K, K) * S


def test_the_whole_state_is_the_moment_matched_gaussian_sum() -> None:
    """Kalman updates for no excess and for 20 000 excesses, weighted and moment-matched. (M) and
    the update with the equivalent measurement agree."""
    rng = np.random.default_rng(5)
    L = rng.normal(size=(4, 4))
    P, x, h = L @ L.T, rng.normal(size=4), rng.normal(size=4)
    R, prior, mean = 0.3, 0.2, 8.0
    S = float(h @ P @ h) + R
    K = P @ h / S
    excess = np.append(0.0, (np.arange(20_000) + 0.5) * 120.0 / 20_000)
    share = np.append(1 - prior, prior * stats.expon.pdf(excess[1:], scale=mean) * 120.0 / 20_000)
    for r in (0.5, 3.0, 20.0):
        w = share * stats.norm.pdf(r - excess, 0, math.sqrt(S))
        w /= w.sum()
        means = x + np.outer(r - excess, K)
        m = w @ means
        C = P - np.outer(K, K) * S + (means - m).T @ (w[:, None] * (means - m))
        probability, E, V = robust.exponential_excess(r, S, prior, mean)
        assert probability == pytest.approx(1 - w[0], rel=1e-5)
        np.testing.assert_allclose(x + K * (r - E), m, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(P + np.outer(K, K) * (V - S), C, rtol=1e-5, atol=1e-5)
        p2, shift, variance = robust.nlos_mixture_exponential(r, S, R, prior, mean)
        assert p2 == probability
        if math.isfinite(variance):
            x2, P2 = kalman(x, P, h, float(h @ x) + r - shift, variance)
            np.testing.assert_allclose(x2, m, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(P2, C, rtol=1e-5, atol=1e-5)


def test_joseph_form_with_the_variance_of_the_excess() -> None:
    """Gain of the plain R, noise term K (R + V) K': the covariance of (M)."""
    rng = np.random.default_rng(6)
    L = rng.normal(size=(3, 3))
    P, h, R, V = L @ L.T, rng.normal(size=3), 0.4, 7.0
    S = float(h @ P @ h) + R
    K = P @ h / S
    F = np.eye(3) - np.outer(K, h)
    joseph = F @ P @ F.T + np.outer(K, K) * (R + V)
    np.testing.assert_allclose(joseph, P + np.outer(K, K) * (V - S), rtol=1e-10, atol=1e-12)


def test_rival_explanations_have_no_equivalent_measurement() -> None:
    """Between the direct path and a far one the posterior is wider than the prior."""
    S, R, prior, mean = 1.0, 0.5, 0.02, 10.0
    found = [
        robust.nlos_mixture_exponential(r, S, R, prior, mean) for r in np.linspace(-2, 12, 241)
    ]
    assert any(math.isinf(variance) for _, _, variance in found)
    p, shift, _ = next(f for f in found if math.isinf(f[2]))
    assert 0.05 < p < 0.95
    assert 0.0 < shift < 12.0
    assert found[0][2] == pytest.approx(R, rel=1e-2)
    assert found[-1][0] > 0.999


def test_without_a_prior_nothing_changes() -> None:
    for r in (-5.0, 0.0, 8.0):
        plain = robust.nlos_mixture_exponential(r, 2.0, 0.5, 0.0, 10.0)
        assert plain == pytest.approx((0.0, 0.0, 0.5))


def test_an_early_range_is_never_blocked_by_an_exponential_excess() -> None:
    early = [robust.exponential_excess(-k, 1.0, 0.5, 10.0)[0] for k in (0.0, 2.0, 5.0, 20.0, 1e3)]
    assert early == sorted(early, reverse=True)
    assert early[0] < 0.12
    assert early[-1] < 1e-4


@settings(max_examples=300, deadline=None)
@given(
    r=st.floats(-1e6, 1e6),
    S=st.floats(1e-8, 1e8),
    share=st.floats(1e-6, 1.0),
    prior=st.floats(0.0, 1.0),
    mean=st.floats(1e-3, 1e4),
)
def test_results_are_sound_whatever_comes(
    r: float, S: float, share: float, prior: float, mean: float
) -> None:
    R = share * S
    p, E, V = robust.exponential_excess(r, S, prior, mean)
    assert 0.0 <= p <= 1.0
    assert min(E, V) >= 0.0
    shift, variance = robust.equivalent_measurement(r, S, R, E, V)
    assert math.isfinite(E)
    assert math.isfinite(shift)
    assert variance >= R * (1 - 1e-9)


@pytest.mark.parametrize(
    "z", [-1e6, -1e3, -40.001, -39.999, -20.0, -5.001, -4.999, -1.0, 0.0, 30.0]
)
def test_truncated_normal_in_its_tails(z: float) -> None:
    """scipy's truncnorm, and its exponential limit where that gives up."""
    _, mean, variance = robust.exponential_excess(z + 1e-9, 1.0, 1.0, 1e9)
    if z > -35.0:
        cut = stats.truncnorm(-z, np.inf, loc=z)
        assert mean == pytest.approx(cut.mean(), rel=1e-7)
        assert variance == pytest.approx(cut.var(), rel=1e-6)
    else:
        x = -z
        assert mean == pytest.approx((1 / x) * (1 - 2 / x**2 + 10 / x**4), rel=1e-6)
        assert variance == pytest.approx(1 / x**2 - 6 / x**4 + 50 / x**6, rel=1e-6)


# adaptive prior


@pytest.mark.parametrize("z", [-1e3, -60.0, -40.01, -39.99, -5.01, -4.99, 3.0])
def test_mills_ratio_is_scipys(z: float) -> None:
    expected = special.log_ndtr(z) - stats.norm.logpdf(z)
    assert robust._log_mills(z) == pytest.approx(expected, rel=1e-12, abs=5e-9)


def test_prior_follows_and_comes_back() -> None:
    a0, b0 = 2.0, 18.0
    a, b = a0, b0
    for _ in range(400):
        a, b = robust.update_prior(a, b, 1.0, 0.98, a0, b0)
    assert a / (a + b) == pytest.approx((a0 + 50.0) / (a0 + b0 + 50.0), rel=1e-3)
    for _ in range(1000):
        a, b = robust.update_prior(a, b, 0.0, 0.98, a0, b0)
    assert a / (a + b) == pytest.approx(a0 / (a0 + b0 + 50.0), rel=1e-6)


def test_prior_without_forgetting_is_the_beta_posterior() -> None:
    a, b = 2.0, 3.0
    for blocked in (1.0, 0.0, 0.0, 1.0, 1.0):
        a, b = robust.update_prior(a, b, blocked, 1.0, 2.0, 3.0)
    assert (a, b) == (5.0, 5.0)


def test_prior_learns_the_share_of_blocked_paths() -> None:
    """Simulated ranges of a fixed share of blocked paths, judged by the mixture itself."""
    rng = np.random.default_rng(8)
    a, b, share = 1.0, 9.0, 0.4
    seen = []
    for k in range(3000):
        excess = rng.exponential(15.0) if rng.random() < share else 0.0
        r = rng.normal() + excess
        p, _, _ = robust.exponential_excess(r, 1.0, a / (a + b), 15.0)
        a, b = robust.update_prior(a, b, p, 0.995, 1.0, 9.0)
        if k > 1000:
            seen.append(a / (a + b))
    assert np.mean(seen) == pytest.approx(share, abs=0.03)


def test_a_filter_with_the_mixture_is_consistent() -> None:
    """A random walk ranged with 30 % blocked paths: (M) leaves no bias and an honest variance,
    where the plain update is far off."""
    rng = np.random.default_rng(9)
    n, q, R, mean = 8000, 0.02, 0.25, 15.0
    truth = np.cumsum(rng.normal(0, math.sqrt(q), n))
    blocked = rng.random(n) < 0.3
    z = truth + rng.normal(0, math.sqrt(R), n) + np.where(blocked, rng.exponential(mean, n), 0.0)
    for mixture in (True, False):
        x, P, a, b = 0.0, 1.0, 1.0, 9.0
        errors, nees = [], []
        for k in range(n):
            P += q
            r, S = z[k] - x, P + R
            p, E, V = robust.exponential_excess(r, S, a / (a + b) if mixture else 0.0, mean)
            a, b = robust.update_prior(a, b, p, 0.99, 1.0, 9.0)
            x += P / S * (r - E)
            P += (P / S) ** 2 * (V - S)
            errors.append(x - truth[k])
            nees.append(errors[-1] ** 2 / P)
        if mixture:
            assert abs(np.mean(errors)) < 0.03
            assert np.mean(nees) == pytest.approx(1.0, abs=0.15)
        else:
            assert np.mean(errors) > 4.0


@pytest.mark.parametrize("innovation", [-0.4, 0.3, 1.5, 6.0])
def test_a_blocked_path_alone_by_integration(innovation: float) -> None:
    """How much likelier a blocked path is, and the moments of its excess, from sums."""
    total, mean_m = 0.34, 2.0
    excess = np.linspace(0.0, 40.0, 400_001)
    density = stats.norm.pdf(innovation - excess, scale=math.sqrt(total))
    density *= np.exp(-excess / mean_m) / mean_m
    evidence = integrate.trapezoid(density, excess)
    expected = integrate.trapezoid(excess * density, excess) / evidence
    variance = integrate.trapezoid((excess - expected) ** 2 * density, excess) / evidence
    found = robust.blocked_excess(innovation, total, mean_m)
    direct = stats.norm.pdf(innovation, scale=math.sqrt(total))
    assert found[0] == pytest.approx(math.log(evidence / direct), abs=1e-6)
    assert found[1:] == pytest.approx((expected, variance), rel=1e-5)


@pytest.mark.parametrize("blocked", [0.0, 0.2, 0.7, 1.0])
def test_cost_of_one_gaussian_for_both_paths_is_runnalls_bound(blocked: float) -> None:
    """From the covariances of three states, of which one range sees two."""
    rng = np.random.default_rng(2)
    B = rng.normal(size=(3, 3))
    P, h, noise = B @ B.T + np.eye(3), np.array([0.6, -0.8, 0.0]), 0.04
    total = float(h @ P @ h) + noise
    K = P @ h / total
    direct = P - np.outer(K, K) * total
    mean, variance = 1.7, 0.6
    both = blocked * variance + blocked * (1.0 - blocked) * mean**2
    log_dets = [np.linalg.slogdet(direct + np.outer(K, K) * v)[1] for v in (both, variance, 0.0)]
    expected = log_dets[0] - blocked * log_dets[1] - (1.0 - blocked) * log_dets[2]
    cost = robust.matching_cost(blocked, mean, variance, total, noise)
    assert cost == pytest.approx(0.5 * expected, rel=1e-9, abs=1e-12)
