"""Slow errors of RSUs against a filter that has h(x) + b as states in the place of b."""

from __future__ import annotations

import numpy as np
import pytest
from ekf_update import updated
from filter_rows import NO_GATE, row
from netpos.estimation.measurement import (
    AXES,
    KIND,
    REFERENCE,
    VALUE,
    VARIANCE,
    Kind,
    curvature_mean,
    curvature_variance,
    linearise,
    wrap,
)
from netpos.estimation.update.slow_errors import LASTS_S, with_linearisation
from netpos.messages.values import Array

PLACES = np.array([[0.0, 0.0, 3.0], [12.0, -2.0, 2.5], [9.0, 11.0, 3.0], [-1.0, 9.0, 2.0]])
TRUTH = np.array([4.0, 3.0, 0.0, 0.0, 0.0, 0.0])
START = np.array([5.0, 2.0, 0.1, -0.2, 0.5, 0.0])
BIAS_SD = {Kind.RANGE: 0.7, Kind.AZIMUTH: 0.3, Kind.TOA: 0.7}
NOISE_SD = {Kind.RANGE: 0.1, Kind.AZIMUTH: 0.05, Kind.TOA: 0.1}


def rows_of(kind: Kind, rng: np.random.Generator, biases: Array) -> Array:
    """An epoch (4, ROW_WIDTH) of the four RSUs, with the bias states 6 to 9."""
    sd = NOISE_SD[kind]
    rows = np.array([row(kind, 0.0, sd**2, i, p, bias=6 + i) for i, p in enumerate(PLACES)])
    at_truth, _ = linearise(rows, np.append(TRUTH, biases), 1.0)
    rows[:, VALUE] = -at_truth + rng.normal(0.0, sd, 4)
    if kind == Kind.AZIMUTH:
        rows[:, VALUE] = [wrap(value) for value in rows[:, VALUE]]
    return rows


def differences(rng: np.random.Generator, biases: Array) -> tuple[Array, Array]:
    """Time differences (3, ROW_WIDTH) of the last three RSUs to the first, and the ranges (4,
    ROW_WIDTH) of all without noise or values."""
    ranges = rows_of(Kind.RANGE, rng, biases)
    rows = np.array(
        [row(Kind.TDOA, 0.0, 0.02, i, p, bias=7 + i) for i, p in enumerate(PLACES[1:])]
    )
    rows[:, AXES : AXES + 3], rows[:, REFERENCE] = PLACES[0] - PLACES[1:], 6
    at_truth, _ = linearise(rows, np.append(TRUTH, biases), 1.0)
    rows[:, VALUE] = -at_truth + rng.normal(0.0, 0.14, 3)
    return rows, ranges


class SumFilter:
    """A Kalman filter of the states x (6,) and s = h(x) + b (4,), linearised once, at the start:
    values of s are linear. ``parts``: rows (4, ROW_WIDTH) of h."""

    def __init__(self, mean: Array, cov: Array, parts: Array) -> None:
        self.parts = parts.copy()
        self.parts[:, VALUE] = 0.0
        T = np.eye(10)
        T[6:] = linearise(self.parts, mean, 1.0)[1]
        self.z, self.P = np.append(mean[:6], self.h(mean, cov) + mean[6:]), T @ cov @ T.T

    def h(self, mean: Array, cov: Array) -> Array:
        """Mean values without the biases."""
        bend = [curvature_mean(part, mean, cov, 1.0) for part in self.parts]
        plain = np.append(mean[:6], np.zeros(4))
        at_mean, _ = linearise(self.parts, plain, 1.0)
        return np.array(bend) - at_mean

    def moments(self) -> tuple[Array, Array]:
        """Mean and covariance (10,), (10, 10) of x and b = s - h(x)."""
        mean = np.append(self.z[:6], np.zeros(4))
        T = np.eye(10)
        T[6:, :6] = -linearise(self.parts, mean, 1.0)[1][:, :6]
        cov = T @ self.P @ T.T
        left = self.z[6:] - self.h(mean, cov)
        mean[6:] = [wrap(v) for v in left] if self.parts[0, KIND] == Kind.AZIMUTH else left
        return mean, cov

    def fuse(self, values: Array, G: Array, variance: Array, angle: bool) -> None:
        """Values (m,) of ``G`` (m, 4) s with ``variance`` (m,)."""
        H = np.hstack([np.zeros((len(G), 6)), G])
        S = H @ self.P @ H.T + np.diag(variance)
        residual = values - H @ self.z
        if angle:
            residual = np.array([wrap(value) for value in residual])
        K = self.P @ H.T @ np.linalg.inv(S)
        self.z, self.P = self.z + K @ residual, self.P - K @ S @ K.T


