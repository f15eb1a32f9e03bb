"""Clock truth: the paper's recursion written out, and its statistics over seeds."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.radio.clocks import (
    ClockModel,
    NetworkClockModel,
    clock_error,
    clock_tones,
    simulate_clock,
)
from scipy import stats

STEP_NS = 83_650_000
STAMPS = 1_000_000_000 + STEP_NS * np.arange(400, dtype=np.int64)


def test_offset_and_drift_satisfy_equations_1_and_2() -> None:
    model = ClockModel(beta=0.999)
    offset, drift = simulate_clock(model, STAMPS, 3, "vue_1")
    for n in range(1, len(STAMPS)):  # fokin2020:eq.1
        assert offset[n] == pytest.approx(offset[n - 1] + drift[n] * STEP_NS * 1e-9, abs=1e-15)
    eta = drift[1:] - model.beta * drift[:-1]  # fokin2020:eq.2
    chi2 = (eta**2).sum() / model.drift_step_sd**2
    assert stats.chi2(len(eta)).ppf(1e-3) < chi2 < stats.chi2(len(eta)).ppf(1 - 1e-3)


def test_starts_follow_the_papers_distributions() -> None:
    starts = np.array(
        [[q[0] for q in simulate_clock(ClockModel(), STAMPS[:2], s, "v")] for s in range(2000)]
    )
    assert stats.kstest(starts[:, 0] / 100e-6, "norm").pvalue > 1e-3
    assert stats.kstest((starts[:, 1] - 25e-6) / 30e-6, "norm").pvalue > 1e-3


def test_fixed_start() -> None:
    model = ClockModel(
        offset_mean_s=20e-6, offset_sd_s=0, drift_mean=25e-6, drift_sd=0, drift_step_sd=0
    )
    offset, drift = simulate_clock(model, STAMPS, 1, "vue_1")
    np.testing.assert_allclose(drift, 25e-6)
    np.testing.assert_allclose(offset[-1], 20e-6 + 25e-6 * 399 * 0.08365)


@pytest.mark.parametrize("step_s", [0.0167, 1.0, 3.0])
def test_a_continuous_clock_has_the_same_offsets(step_s: float) -> None:
    """Covariance of the second differences of six offsets, which hold all but the start: of a
    state moved by F and Q, and of eta T."""
    model = ClockModel()
    white, walk = model.densities(step_s)
    F = np.array([[1.0, step_s], [0.0, 1.0]])
    across = walk**2 * step_s**2 / 2
    Q = np.array([[white**2 * step_s + walk**2 * step_s**3 / 3, across], [across, 0.0]])
    Q[1, 1] = walk**2 * step_s
    # each offset as a sum of the noises (2 each) of the steps before it
    offsets = np.zeros((6, 12))
    for n in range(6):
        for k in range(n + 1):
            offsets[n, 2 * k : 2 * k + 2] = np.linalg.matrix_power(F, n - k)[0]
    second = np.diff(offsets, n=2, axis=0)
    covariance = second @ np.kron(np.eye(6), Q) @ second.T
    expected = (model.drift_step_sd * step_s) ** 2 * np.eye(4)
    np.testing.assert_allclose(covariance, expected, atol=1e-12 * expected[0, 0])


def test_no_continuous_clock_has_the_offsets_of_what_is_no_step() -> None:
    for step_s in (0.0, -0.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"step_s must be finite and > 0 s, got {step_s}"):
            ClockModel().densities(step_s)
    with pytest.raises(ValueError, match=r"beta must be 1, got 0\.9"):
        ClockModel(beta=0.9).densities(0.1)


def test_bad_model_is_refused() -> None:
    with pytest.raises(ValueError, match="drift_sd"):
        ClockModel(drift_sd=-1.0)


def test_rsu_clock_errors_have_the_wanted_autocorrelation() -> None:
    """Over many seeds, at lags that no period of the tones is tied to."""
    model = NetworkClockModel(sd_s=3e-9, correlation_time_s=50.0)
    lags = np.array([0.0, 5.0, 50.0, 100.0])
    errors = np.array(
        [
            [clock_error(1e4 + lag, clock_tones(model, seed, "rsu_1")) for lag in lags]
            for seed in range(3000)
        ]
    )
    assert abs(errors.mean(axis=0)).max() < 4 * 3e-9 / np.sqrt(3000)
    products = errors * errors[:, :1] / 9e-18
    four_sd = 4 * products.std(axis=0) / np.sqrt(3000)
    assert (abs(products.mean(axis=0) - np.exp(-lags / 50.0)) < four_sd).all()


def test_rsu_clock_errors_are_normal_and_independent() -> None:
    model = NetworkClockModel(sd_s=2e-9)
    pairs = np.array(
        [
            [clock_error(7.0, clock_tones(model, seed, name)) for name in ("rsu_1", "rsu_2")]
            for seed in range(3000)
        ]
    )
    assert stats.kstest(pairs[:, 0], stats.norm(scale=2e-9).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(pairs.T)[0, 1]) < 4 / np.sqrt(3000)


def test_the_reference_clock_is_network_time() -> None:
    model = NetworkClockModel(sd_s=2e-9, reference="rsu_1")
    assert clock_error(7.0, clock_tones(model, 1, "rsu_1")) == 0.0
    assert clock_error(7.0, clock_tones(model, 1, "rsu_2")) != 0.0
