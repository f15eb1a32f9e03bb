"""Protection level against integration, Monte Carlo and its limits; what widens it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.messages.values import Array
from netpos.tracking.protection import (
    RISK_MIN,
    NisWindow,
    bias_shift,
    faulted_level,
    protection_level,
)
from scipy import integrate, optimize, stats

RISKS = [0.5, 0.1, 1e-2, 1e-4, 1e-7, 1e-12]


def exceedance(sd_x: float, sd_y: float, r: float) -> float:
    """P(|e| > r) of independent components: the tail in x, and for each x inside the tail in y."""

    def tail_in_y(t: float) -> float:
        x = r * math.sin(t)
        return (2 * stats.norm.pdf(x, 0, sd_x) * 2 * stats.norm.sf(r * math.cos(t), 0, sd_y)) * (
            r * math.cos(t)
        )

    inside, _ = integrate.quad(tail_in_y, 0.0, math.pi / 2, epsabs=0.0, epsrel=1e-10, limit=400)
    return float(2 * stats.norm.sf(r, 0, sd_x) + inside)


def rotated(sd_x: float, sd_y: float, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    cov: Array = R @ np.diag([sd_x**2, sd_y**2]) @ R.T
    return cov


@pytest.mark.parametrize("risk", RISKS)
@pytest.mark.parametrize("ratio", [1.0, 0.8, 0.3, 0.1, 0.02])
def test_radius_against_integration(risk: float, ratio: float) -> None:
    level = protection_level(rotated(3.0, 3.0 * ratio, 0.7), risk)
    low, high = 3.0 * stats.norm.isf(risk / 2), 3.0 * math.sqrt(-2 * math.log(risk))
    log_risk = math.log(risk)
    expected = optimize.brentq(
        lambda r: math.log(exceedance(3.0, 3.0 * ratio, r)) - log_risk,
        low * 0.999,
        high * 1.001,
        xtol=1e-12,
    )
    assert level == pytest.approx(expected, rel=1e-5 if risk > 0.01 else 1e-9)


@pytest.mark.parametrize("risk", RISKS)
def test_limits(risk: float) -> None:
    circular = protection_level(4.0 * np.eye(2), risk)
    assert circular == pytest.approx(2.0 * math.sqrt(-2 * math.log(risk)), rel=1e-10)
    line = protection_level(rotated(2.0, 0.0, 1.1), risk)
    assert line == pytest.approx(2.0 * stats.norm.isf(risk / 2), rel=1e-5)
    assert protection_level(np.zeros((2, 2)), risk) == 0.0


def test_monte_carlo() -> None:
    rng = np.random.default_rng(11)
    cov = rotated(1.5, 0.4, 2.0)
    errors = np.linalg.norm(rng.multivariate_normal(np.zeros(2), cov, size=1_000_000), axis=1)
    for risk in (0.3, 1e-2, 1e-3):
        count = int((errors > protection_level(cov, risk)).sum())
        low, high = stats.binom.interval(0.9999, errors.size, risk)
        assert low <= count <= high


@settings(max_examples=200, deadline=None)
@given(
    sd_x=st.floats(1e-3, 1e4),
    ratio=st.floats(0.0, 1.0),
    angle=st.floats(0.0, math.pi),
    risk=st.floats(RISK_MIN, 0.5),
    more=st.floats(0.0, 1.0),
    direction=st.floats(0.0, math.pi),
)
def test_monotone_in_covariance_and_risk(
    sd_x: float, ratio: float, angle: float, risk: float, more: float, direction: float
) -> None:
    cov = rotated(sd_x, ratio * sd_x, angle)
    level = protection_level(cov, risk)
    line, circle = stats.norm.isf(risk / 2), math.sqrt(-2 * math.log(risk))
    assert sd_x * line * (1 - 1e-5) <= level <= sd_x * circle * (1 + 1e-9)
    assert protection_level(cov, max(risk * (1 - more), RISK_MIN)) >= level * (1 - 1e-9)
    wider = cov + rotated(more * sd_x, 0.0, direction)
    assert protection_level(wider, risk) >= level * (1 - 1e-7)


def test_inflation_is_a_factor() -> None:
    cov = rotated(2.0, 1.0, 0.3)
    assert protection_level(cov, 1e-4, 1.7) == pytest.approx(1.7 * protection_level(cov, 1e-4))
    assert protection_level(cov, 1e-4, 1.7) == pytest.approx(protection_level(1.7**2 * cov, 1e-4))


@pytest.mark.parametrize(
    ("cov", "risk", "inflation", "text"),
    [
        (np.diag([1.0, -1.0]), 1e-4, 1.0, "cov2"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), 1e-4, 1.0, "cov2"),
        (np.diag([1.0, np.nan]), 1e-4, 1.0, "cov2"),
        (np.diag([1.0, np.inf]), 1e-4, 1.0, "cov2"),
        (np.eye(2), 0.0, 1.0, "risk"),
        (np.eye(2), 0.6, 1.0, "risk"),
        (np.eye(2), math.nan, 1.0, "risk"),
        (np.eye(2), 1e-4, 0.99, "inflation"),
        (np.eye(2), 1e-4, math.nan, "inflation"),
    ],
)
def test_unsound_input_is_refused(cov: Array, risk: float, inflation: float, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        protection_level(cov, risk, inflation)


# the NIS window


def test_window_at_its_bound() -> None:
    """chi2.ppf(0.999, 40) = 73.402: just below it nothing, just above it the Birge ratio."""
    bound = float(stats.chi2.ppf(0.999, 40))
    for total, factor in ((bound - 1e-6, 1.0), (bound + 1e-6, math.sqrt(bound / 40))):
        window = NisWindow(epochs=10)
        for _ in range(10):
            window.add(total / 10, 4)
        assert window.inflation() == pytest.approx(factor)


def test_window_forgets_and_ignores_epochs_without_measurements() -> None:
    window = NisWindow(epochs=5)
    for _ in range(5):
        window.add(100.0, 4)
    assert window.inflation() == pytest.approx(5.0)
    for _ in range(20):
        window.add(0.0, 0)
    assert window.inflation() == pytest.approx(5.0)
    copy = window.copy()
    for _ in range(5):
        window.add(4.0, 4)
    assert window.inflation() == 1.0
    assert copy.inflation() == pytest.approx(5.0)
    assert NisWindow().inflation() == 1.0


def test_window_finds_the_scale_and_is_quiet_where_the_filter_is_right() -> None:
    rng = np.random.default_rng(12)
    for scale in (1.0, 3.0):
        window, factors = NisWindow(epochs=50), []
        for nis in scale**2 * rng.chisquare(4, size=5000):
            window.add(nis, 4)
            factors.append(window.inflation())
        if scale == 1.0:
            assert np.mean(np.array(factors) > 1.0) < 0.004
        else:
            assert np.median(factors) == pytest.approx(scale, rel=0.03)


@pytest.mark.parametrize("bad", [{"epochs": 0}, {"confidence": 1.0}, {"confidence": 0.1}])
def test_window_refuses_unsound_settings(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        NisWindow(**bad)


# undetected biases


def random_case(seed: int, n: int = 6, m: int = 2) -> tuple[Array, Array, Array, Array]:
    """A prior, the same after another group, and the rows of one group."""
    rng = np.random.default_rng(seed)
    L, H = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    P = L @ L.T
    other = rng.normal(size=(2, n))
    S = other @ P @ other.T + np.eye(2)
    after = P - P @ other.T @ np.linalg.solve(S, other @ P)
    return P, (after + after.T) / 2, H, rng.uniform(0.1, 2.0, size=m)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("alone", [True, False])
def test_no_bias_that_passes_the_gate_moves_the_position_further(seed: int, alone: bool) -> None:
    P, after, H, R = random_case(seed)
    fused = P if alone else after
    T = 18.4
    bound = bias_shift(P, H, R, T, fused)
    S_gate, S = H @ P @ H.T + np.diag(R), H @ fused @ H.T + np.diag(R)
    K = fused @ H.T @ np.linalg.inv(S)
    angle = np.linspace(0, 2 * math.pi, 20001)
    u = np.stack([np.cos(angle), np.sin(angle)])
    b = np.linalg.cholesky(S_gate) @ u * math.sqrt(T)
    np.testing.assert_allclose(np.einsum("ik,ij,jk->k", b, np.linalg.inv(S_gate), b), T)
    shifts = np.linalg.norm((K @ b)[:2], axis=0)
    assert shifts.max() == pytest.approx(bound, rel=1e-6)


def test_alone_it_is_what_the_update_takes_off_the_covariance() -> None:
    P, _, H, R = random_case(7)
    post = np.linalg.inv(np.linalg.inv(P) + H.T @ np.diag(1 / R) @ H)
    taken = np.linalg.eigvalsh((P - post)[:2, :2])[-1]
    assert bias_shift(P, H, R, 9.0, P) == pytest.approx(3.0 * math.sqrt(taken), rel=1e-9)


def test_no_gate_no_bound() -> None:
    P, _, H, R = random_case(8)
    assert bias_shift(P, H, R, math.inf, P) == math.inf


def test_faulted_level_holds_over_monte_carlo() -> None:
    """One RSU in a hundred wrong by its worst undetected shift, in the worst direction."""
    rng = np.random.default_rng(13)
    cov, risk, fault = rotated(1.0, 0.5, 0.4), 1e-3, 0.01
    shifts = [4.0, 2.5]
    level = faulted_level(cov, risk, shifts, fault)
    errors = rng.multivariate_normal(np.zeros(2), cov, size=2_000_000)
    wrong = rng.random((errors.shape[0], 2)) < fault
    along = np.array([math.cos(0.4), math.sin(0.4)])
    errors += np.where(wrong[:, :1], 4.0, np.where(wrong[:, 1:], 2.5, 0.0)) * along
    assert np.mean(np.linalg.norm(errors, axis=1) > level) < risk
    plain = protection_level(cov, risk)
    assert np.mean(np.linalg.norm(errors, axis=1) > plain) > 5 * risk


def test_faulted_level_without_faults_and_with_improbable_ones() -> None:
    cov = np.eye(2)
    assert faulted_level(cov, 1e-4, [], 0.1) == protection_level(cov, 1e-4)
    assert faulted_level(cov, 1e-4, [5.0], 0.0) == protection_level(cov, 1e-4)
    assert faulted_level(cov, 1e-4, [50.0], 1e-6) == protection_level(cov, 5e-5)
    assert faulted_level(cov, 1e-4, [50.0], 1e-3) > 50.0
    assert faulted_level(cov, 1e-4, [math.inf], 1e-3) == math.inf
    with pytest.raises(ValueError, match="fault_probability"):
        faulted_level(cov, 1e-4, [1.0], 1.5)
