"""The density of the white acceleration that is learned on the way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.accel_density import (
    LEAST,
    MOST,
    START,
    AccelDensity,
    density_of,
    learn,
    move,
    resized,
    unknown_density,
)
from netpos.estimation.motion import NO_BIAS, Parameter, motion_parameters
from netpos.messages.values import Array

DT, SD = 0.2, 0.3
H = np.eye(2, 6)
R = SD**2 * np.eye(2)
NARROW = 1e-6  # variance of theta with which a step shows the score


def white(density: float, epochs: int, seed: int) -> Array:
    """Position fixes (N, 2) of a device with this density."""
    rng = np.random.default_rng(seed)
    Q = density**2 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    state, fixes = np.zeros((2, 2)), np.empty((epochs, 2))
    for k in range(epochs):
        state = np.array([[1.0, DT], [0.0, 1.0]]) @ state + rng.multivariate_normal([0, 0], Q, 2).T
        fixes[k] = state[0] + SD * rng.standard_normal(2)
    return fixes


def predicted(mean: Array, cov: Array, density: float) -> tuple[Array, Array]:
    """Textbook prediction of position, velocity and an unused clock."""
    F, Q = np.eye(6), np.zeros((6, 6))
    F[0, 2] = F[1, 3] = F[4, 5] = DT
    for p in range(2):
        Q[np.ix_([p, p + 2], [p, p + 2])] = density**2 * np.array(
            [[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]
        )
    return F @ mean, F @ cov @ F.T + Q


def updated(mean: Array, cov: Array, fix: Array) -> tuple[Array, Array, float]:
    """Textbook update; the logarithm of the likelihood of ``fix``."""
    S, nu = H @ cov @ H.T + R, fix - H @ mean
    K = cov @ H.T @ np.linalg.inv(S)
    log_likelihood = -0.5 * float(nu @ np.linalg.solve(S, nu) + np.log(np.linalg.det(S)))
    return mean + K @ nu, (np.eye(6) - K @ H) @ cov, log_likelihood


def start() -> tuple[Array, Array]:
    return np.zeros(6), np.diag([1.0, 1.0, 4.0, 4.0, 1e4, 1.0])


def log_likelihoods(fixes: Array, density: float) -> Array:
    (mean, cov), found = start(), np.empty(len(fixes))
    for k, fix in enumerate(fixes):
        mean, cov = predicted(mean, cov, density)
        mean, cov, found[k] = updated(mean, cov, fix)
    return found


def followed(fixes: Array, learned: AccelDensity) -> Array:
    """The densities (N,) that a textbook filter takes that learns on the way."""
    (mean, cov), taken, motion = start(), np.empty(len(fixes)), motion_parameters()
    for k, fix in enumerate(fixes):
        taken[k] = motion[Parameter.ACCEL] = density_of(learned)
        move(learned, mean, DT, motion, NO_BIAS)
        prior = predicted(mean, cov, taken[k])
        mean, cov, _ = updated(*prior, fix)
        learn(learned, *prior, mean, cov, 0.0)
    return taken


def test_the_score_is_the_derivative_of_the_log_likelihood() -> None:
    """Central differences of a textbook filter, measurement by measurement."""
    fixes, density, h = white(0.6, 80, 3), 0.8, 1e-5
    up, down = (log_likelihoods(fixes, density * math.exp(s * h)) for s in (1, -1))
    expected = (up - down) / (2 * h)
    learned, motion, found = unknown_density(6), motion_parameters(accel=density), np.empty(80)
    mean, cov = start()
    told = math.log(density) - math.sqrt(NARROW)
    for k, fix in enumerate(fixes):
        learned.theta[:] = told, NARROW
        move(learned, mean, DT, motion, NO_BIAS)
        learned.theta[:] = told, NARROW
        prior = predicted(mean, cov, density)
        mean, cov, _ = updated(*prior, fix)
        learn(learned, *prior, mean, cov, 0.0)
        found[k] = (learned.theta[0] - told) / learned.theta[1]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert np.abs(expected).max() > 0.1


@pytest.mark.parametrize("density", [0.25, 1.0, 3.0])
def test_it_finds_the_density_of_a_device(density: float) -> None:
    """What the filter takes, one standard deviation above the mean, is within 40 % after two
    minutes, as the mean of the logarithm over eight devices."""
    found = []
    for seed in range(8):
        learned = unknown_density(6)
        found.append(math.log(followed(white(density, 600, seed), learned)[-1]))
        assert density_of(learned) == pytest.approx(
            math.exp(learned.theta[0] + math.sqrt(learned.theta[1]))
        )
    assert abs(np.mean(found) - math.log(density)) < math.log(1.4)


def test_it_follows_a_device_that_changes() -> None:
    """Twenty seconds after it begins to move freely, and a minute after it is quiet again."""
    quiet, free = white(0.01, 300, 1), white(2.0, 300, 2)
    taken = followed(np.vstack([quiet, quiet[-1] + free]), unknown_density(6))
    assert taken[0] == pytest.approx(START)
    assert taken[299] < 0.25
    assert 1.0 < taken[400:].mean() < 4.0


def test_it_stays_within_what_devices_do() -> None:
    still, wild = unknown_density(6), unknown_density(6)
    assert LEAST * 0.999 < followed(white(1e-3, 900, 5), still)[-1] < 1.3 * LEAST
    assert followed(white(40.0, 300, 5), wild).max() < 1.2 * MOST


def test_what_nothing_says_is_forgotten() -> None:
    learned, motion = unknown_density(6), motion_parameters(accel=START)
    followed(white(3.0, 300, 1), learned)
    assert density_of(learned) > 1.5
    for _ in range(10):
        move(learned, np.zeros(6), 60.0, motion, NO_BIAS)
    assert density_of(learned) == pytest.approx(START, rel=1e-3)


def test_one_measurement_says_little() -> None:
    """An outlier 40 sd away, and one in a thousand times that."""
    for far in (40.0, 4e4):
        learned = unknown_density(6)
        fixes = white(0.5, 200, 4)
        followed(fixes, learned)
        before = density_of(learned)
        motion, prior = motion_parameters(accel=before), np.diag([0.04, 0.04, 0.1, 0.1, 1.0, 1.0])
        mean, cov, _ = updated(np.zeros(6), prior, np.array([far * SD, 0.0]))
        move(learned, np.zeros(6), DT, motion, NO_BIAS)
        learn(learned, np.zeros(6), prior, mean, cov, 0.0)
        assert density_of(learned) < 1.5 * before


def test_a_manoeuvre_is_no_acceleration() -> None:
    """What a turn explains leaves the density, and what depends on it begins anew."""
    learned = unknown_density(6)
    followed(white(0.5, 200, 4), learned)
    theta = learned.theta.copy()
    prior = np.eye(6)
    mean, cov, _ = updated(np.zeros(6), prior, np.array([9.0, 0.0]))
    learn(learned, np.zeros(6), prior, mean, cov, 0.9)
    np.testing.assert_array_equal(learned.theta, theta)
    assert not learned.mean.any()
    assert not learned.cov.any()


def test_a_smaller_density_of_steps_says_nothing_of_it() -> None:
    """The process noise is then that of the steps, whatever the density."""
    learned = unknown_density(6)
    move(learned, np.zeros(6), DT, motion_parameters(accel=0.9 * START), NO_BIAS)
    assert not learned.cov.any()
    move(learned, np.zeros(6), DT, motion_parameters(accel=START), NO_BIAS)
    assert learned.cov[2, 2] == pytest.approx(2 * START**2 * DT)


def test_new_states_do_not_depend_on_it_and_known_ones_are_no_trouble() -> None:
    learned = unknown_density(6)
    followed(white(0.5, 100, 4), learned)
    larger = resized(learned, 8)
    np.testing.assert_array_equal(larger.cov[:6, :6], learned.cov)
    assert not larger.cov[6:].any()
    larger.theta[0] = 7.0
    assert learned.theta[0] != 7.0
    prior = np.diag([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])  # a clock without error
    mean, cov, _ = updated(np.zeros(6), prior, np.array([0.3, 0.1]))
    learn(learned, np.zeros(6), prior, mean, cov, 0.0)
    assert np.isfinite(density_of(learned))
