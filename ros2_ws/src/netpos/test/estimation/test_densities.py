"""The densities of acceleration and clock that are learned on the way."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from netpos.estimation.densities import (
    AWAITED,
    HELD,
    LEARNED,
    LEAST,
    MOST,
    PARAMETERS,
    START,
    Densities,
    Density,
    density_of,
    learn,
    move,
    resized,
    unknown_densities,
    write_densities,
)
from netpos.estimation.motion import NO_BIAS, motion_parameters
from netpos.estimation.state import X
from netpos.messages.values import Array

DT = 0.2
NARROW = 1e-6  # variance of theta with which a step shows the score
BOTH = pytest.mark.parametrize("which", list(Density))


class Walk(NamedTuple):
    """Values whose rates do a random walk of the density, and the sd [m] of their measurements."""

    pairs: tuple[tuple[int, int], ...]
    sd: float

    @property
    def jacobian(self) -> Array:
        return np.eye(6)[[value for value, _ in self.pairs]]


WALKS = {
    Density.ACCEL: Walk(((X.PX, X.VX), (X.PY, X.VY)), 0.3),
    Density.CLOCK: Walk(((X.CLOCK, X.DRIFT),), 3.0),
}


def unknown(which: Density, n: int = 6) -> Densities:
    """Of which only one is learned, and from the first measurement on."""
    learned = unknown_densities(n, (which == Density.ACCEL, which == Density.CLOCK))
    learned.phase[which] = LEARNED
    return learned


def noise(density: float) -> Array:
    return density**2 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])


def white(which: Density, density: float, epochs: int, seed: int) -> Array:
    """Measurements (N, k) of a device, or of its clock, with this density."""
    rng, walk = np.random.default_rng(seed), WALKS[which]
    k = len(walk.pairs)
    state, found = np.zeros((2, k)), np.empty((epochs, k))
    for i in range(epochs):
        steps = rng.multivariate_normal([0, 0], noise(density), k).T
        state = np.array([[1.0, DT], [0.0, 1.0]]) @ state + steps
        found[i] = state[0] + walk.sd * rng.standard_normal(k)
    return found


def predicted(which: Density, mean: Array, cov: Array, density: float) -> tuple[Array, Array]:
    """Textbook prediction with this density and no other noise."""
    F, Q = np.eye(6), np.zeros((6, 6))
    F[X.PX, X.VX] = F[X.PY, X.VY] = F[X.CLOCK, X.DRIFT] = DT
    for pair in WALKS[which].pairs:
        Q[np.ix_(pair, pair)] = noise(density)
    return F @ mean, F @ cov @ F.T + Q


def updated(which: Density, mean: Array, cov: Array, seen: Array) -> tuple[Array, Array, float]:
    """Textbook update; the logarithm of the likelihood of what is ``seen``."""
    H, R = WALKS[which].jacobian, WALKS[which].sd ** 2 * np.eye(len(seen))
    S, nu = H @ cov @ H.T + R, seen - H @ mean
    K = cov @ H.T @ np.linalg.inv(S)
    log_likelihood = -0.5 * float(nu @ np.linalg.solve(S, nu) + np.log(np.linalg.det(S)))
    return mean + K @ nu, (np.eye(6) - K @ H) @ cov, log_likelihood


def start() -> tuple[Array, Array]:
    return np.zeros(6), np.diag([1.0, 1.0, 4.0, 4.0, 1e4, 1e4])


def log_likelihoods(which: Density, seen: Array, density: float) -> Array:
    (mean, cov), found = start(), np.empty(len(seen))
    for k, values in enumerate(seen):
        mean, cov = predicted(which, mean, cov, density)
        mean, cov, found[k] = updated(which, mean, cov, values)
    return found


def followed(which: Density, seen: Array, learned: Densities) -> Array:
    """The densities (N,) that a textbook filter takes that learns on the way."""
    (mean, cov), taken, motion = start(), np.empty(len(seen)), motion_parameters()
    for k, values in enumerate(seen):
        write_densities(learned, motion)
        taken[k] = motion[PARAMETERS[which]]
        move(learned, mean, DT, motion, NO_BIAS)
        prior = predicted(which, mean, cov, taken[k])
        mean, cov, _ = updated(which, *prior, values)
        learn(learned, *prior, mean, cov, 0.0)
    return taken


@BOTH
def test_the_score_is_the_derivative_of_the_log_likelihood(which: Density) -> None:
    """Central differences of a textbook filter, measurement by measurement."""
    density, h = 1.6 * START[which], 1e-5
    seen = white(which, 1.2 * START[which], 80, 3)
    up, down = (log_likelihoods(which, seen, density * math.exp(s * h)) for s in (1, -1))
    expected = (up - down) / (2 * h)
    learned, motion, found = unknown(which), motion_parameters(), np.empty(80)
    motion[PARAMETERS[which]] = density
    mean, cov = start()
    told = math.log(density) - math.sqrt(NARROW)
    for k, values in enumerate(seen):
        learned.theta[which] = told, NARROW
        move(learned, mean, DT, motion, NO_BIAS)
        learned.theta[which] = told, NARROW
        prior = predicted(which, mean, cov, density)
        mean, cov, _ = updated(which, *prior, values)
        learn(learned, *prior, mean, cov, 0.0)
        found[k] = (learned.theta[which, 0] - told) / learned.theta[which, 1]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert np.abs(expected).max() > 0.1


@pytest.mark.parametrize(
    ("which", "density"),
    [
        (Density.ACCEL, 0.25),
        (Density.ACCEL, 1.0),
        (Density.ACCEL, 3.0),
        (Density.CLOCK, 0.03 * START[Density.CLOCK]),
        (Density.CLOCK, START[Density.CLOCK]),
        (Density.CLOCK, 5.0 * START[Density.CLOCK]),
    ],
)
def test_it_finds_the_density_of_a_device(which: Density, density: float) -> None:
    """What the filter takes, one standard deviation above the mean, is within 40 % after two
    minutes, as the mean of the logarithm over eight devices."""
    found = []
    for seed in range(8):
        learned = unknown(which)
        found.append(math.log(followed(which, white(which, density, 600, seed), learned)[-1]))
        assert density_of(learned, which) == pytest.approx(
            math.exp(learned.theta[which, 0] + math.sqrt(learned.theta[which, 1]))
        )
    assert abs(np.mean(found) - math.log(density)) < math.log(1.4)


def test_it_follows_a_device_that_changes() -> None:
    """Twenty seconds after it begins to move freely, and a minute after it is quiet again."""
    accel = Density.ACCEL
    quiet, free = white(accel, 0.01, 300, 1), white(accel, 2.0, 300, 2)
    taken = followed(accel, np.vstack([quiet, quiet[-1] + free]), unknown(accel))
    assert taken[0] == pytest.approx(START[accel])
    assert taken[299] < 0.25
    assert 1.0 < taken[400:].mean() < 4.0


@BOTH
def test_it_stays_within_what_devices_do(which: Density) -> None:
    still, wild = (white(which, f * START[which], n, 5) for f, n in ((1e-6, 900), (80.0, 300)))
    assert LEAST[which] * 0.999 < followed(which, still, unknown(which))[-1] < 0.3 * START[which]
    assert followed(which, wild, unknown(which)).max() < 1.2 * MOST[which]


@BOTH
def test_what_nothing_says_is_forgotten(which: Density) -> None:
    learned, motion = unknown(which), motion_parameters()
    followed(which, white(which, 6.0 * START[which], 300, 1), learned)
    assert density_of(learned, which) > 3.0 * START[which]
    for _ in range(100):
        write_densities(learned, motion)
        move(learned, np.zeros(6), 60.0, motion, NO_BIAS)
    assert density_of(learned, which) == pytest.approx(START[which], rel=1e-3)


@BOTH
def test_one_measurement_says_little(which: Density) -> None:
    """An outlier 40 sd away, and one in a thousand times that."""
    for far in (40.0, 4e4):
        learned, motion = unknown(which), motion_parameters()
        followed(which, white(which, START[which], 200, 4), learned)
        before = density_of(learned, which)
        write_densities(learned, motion)
        prior = np.diag([0.04, 0.04, 0.1, 0.1, 9.0, 9.0])
        outlier = np.zeros(len(WALKS[which].pairs))
        outlier[0] = far * WALKS[which].sd
        mean, cov, _ = updated(which, np.zeros(6), prior, outlier)
        move(learned, np.zeros(6), DT, motion, NO_BIAS)
        learn(learned, np.zeros(6), prior, mean, cov, 0.0)
        assert density_of(learned, which) < 1.6 * before


@BOTH
def test_a_manoeuvre_says_nothing(which: Density) -> None:
    """What a turn explains leaves the density, and what depends on it begins anew."""
    learned = unknown(which)
    followed(which, white(which, START[which], 200, 4), learned)
    theta = learned.theta.copy()
    prior = np.eye(6)
    mean, cov, _ = updated(which, np.zeros(6), prior, np.full(len(WALKS[which].pairs), 9.0))
    learn(learned, np.zeros(6), prior, mean, cov, 0.9)
    np.testing.assert_array_equal(learned.theta, theta)
    assert not learned.mean.any()
    assert not learned.cov.any()


def test_a_smaller_density_of_steps_says_nothing_of_it() -> None:
    """The process noise is then that of the steps, whatever the density."""
    learned, start_of = unknown(Density.ACCEL), START[Density.ACCEL]
    move(learned, np.zeros(6), DT, motion_parameters(accel=0.9 * start_of), NO_BIAS)
    assert not learned.cov.any()
    move(learned, np.zeros(6), DT, motion_parameters(accel=start_of), NO_BIAS)
    assert learned.cov[0, X.VX, X.VX] == pytest.approx(2 * start_of**2 * DT)


def test_a_clock_is_learned_from_what_tells_of_it() -> None:
    """Positions leave it as it is; after the first time of arrival it is learned."""
    accel, clock = Density.ACCEL, Density.CLOCK
    learned = unknown_densities(6, (True, True))
    (mean, cov), motion = start(), motion_parameters()
    for seen in white(accel, 0.5, 50, 1):
        write_densities(learned, motion)
        move(learned, mean, DT, motion, NO_BIAS)
        prior = predicted(accel, mean, cov, motion[PARAMETERS[accel]])
        mean, cov, _ = updated(accel, *prior, seen)
        learn(learned, *prior, mean, cov, 0.0)
    assert learned.phase[clock] == AWAITED
    assert motion[PARAMETERS[clock]] == pytest.approx(START[clock])
    assert not learned.cov[clock].any()
    posterior = updated(clock, mean, cov, np.zeros(1))[:2]
    learn(learned, mean, cov, *posterior, 0.0)
    assert learned.phase[clock] == LEARNED


def test_derivatives_of_what_is_held_for_a_while_begin_anew() -> None:
    """Also where nothing else is learned, and where no time passes."""
    for dt in (DT, 0.0):
        learned = unknown(Density.ACCEL)
        followed(Density.ACCEL, white(Density.ACCEL, 0.5, 50, 4), learned)
        assert learned.cov[Density.ACCEL].any()
        learned.phase[Density.ACCEL] = HELD
        move(learned, np.zeros(6), dt, motion_parameters(), NO_BIAS)
        assert not learned.mean[Density.ACCEL].any()
        assert not learned.cov[Density.ACCEL].any()


def test_what_is_held_stays() -> None:
    """Neither is written nor learned."""
    learned = unknown_densities(6, (False, False))
    motion = motion_parameters(accel=0.7, drift_density=3.0)
    before = motion.copy()
    write_densities(learned, motion)
    move(learned, np.zeros(6), DT, motion, NO_BIAS)
    learn(learned, np.zeros(6), np.eye(6), np.ones(6), 0.5 * np.eye(6), 0.0)
    np.testing.assert_array_equal(motion, before)
    assert not learned.phase.any()
    assert not learned.cov.any()


def test_new_states_do_not_depend_on_it_and_known_ones_are_no_trouble() -> None:
    learned = unknown(Density.ACCEL)
    followed(Density.ACCEL, white(Density.ACCEL, 0.5, 100, 4), learned)
    larger = resized(learned, 8)
    np.testing.assert_array_equal(larger.cov[:, :6, :6], learned.cov)
    assert not larger.cov[:, 6:].any()
    larger.theta[0] = 7.0
    assert learned.theta[0, 0] != 7.0
    prior = np.diag([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])  # a clock without error
    mean, cov, _ = updated(Density.ACCEL, np.zeros(6), prior, np.array([0.3, 0.1]))
    learn(learned, np.zeros(6), prior, mean, cov, 0.0)
    assert np.isfinite(density_of(learned, Density.ACCEL))
