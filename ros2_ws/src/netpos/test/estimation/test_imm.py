"""Interacting models against FilterPy's estimator, and on a ride with a stop and a turn."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator, KalmanFilter
from netpos.estimation import imm
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import Kind
from netpos.estimation.motion import (
    NO_BIAS,
    Model,
    Parameter,
    motion_parameters,
    noise,
    transition,
)
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array
from scipy.linalg import expm
from scipy.stats import multivariate_normal

Maker = Callable[..., Array]
OPEN = np.array([np.inf])


@pytest.mark.parametrize("dt", [1e-6, 0.1, 3.0, 1e5])
@pytest.mark.parametrize("sojourn", [[5.0, 20.0], [5.0, 20.0, 8.0], [0.01, 1e4, 7.0, 3.0]])
def test_transition_matrix(sojourn: list[float], dt: float) -> None:
    sojourn_s = np.array(sojourn)
    count = sojourn_s.size
    rates = np.repeat(1.0 / sojourn_s / (count - 1), count).reshape(count, count)
    rates[np.diag_indices(count)] = -1.0 / sojourn_s
    result = imm.transition_matrix(sojourn_s, dt)
    np.testing.assert_allclose(result, expm(rates * dt), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(result.sum(axis=1), 1.0, rtol=1e-9)
    assert (result >= 0.0).all()


def test_one_model_stays() -> None:
    assert imm.transition_matrix(np.array([3.0]), 1.0).tolist() == [[1.0]]


def test_linear_track_equals_filterpy(row: Maker, random_cov: Maker) -> None:
    """Two noise levels of constant velocity, positions measured."""
    rng = np.random.default_rng(0)
    dt, n, sojourn_s = 0.5, 6, np.array([10.0, 4.0])
    motions = np.array([motion_parameters(accel=a, offset_density=0.1) for a in (0.1, 3.0)])
    motions[:, Parameter.DRIFT_DENSITY] = 0.1
    rates = np.array([[-0.1, 0.1], [0.25, -0.25]])
    means, covs = rng.normal(size=(2, n)), np.array([random_cov(rng, n) for _ in range(2)])
    weights, H, R = np.array([0.6, 0.4]), np.eye(2, n), np.diag([2.0, 3.0])
    filters = []
    for k in range(2):
        f = KalmanFilter(dim_x=n, dim_z=2)
        f.x, f.P, f.H, f.R = means[k].copy(), covs[k].copy(), H, R
        transition(means[k], dt, motions[k], NO_BIAS, f.F)
        noise(means[k], dt, motions[k], NO_BIAS, f.Q)
        filters.append(f)
    reference = IMMEstimator(filters, weights.copy(), expm(rates * dt))
    work, accepted, mean, cov = ekf.workspace(n, 2), np.zeros(1), np.empty(n), np.empty((n, n))
    wild = []
    for step in range(40):
        z = np.array([0.8 * step + rng.normal(), (step > 20) * 3.0 * (step - 20) + rng.normal()])
        rows = np.array([row(Kind.LINEAR, z[i], R[i, i], 0, h=H[i]) for i in range(2)])
        imm.predict(imm.Models(means, covs, weights), dt, motions, sojourn_s, NO_BIAS)
        imm.update(imm.Models(means, covs, weights), rows, 0.0, OPEN, 1, accepted, work)
        imm.combine(means, covs, weights, mean, cov)
        reference.predict()
        reference.update(z)
        np.testing.assert_allclose(weights, reference.mu, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(mean, reference.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(cov, reference.P, rtol=1e-9, atol=1e-9)
        wild.append(weights[1])
        for k in range(2):
            np.testing.assert_allclose(means[k], filters[k].x, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(covs[k], filters[k].P, rtol=1e-9, atol=1e-9)
    assert wild[20] < 0.5
    assert max(wild[21:]) > 0.8


def test_mixture_moments_by_sampling(random_cov: Maker) -> None:
    rng = np.random.default_rng(2)
    means, covs = 3.0 * rng.normal(size=(3, 2)), np.array([random_cov(rng, 2) for _ in range(3)])
    weights, mean, cov = np.array([0.2, 0.5, 0.3]), np.empty(2), np.empty((2, 2))
    imm.combine(means, covs, weights, mean, cov)
    counts = 200_000 * weights
    samples = np.vstack(
        [rng.multivariate_normal(means[k], covs[k], int(counts[k])) for k in range(3)]
    )
    np.testing.assert_allclose(mean, samples.mean(axis=0), rtol=1e-9, atol=0.02)
    np.testing.assert_allclose(cov, np.cov(samples.T), rtol=0.02, atol=0.05)
    assert (cov == cov.T).all()


def test_spread_of_a_mixture_far_from_the_origin(random_cov: Maker) -> None:
    """Eastings and northings: the covariance does not change where all means move alike, to the
    digits of a metre and not of its product with a northing."""
    rng = np.random.default_rng(5)
    away, weights = rng.integers(-9, 10, size=(3, 2)) / 8.0, np.array([0.2, 0.5, 0.3])
    covs, mean, cov = np.array([random_cov(rng, 2) for _ in range(3)]), np.empty(2), np.eye(2)
    imm.combine(np.array([500_000.0, 6_600_000.0]) + away, covs, weights, mean, cov)
    expected = np.einsum("k,kab->ab", weights, covs) + np.cov(away.T, aweights=weights, ddof=0)
    np.testing.assert_allclose(cov, expected, rtol=1e-12)


def test_log_likelihood_equals_scipys(row: Maker, random_cov: Maker) -> None:
    rng = np.random.default_rng(3)
    mean, cov, H = rng.normal(size=6), random_cov(rng, 6), rng.normal(size=(3, 6))
    variance, z = np.array([1.0, 2.0, 3.0]), rng.normal(size=3)
    rows = np.array(
        [
            row(Kind.LINEAR, z[i], variance[i], h=H[i], gate_variance=variance[i] / 9)
            for i in range(3)
        ]
    )
    S = H @ cov @ H.T + np.diag(variance)
    expected = multivariate_normal(H @ mean, S).logpdf(z)
    assert imm.log_likelihood(mean, cov, rows, 0.0) == pytest.approx(expected, rel=1e-12)


def test_likelihood_counts_the_curvature(row: Maker) -> None:
    """What the filter adds to a variance where a range bends is in its likelihood too."""
    mean, cov = np.array([3.0, 0, 0, 0, 0, 0]), np.diag([1e-12, 4.0, 1, 1, 1, 1])
    rows = np.array([row(Kind.RANGE, 4.0, 0.5)])
    spread = 0.5 + 0.5 * (4.0 / 3.0) ** 2
    expected = multivariate_normal(3.0, spread).logpdf(4.0)
    assert imm.log_likelihood(mean, cov, rows, 0.0) == pytest.approx(expected, rel=1e-9)


def test_weights_never_die() -> None:
    weights = np.array([0.5, 0.3, 0.2])
    imm.reweigh(weights, np.array([-1e6, -5.0, -5.0 + math.log(2.0)]))
    assert weights[0] == pytest.approx(1e-12, rel=1e-9)
    assert weights[1] == pytest.approx(3.0 / 7.0, rel=1e-9)
    assert weights.sum() == pytest.approx(1.0, abs=1e-15)
    for _ in range(3):
        imm.reweigh(weights, np.array([0.0, -2000.0, -3000.0]))
    assert weights[0] > 0.999
    assert (weights >= 0.999e-12).all()
    imm.mix(np.zeros((3, 1)), np.ones((3, 1, 1)), weights, np.eye(3))
    assert (weights >= 0.999e-12).all()


def test_a_model_left_for_long_comes_back() -> None:
    """Half of its probability passes on each time and nothing back: 2^-2000 is no number."""
    means, covs = np.array([[0.0], [8.0]]), np.ones((2, 1, 1))
    weights, transition = np.array([0.5, 0.5]), np.array([[1.0, 0.0], [0.5, 0.5]])
    for _ in range(2000):
        imm.mix(means, covs, weights, transition)
    assert weights[1] == pytest.approx(1e-12, rel=1e-9)
    assert weights.sum() == pytest.approx(1.0, abs=1e-15)
    assert means[1, X.PX] == 8.0
    assert means[0, X.PX] == pytest.approx(4.0)
    assert covs[0, X.PX, X.PX] == pytest.approx(17.0)


def test_one_decision_for_all_models(row: Maker) -> None:
    """Rejected by each model alone, accepted by their mixture: its spread counts. Rejected by the
    mixture: nobody moves."""
    means, covs = np.zeros((2, 6)), np.array([np.eye(6)] * 2)
    means[:, X.PX] = -10.0, 10.0
    rows = np.array(
        [
            row(Kind.LINEAR, 0.0, 1.0, 0, h=[1, 0, 0, 0, 0, 0]),
            row(Kind.LINEAR, 20.0, 1.0, 1, h=[0, 1, 0, 0, 0, 0]),
        ]
    )
    weights, accepted, work = np.array([0.5, 0.5]), np.full(2, 9.0), ekf.workspace(6, 2)
    gate_nis = np.array([0.0, 9.0])
    before = means.copy()
    nis, dof = imm.update(imm.Models(means, covs, weights), rows, 0.0, gate_nis, 1, accepted, work)
    assert accepted.tolist() == [1.0, 0.0]
    assert (nis, dof) == (pytest.approx(0.0, abs=1e-12), 1)
    np.testing.assert_allclose(means[:, X.PX], [-5.0, 5.0], rtol=1e-12)
    assert (means[:, 1:] == before[:, 1:]).all()
    before, before_covs = means.copy(), covs.copy()
    result = imm.update(
        imm.Models(means, covs, weights), rows[1:], 0.0, gate_nis, 1, accepted, work
    )
    assert result == (0.0, 0)
    assert accepted[1] == 0.0
    assert (means == before).all()
    assert (covs == before_covs).all()
    assert weights.tolist() == [0.5, 0.5]
    imm.predict(imm.Models(means, covs, weights), 0.0, np.zeros((2, 16)), np.ones(2), NO_BIAS)
    assert (means == before).all()


DT = 0.2
# Seconds, acceleration [m/s^2] and turn rate [rad/s] of each phase, and the model that suits it.
PHASES = (
    (8.0, 0.0, 0.0, 0),
    (4.0, 2.5, 0.0, None),
    (8.0, 0.0, 0.0, 1),
    (6.0, 0.0, 0.3, 2),
    (8.0, 0.0, 0.0, 1),
    (4.0, -2.5, 0.0, None),
    (8.0, 0.0, 0.0, 0),
)


def ride() -> Array:
    """True x, y of each step."""
    p, heading, speed, out = np.zeros(2), 0.3, 0.0, []
    for duration, accel, rate, _ in PHASES:
        for _ in range(round(duration / DT)):
            middle = heading + rate * DT / 2
            p = p + (speed + accel * DT / 2) * DT * np.array([math.cos(middle), math.sin(middle)])
            heading, speed = heading + rate * DT, speed + accel * DT
            out.append(p)
    return np.array(out)


def interacting_set() -> Array:
    common = {"offset_density": 0.01, "drift_density": 0.01, "idle": 0.1}
    return np.array(
        [
            motion_parameters(Model.STATIONARY, extras=1, rest_speed=0.05, **common),
            motion_parameters(Model.CONSTANT_VELOCITY, extras=1, accel=1.0, **common),
            motion_parameters(Model.CONSTANT_TURN, accel=1.0, turn_rate=0.1, **common),
        ]
    )


def positions(row: Maker, truth: Array, rng: np.random.Generator) -> Array:
    z = truth + 0.3 * rng.normal(size=2)
    return np.array([row(Kind.LINEAR, z[i], 0.09, 0, h=np.eye(6)[i]) for i in range(2)])


def test_only_ratios_of_likelihoods_count() -> None:
    """However unlikely all are; and what no model can explain speaks for none."""
    weights = np.array([0.5, 0.3, 0.2])
    imm.reweigh(weights, np.log([0.2, 0.5, 0.1]) - 5000.0)
    np.testing.assert_allclose(weights, np.array([0.1, 0.15, 0.02]) / 0.27, rtol=1e-9)
    before = weights.copy()
    imm.reweigh(weights, np.full(3, -np.inf))
    assert (weights == before).all()


def test_likelihood_of_what_says_the_same_twice(row: Maker) -> None:
    """S is singular to rounding: the second row adds nothing, and nothing breaks."""
    mean, cov = np.zeros(6), np.diag([1e10, 1, 1, 1, 1, 1.0])
    rows = np.array([row(Kind.LINEAR, 3.0, 1e-10, 0, h=[1, 0, 0, 0, 0, 0])] * 2)
    expected = multivariate_normal(0.0, 1e10).logpdf(3.0)
    assert imm.log_likelihood(mean, cov, rows, 0.0) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_stop_straight_turn(seed: int, row: Maker) -> None:
    """The right model leads in the second half of each phase, and the mixture beats the single
    constant-velocity filter with the acceleration that suits it best."""
    rng = np.random.default_rng(seed)
    truth = ride()
    epochs = [positions(row, p, rng) for p in truth]
    motions, sojourn_s = interacting_set(), np.array([8.0, 8.0, 6.0])
    means, covs = np.zeros((3, 7)), np.array([np.diag([1.0, 1, 1, 1, 1, 1, 0.01])] * 3)
    weights, accepted, work = np.full(3, 1 / 3), np.zeros(1), ekf.workspace(7, 2)
    mean, cov, errors, leader = np.empty(7), np.empty((7, 7)), [], []
    for rows, p in zip(epochs, truth, strict=True):
        imm.predict(imm.Models(means, covs, weights), DT, motions, sojourn_s, NO_BIAS)
        imm.update(imm.Models(means, covs, weights), rows, 0.0, OPEN, 1, accepted, work)
        imm.combine(means, covs, weights, mean, cov)
        errors.append(np.sum((mean[POSITION] - p) ** 2))
        leader.append(int(np.argmax(weights)))
    single = min(constant_velocity(epochs, truth, accel) for accel in (0.5, 1.0, 2.0, 3.0))
    assert math.sqrt(np.mean(errors)) < 0.93 * single
    start = 0
    for duration, _, _, model in PHASES:
        stop = start + round(duration / DT)
        if model is not None:
            assert np.mean(np.array(leader[(start + stop) // 2 : stop]) == model) > 0.7
        start = stop


def constant_velocity(epochs: list[Array], truth: Array, accel: float) -> float:
    motion = motion_parameters(accel=accel, offset_density=0.01, drift_density=0.01)
    mean, cov, work, errors = np.zeros(6), np.eye(6), ekf.workspace(6, 2), []
    for rows, p in zip(epochs, truth, strict=True):
        ekf.predict(mean, cov, DT, motion, NO_BIAS)
        ekf.update(mean, cov, rows, 0.0, OPEN, 1, np.zeros(1), work)
        errors.append(np.sum((mean[POSITION] - p) ** 2))
    return math.sqrt(np.mean(errors))