def prior(kind: Kind) -> tuple[Array, Array]:
    cov = np.diag([2.0, 1.5, 0.3, 0.3, 0.4, 0.2, *[BIAS_SD[kind] ** 2] * 4])
    cov[0, 1] = cov[1, 0] = 0.5
    return np.append(START, np.zeros(4)), cov


@pytest.mark.parametrize("kind", [Kind.RANGE, Kind.TOA, Kind.AZIMUTH])
def test_value_with_a_slow_error_is_linear_in_state_and_value(kind: Kind) -> None:
    rng = np.random.default_rng(3)
    biases = rng.normal(0.0, BIAS_SD[kind], 4)
    mean, cov = prior(kind)
    expected = SumFilter(mean, cov, rows_of(kind, rng, biases))
    for _ in range(6):
        rows = rows_of(kind, rng, biases)
        left_out = [curvature_variance(r, mean, cov, 1.0) for r in rows]
        mean, cov, *_ = updated(mean, cov, rows, 1.0, NO_GATE, 1)
        variance = rows[:, VARIANCE] + left_out
        expected.fuse(rows[:, VALUE], np.eye(4), variance, kind == Kind.AZIMUTH)
        x, P = expected.moments()
        np.testing.assert_allclose(mean, x, atol=1e-9)
        np.testing.assert_allclose(cov, P, atol=1e-9)


def test_difference_has_the_slow_errors_of_both_rsus() -> None:
    rng = np.random.default_rng(4)
    biases = rng.normal(0.0, 0.7, 4)
    mean, cov = prior(Kind.RANGE)
    _, ranges = differences(rng, biases)
    expected = SumFilter(mean, cov, ranges)
    G = np.hstack([-np.ones((3, 1)), np.eye(3)])
    for _ in range(6):
        rows, _ = differences(rng, biases)
        left_out = [curvature_variance(r, mean, cov, 1.0) for r in rows]
        mean, cov, *_ = updated(mean, cov, rows, 1.0, NO_GATE, 1)
        expected.fuse(rows[:, VALUE], G, rows[:, VARIANCE] + left_out, False)
        x, P = expected.moments()
        np.testing.assert_allclose(mean, x, atol=1e-9)
        np.testing.assert_allclose(cov, P, atol=1e-9)


def test_second_value_of_a_device_at_rest_does_not_iterate() -> None:
    """The first value of an RSU bends as any other does; what comes after tells h(x) + b only."""
    rng = np.random.default_rng(5)
    biases = rng.normal(0.0, 0.3, 4)
    mean, cov = prior(Kind.AZIMUTH)
    rows = rows_of(Kind.AZIMUTH, rng, biases)
    once, *_ = updated(mean, cov, rows, 1.0, NO_GATE, 1)
    mean, cov, *_ = updated(mean, cov, rows, 1.0, NO_GATE, 8)
    assert np.abs(mean - once).max() > 1e-3
    rows = rows_of(Kind.AZIMUTH, rng, biases)
    once = updated(mean, cov, rows, 1.0, NO_GATE, 1)
    again = updated(mean, cov, rows, 1.0, NO_GATE, 8)
    np.testing.assert_array_equal(once[0], again[0])
    np.testing.assert_array_equal(once[1], again[1])


def test_what_linearising_leaves_out_is_a_second_process() -> None:
    """Their sum has the variance of both, and gains as much of it in a moment as both together."""
    rng = np.random.default_rng(6)
    mean, cov = prior(Kind.RANGE)
    rows = rows_of(Kind.RANGE, rng, np.zeros(4))[[0, 2]]
    bias = np.array([[0.7, 0.7, 0.2, 0.2], [50.0, 3.0, 50.0, 1e6]])
    widened = np.full_like(bias, np.nan)
    with_linearisation(mean, cov, rows, 1.0, bias, widened)
    bent = [curvature_variance(r, mean, cov, 1.0) for r in rows]
    variance = bias[0] ** 2 + [bent[0], 0.0, bent[1], 0.0]
    renewed = bias[0] ** 2 / bias[1] + np.array([bent[0], 0.0, bent[1], 0.0]) / LASTS_S
    np.testing.assert_allclose(widened[0] ** 2, variance, rtol=1e-12)
    np.testing.assert_allclose(widened[0] ** 2 / widened[1], renewed, rtol=1e-12)
