"""Slow errors of RSUs: what is known of a value, and what they explain of the place."""

from __future__ import annotations

import numpy as np
import pytest
from ekf_update import updated
from filter_rows import NO_GATE, row
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    REFERENCE,
    VALUE,
    Kind,
    linearise,
    wrap,
)
from netpos.estimation.update.slow_errors import (
    follow_prediction,
    follow_tangents,
)
from netpos.messages.values import Array

PLACES = np.array([[0.0, 0.0, 3.0], [12.0, -2.0, 2.5], [9.0, 11.0, 3.0], [-1.0, 9.0, 2.0]])
TRUTH = np.array([4.0, 3.0, 0.0, 0.0, 0.0, 0.0])
START = np.array([5.0, 2.0, 0.1, -0.2, 0.5, 0.0])
BIAS_SD = {Kind.RANGE: 0.7, Kind.AZIMUTH: 0.3, Kind.TOA: 0.7}
NOISE_SD = {Kind.RANGE: 0.1, Kind.AZIMUTH: 0.05, Kind.TOA: 0.1}


MOVED = np.array([0.8, -0.6, *np.zeros(8)])


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


def prior(kind: Kind) -> tuple[Array, Array]:
    cov = np.diag([2.0, 1.5, 0.3, 0.3, 0.4, 0.2, *[BIAS_SD[kind] ** 2] * 4])
    cov[0, 1] = cov[1, 0] = 0.5
    return np.append(START, np.zeros(4)), cov


def followed(mean: Array, cov: Array, rows: Array, after: Array) -> Array:
    """``cov`` (10, 10) with the tangents of ``rows`` followed from ``mean`` to ``after``."""
    turned = cov.copy()
    follow_tangents(after, turned, 6, rows, np.ones(len(rows)), mean, 1.0)
    return turned


def known(mean: Array, cov: Array, ranges: Array) -> Array:
    """Covariance (4, 4) of H x_b + b, with x_b what the biases b explain of x."""
    H = linearise(ranges, mean, 1.0)[1][:, :6]
    explained = cov[:6, 6:] @ np.linalg.inv(cov[6:, 6:])
    T = H @ explained + np.eye(4)
    return T @ cov[6:, 6:] @ T.T


def tied(kind: Kind) -> tuple[Array, Array]:
    """The prior after an epoch of all RSUs."""
    rng = np.random.default_rng(3)
    mean, cov = prior(kind)
    rows = rows_of(kind, rng, rng.normal(0.0, BIAS_SD[kind], 4))
    mean, cov, *_ = updated(mean, cov, rows, 1.0, NO_GATE, 1)
    return mean, cov


@pytest.mark.parametrize("kind", [Kind.RANGE, Kind.TOA, Kind.AZIMUTH])
def test_value_stays_as_well_known_at_the_new_place(kind: Kind) -> None:
    mean, cov = tied(kind)
    rows = rows_of(kind, np.random.default_rng(4), np.zeros(4))
    after = mean + MOVED
    turned = followed(mean, cov, rows, after)
    np.testing.assert_allclose(known(after, turned, rows), known(mean, cov, rows), atol=1e-9)
    assert np.abs(known(after, cov, rows) - known(mean, cov, rows)).max() > 1e-3
    np.testing.assert_array_equal(turned[:6, :6], cov[:6, :6])
    assert np.linalg.eigvalsh(turned).min() > 0.0


def test_difference_has_the_slow_errors_of_both_rsus() -> None:
    mean, cov = tied(Kind.RANGE)
    rows, ranges = differences(np.random.default_rng(4), np.zeros(4))
    after = mean + MOVED
    turned = followed(mean, cov, rows, after)
    np.testing.assert_allclose(known(after, turned, ranges), known(mean, cov, ranges), atol=1e-9)


def test_motion_that_no_slow_error_explains_leaves_them_as_they_are() -> None:
    """A device that moves turns its tangents for real."""
    mean, cov = prior(Kind.RANGE)
    rows = rows_of(Kind.RANGE, np.random.default_rng(4), np.zeros(4))
    after = mean + MOVED
    np.testing.assert_allclose(followed(mean, cov, rows, after), cov, atol=1e-15)


def test_rows_that_are_not_used_or_have_no_slow_error_turn_nothing() -> None:
    mean, cov = tied(Kind.RANGE)
    rows = rows_of(Kind.RANGE, np.random.default_rng(4), np.zeros(4))
    after, used = mean + MOVED, np.array([1.0, 0.0, 1.0, 1.0])
    rows[3, BIAS] = -1.0
    turned = cov.copy()
    follow_tangents(after, turned, 6, rows, used, mean, 1.0)
    np.testing.assert_allclose(turned, followed(mean, cov, rows[[0, 2]], after), rtol=1e-12)
    np.testing.assert_array_equal(turned[[7, 9], :6], cov[[7, 9], :6])


def test_slow_error_that_has_not_been_heard_stays_as_it_is() -> None:
    mean, cov = prior(Kind.RANGE)
    rng = np.random.default_rng(3)
    rows = rows_of(Kind.RANGE, rng, rng.normal(0.0, 0.7, 4))
    mean, cov, *_ = updated(mean, cov, rows[:3], 1.0, NO_GATE, 1)
    turned = followed(mean, cov, rows, mean + MOVED)
    np.testing.assert_array_equal(turned[9], cov[9])
    assert np.abs(turned[8] - cov[8]).max() > 1e-3


@pytest.mark.parametrize(("speed", "share"), [(0.0, 1.0), (0.5, 0.5), (50.0, 0.0)])
def test_way_is_real_as_far_as_the_velocity_is_known(speed: float, share: float) -> None:
    """The variance of the velocity, 0.25 m^2/s^2 in all, in its expected square."""
    mean, cov = tied(Kind.RANGE)
    scale = np.ones(10)
    scale[2:4] = np.sqrt(0.125 / np.diag(cov)[2:4])
    cov *= np.outer(scale, scale)
    velocity = speed * np.array([0.6, -0.8])
    mean[2:4] = velocity
    rows, turned = rows_of(Kind.RANGE, np.random.default_rng(4), np.zeros(4)), cov.copy()
    follow_prediction(mean, turned, 6, rows, 2.0, 1.0)
    before = mean.copy()
    before[:2] -= share * 2.0 * velocity
    atol = 1e-9 if speed < 1.0 else 1e-3
    np.testing.assert_allclose(turned, followed(before, cov, rows, mean), rtol=0, atol=atol)
    assert share in (0.0, 1.0) or np.abs(turned - cov).max() > 1e-2


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
