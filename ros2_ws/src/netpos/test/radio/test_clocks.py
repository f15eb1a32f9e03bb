"""Clock truth: the paper's recursion written out, and its statistics over seeds."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.radio.clocks import ClockModel, simulate_clock
from scipy import stats

STEP_NS = 83_650_000
STAMPS = 1_000_000_000 + STEP_NS * np.arange(400, dtype=np.int64)


def test_offset_and_drift_satisfy_equations_1_and_2() -> None:
    model = ClockModel(beta=0.999)
    offset, drift = simulate_clock(model, STAMPS, 3, "vue_1")
    for n in range(1, len(STAMPS)):  # fokin2020:eq.1
        assert offset[n] == pytest.approx(offset[n - 1] + drift[n] * STEP_NS * 1e-9, abs=1e-15)
    eta = drift[1:] - model.beta * drift[:-1]  # fokin2020:eq.2
    spread = (eta**2).sum() / model.drift_step_sd**2
    assert stats.chi2(len(eta)).ppf(1e-3) < spread < stats.chi2(len(eta)).ppf(1 - 1e-3)


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


def test_bad_model_is_refused() -> None:
    with pytest.raises(ValueError, match="drift_sd"):
        ClockModel(drift_sd=-1.0)
