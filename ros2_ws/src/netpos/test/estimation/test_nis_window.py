"""The factor from the NIS of the last epochs against SciPy's bounds and simulated filters."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from netpos.estimation.nis_window import NisWindow
from netpos.messages.values import Array
from scipy import stats

WINDOWS = (3, 10, 25, 50)


def expected_factor(nis: Array, dof: Array) -> float:
    """Of the epochs so far: SciPy's bound for each window, a quarter of 0.1 % each."""
    heard, factor = np.flatnonzero(dof), 1.0
    for epochs in WINDOWS:
        total, rows = nis[heard[-epochs:]].sum(), dof[heard[-epochs:]].sum()
        if rows > 0 and total > stats.chi2.isf(1e-3 / 4, rows):
            factor = max(factor, math.sqrt(total / rows))
    return factor


def test_window_at_its_bound() -> None:
    """chi2.ppf(0.999, 40) = 73.402: just below it nothing, just above it the Birge ratio."""
    bound = float(stats.chi2.ppf(0.999, 40))
    for total, factor in ((bound - 1e-6, 1.0), (bound + 1e-6, math.sqrt(bound / 40))):
        window = NisWindow(windows=(10,))
        for _ in range(10):
            window.add(total / 10, 4)
        assert window.inflation() == pytest.approx(factor)


def test_window_forgets_and_ignores_epochs_without_measurements() -> None:
    window = NisWindow(windows=(5,))
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


def test_window_forgets_the_degrees_of_freedom_with_their_nis() -> None:
    """Epochs of different size: the sums of the last five alone."""
    window, dofs = NisWindow(windows=(5,)), [2, 9, 4, 1, 7, 3, 8, 2, 6, 5]
    for dof in dofs:
        window.add(100.0, dof)
    expected = math.sqrt(500.0 / sum(dofs[-5:]))
    assert window.inflation() == pytest.approx(expected)
    assert window.copy().inflation() == window.inflation()
    twin = window.copy()
    twin.add(100.0, 11)
    assert twin.inflation() == pytest.approx(math.sqrt(500.0 / (sum(dofs[-4:]) + 11)))
    assert window.inflation() == pytest.approx(expected)


def test_a_fault_of_three_epochs_shows_in_the_shortest_window() -> None:
    """Fifty good epochs hide three bad ones in their sum; the newest three alone do not."""
    nis = np.array([4.0] * 50 + [13.0] * 3)
    dof = np.full(53, 4)
    assert nis[-50:].sum() < stats.chi2.isf(1e-3, 200)
    window, long = NisWindow(), NisWindow(windows=(50,))
    for value in nis:
        window.add(value, 4)
        long.add(value, 4)
    assert long.inflation() == 1.0
    assert window.inflation() == pytest.approx(math.sqrt(13.0 / 4.0)) == expected_factor(nis, dof)


def test_window_finds_the_scale_and_is_quiet_where_the_filter_is_right() -> None:
    rng = np.random.default_rng(12)
    for scale in (1.0, 3.0):
        window, long, factors = NisWindow(), NisWindow(windows=(50,)), []
        for nis in scale**2 * rng.chisquare(4, size=5000):
            window.add(nis, 4)
            long.add(nis, 4)
            factors.append((window.inflation(), long.inflation()))
        all_, of_50 = np.array(factors).T
        if scale == 1.0:
            assert np.mean(all_ > 1.0) < 0.004
        else:
            assert np.median(of_50) == pytest.approx(scale, rel=0.03)
            assert (all_ >= of_50)[50:].all()  # the largest that exceeds its bound


def test_window_over_a_run() -> None:
    """The sums of each window, by slices, epoch by epoch and of the whole run."""
    rng = np.random.default_rng(3)
    dof = rng.integers(0, 7, size=300)
    nis = np.where(dof > 0, rng.chisquare(np.maximum(dof, 1)) * rng.uniform(0.5, 2.2, 300), 0.0)
    expected = [expected_factor(nis[: k + 1], dof[: k + 1]) for k in range(dof.size)]
    assert 0 < np.count_nonzero(np.array(expected) > 1.0) < dof.size
    np.testing.assert_allclose(NisWindow.of_run(nis, dof), expected, rtol=1e-12)
    window, factors = NisWindow(), []
    for value, rows in zip(nis, dof.tolist(), strict=True):
        window.add(float(value), rows)
        factors.append(window.inflation())
    np.testing.assert_allclose(factors, expected, rtol=1e-12)


@pytest.mark.parametrize(
    "bad",
    [
        {"windows": ()},
        {"windows": (0, 3)},
        {"windows": (10, 3)},
        {"windows": (3, 3)},
        {"confidence": 1.0},
        {"confidence": 0.1},
    ],
)
def test_window_refuses_unsound_settings(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        NisWindow(**bad)
