"""Interacting models, components of one mixture, against FilterPy's estimator, and on a ride with
a stop and a turn."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator, KalmanFilter
from netpos.estimation.engine import EpochInput, FilterOptions
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import ROW_WIDTH, Kind
from netpos.estimation.mixture import epoch as epochs
from netpos.estimation.mixture import mixing
from netpos.estimation.mixture.candidates import Update
from netpos.estimation.mixture.epoch import Dynamics
from netpos.estimation.mixture.gaussians import Mixture, combine, moments
from netpos.estimation.motion import (
    NO_BIAS,
    Model,
    Parameter,
    motion_parameters,
    noise,
    transition,
)
from netpos.estimation.state import POSITION, X
from netpos.estimation.update.fit import neg2_log_likelihood
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import options_of
from scipy.linalg import expm
from scipy.stats import multivariate_normal

Maker = Callable[..., Array]
OPEN = np.array([np.inf])
NO_ROWS = np.empty((0, ROW_WIDTH))


def options_for(models: int, gate_nis: Array = OPEN) -> FilterOptions:
    """Of an extended Kalman filter for as many interacting models."""
    config = TrackerConfig(filter="ekf", motion_model="interacting")
    return options_of(config)._replace(models=models, gate_nis=gate_nis)


def after_epoch(
    before: Mixture,
    rows: Array,
    options: FilterOptions,
    accepted: Array,
    rejected_in_row: int = 0,
) -> Update:
    """The components, moved to the epoch already, after its rows."""
    epoch = EpochInput(0.5, 0.5, 0.0, rejected_in_row, rows)
    result: Update = epochs.apply_epoch(before, epoch, options, accepted)
    return result


def moved_and_updated(
    before: Mixture, dt: float, motions: Array, sojourn_s: Array, rows: Array
) -> Mixture:
    """One step without a gate."""
    options = options_for(len(motions))
    moved = epochs.move(before, dt, NO_ROWS, Dynamics(motions, sojourn_s, NO_BIAS), options)
    return after_epoch(moved, rows, options, np.zeros(1)).components


def log_likelihood(mean: Array, cov: Array, rows: Array) -> float:
    """Log density of ``rows`` as the extended Kalman filter at mean, cov sees them."""
    predicted, index = predicted_rows(mean, cov, rows, 0.0), np.arange(len(rows))
    distance, size = neg2_log_likelihood(mean, cov, rows, 0.0, predicted, index)
    return float(-0.5 * (distance + size))


@pytest.mark.parametrize("dt", [1e-6, 0.1, 3.0, 1e5])
@pytest.mark.parametrize("sojourn", [[5.0, 20.0], [5.0, 20.0, 8.0], [0.01, 1e4, 7.0, 3.0]])
def test_transition_matrix(sojourn: list[float], dt: float) -> None:
    sojourn_s = np.array(sojourn)
    count = sojourn_s.size
    rates = np.repeat(1.0 / sojourn_s / (count - 1), count).reshape(count, count)
    rates[np.diag_indices(count)] = -1.0 / sojourn_s
    result = mixing.transition_matrix(sojourn_s, dt)
    np.testing.assert_allclose(result, expm(rates * dt), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(result.sum(axis=1), 1.0, rtol=1e-9)
    assert (result >= 0.0).all()


def test_one_model_stays() -> None:
    assert mixing.transition_matrix(np.array([3.0]), 1.0).tolist() == [[1.0]]


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
    mixture = Mixture(means, covs, np.log(weights))
    wild = []
    for step in range(40):
        z = np.array([0.8 * step + rng.normal(), (step > 20) * 3.0 * (step - 20) + rng.normal()])
        rows = np.array([row(Kind.LINEAR, z[i], R[i, i], 0, h=H[i]) for i in range(2)])
        mixture = moved_and_updated(mixture, dt, motions, sojourn_s, rows)
        weights, (mean, cov) = np.exp(mixture.log_weights), moments(mixture)
        reference.predict()
        reference.update(z)
        np.testing.assert_allclose(weights, reference.mu, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(mean, reference.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(cov, reference.P, rtol=1e-9, atol=1e-9)
        wild.append(weights[1])
        for k in range(2):
            np.testing.assert_allclose(mixture.means[k], filters[k].x, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(mixture.covs[k], filters[k].P, rtol=1e-9, atol=1e-9)
    assert wild[20] < 0.5
    assert max(wild[21:]) > 0.8


def test_mixture_moments_by_sampling(random_cov: Maker) -> None:
    rng = np.random.default_rng(2)
    means, covs = 3.0 * rng.normal(size=(3, 2)), np.array([random_cov(rng, 2) for _ in range(3)])
    weights, mean, cov = np.array([0.2, 0.5, 0.3]), np.empty(2), np.empty((2, 2))
    combine(means, covs, weights, mean, cov)
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
    combine(np.array([500_000.0, 6_600_000.0]) + away, covs, weights, mean, cov)
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
    assert log_likelihood(mean, cov, rows) == pytest.approx(expected, rel=1e-12)


def test_likelihood_counts_the_curvature(row: Maker) -> None:
    """What the filter adds to a variance where a range bends is in its likelihood too,
    and by how much the mean range is longer."""
    mean, cov = np.array([3.0, 0, 0, 0, 0, 0]), np.diag([1e-12, 4.0, 1, 1, 1, 1])
    rows = np.array([row(Kind.RANGE, 4.0, 0.5)])
    spread = 0.5 + 0.5 * (4.0 / 3.0) ** 2
    expected = multivariate_normal(3.0 + 0.5 * 4.0 / 3.0, spread).logpdf(4.0)
    assert log_likelihood(mean, cov, rows) == pytest.approx(expected, rel=1e-9)


def test_weights_never_die() -> None:
    weights = np.array([0.0, 0.3, 0.6])
    for _ in range(3):
        mixing.keep_alive(weights)
    np.testing.assert_allclose(weights, [1e-12, 1.0 / 3.0, 2.0 / 3.0], rtol=1e-9)
    assert weights.sum() == pytest.approx(1.0, abs=1e-15)
    mixing.mix(np.zeros((3, 1)), np.ones((3, 1, 1)), weights, np.eye(3))
    assert (weights >= 0.999e-12).all()


def test_a_model_left_for_long_comes_back() -> None:
    """Half of its probability passes on each time and nothing back: 2^-2000 is no number."""
    means, covs = np.array([[0.0], [8.0]]), np.ones((2, 1, 1))
    weights, transition = np.array([0.5, 0.5]), np.array([[1.0, 0.0], [0.5, 0.5]])
    for _ in range(2000):
        mixing.mix(means, covs, weights, transition)
    assert weights[1] == pytest.approx(1e-12, rel=1e-9)
    assert weights.sum() == pytest.approx(1.0, abs=1e-15)
    assert means[1, X.PX] == 8.0
    assert means[0, X.PX] == pytest.approx(4.0)
    assert covs[0, X.PX, X.PX] == pytest.approx(17.0)


def two_places() -> Mixture:
    """Models that are as probable and believe the device 20 m apart, 1 m sd each."""
    means, covs = np.zeros((2, 6)), np.array([np.eye(6)] * 2)
    means[:, X.PX] = -10.0, 10.0
    return Mixture(means, covs, np.log([0.25, 0.75]))


def test_each_model_gates_by_itself(row: Maker) -> None:
    """As every component does: one takes the row, to the other it is an outlier and its weight
    falls; it stays alive where it was."""
    before, accepted = two_places(), np.full(2, 9.0)
    rows = np.array(
        [
            row(Kind.LINEAR, -9.0, 1.0, 0, h=[1, 0, 0, 0, 0, 0]),
            row(Kind.LINEAR, 20.0, 1.0, 1, h=[0, 1, 0, 0, 0, 0]),
        ]
    )
    found = after_epoch(before, rows, options_for(2, np.array([0.0, 9.0])), accepted)
    assert accepted.tolist() == [1.0, 0.0]
    assert (found.nis, found.used) == (pytest.approx(0.5), 1)
    np.testing.assert_allclose(found.components.means[:, X.PX], [-9.5, 10.0], rtol=1e-12)
    np.testing.assert_array_equal(found.components.covs[1], np.eye(6))
    assert found.components.log_weights[1] < math.log(0.75) - 1.0
    assert np.exp(found.components.log_weights).sum() == pytest.approx(1.0)


def test_what_all_models_refuse_moves_none(row: Maker) -> None:
    """And speaks for none but by how far off it is, as nobody knows how far outliers are."""
    before, accepted = two_places(), np.full(1, 9.0)
    rows = np.array([row(Kind.LINEAR, 90.0, 1.0, 0, h=[1, 0, 0, 0, 0, 0])])
    options = options_for(2, np.array([0.0, 9.0]))
    found = after_epoch(before, rows, options, accepted)
    assert (accepted.tolist(), found.nis, found.used) == ([0.0], 0.0, 0)
    np.testing.assert_allclose(found.components.means, before.means, rtol=1e-12)
    np.testing.assert_allclose(found.components.covs, before.covs, rtol=1e-12)
    weights = np.exp(before.log_weights) / [100.0, 80.0]
    np.testing.assert_allclose(np.exp(found.components.log_weights), weights / weights.sum())


def test_velocities_open_after_rejections(row: Maker) -> None:
    """Each model's own, by the initial speed over the time since it was last heard (0.5 s); where
    nothing is accepted even then, it is as if they had not."""
    before, options = two_places(), options_for(2, np.array([0.0, 9.0]))
    rows = np.array([row(Kind.LINEAR, -3.5, 1.0, 0, h=[1, 0, 0, 0, 0, 0])])
    refused = after_epoch(before, rows, options, np.zeros(1))
    assert refused.used == 0
    opened = after_epoch(before, rows, options, np.zeros(1), options.inflate_after)
    assert opened.used == 1
    variance = 1.0 + (options.initial_speed_sd * 0.5) ** 2
    expected = -10.0 + 6.5 * variance / (variance + 1.0)
    assert opened.components.means[0, X.PX] == pytest.approx(expected)
    rows[0, 1] = 1e4
    still = after_epoch(before, rows, options, np.zeros(1), options.inflate_after)
    np.testing.assert_array_equal(still.components.covs, before.covs)


def test_a_model_that_is_no_longer_sound_begins_anew(row: Maker) -> None:
    before = two_places()
    before.means[1, X.PX] = math.nan
    rows = np.array([row(Kind.LINEAR, -10.0, 1.0, 0, h=[1, 0, 0, 0, 0, 0])])
    found = after_epoch(before, rows, options_for(2), np.zeros(1)).components
    np.testing.assert_array_equal(found.means[1], found.means[0])
    np.testing.assert_array_equal(found.covs[1], found.covs[0])
    assert np.exp(found.log_weights[1]) == pytest.approx(1e-12, rel=1e-6)


def test_models_do_not_mix_without_time() -> None:
    before = two_places()
    dynamics = Dynamics(np.zeros((2, 16)), np.ones(2), NO_BIAS)
    moved = epochs.move(before, 0.0, NO_ROWS, dynamics, options_for(2))
    for got, want in zip(moved, before, strict=True):
        np.testing.assert_array_equal(got, want)


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


def test_only_ratios_of_likelihoods_count(row: Maker) -> None:
    """However unlikely all are: 1000 sd away the weights follow Bayes' rule by SciPy."""
    before = two_places()
    rows = np.array([row(Kind.LINEAR, 1000.0, 1.0, 0, h=[1, 0, 0, 0, 0, 0])])
    found = after_epoch(before, rows, options_for(2), np.zeros(1)).components
    logs = [multivariate_normal(m, 2.0).logpdf(1000.0) for m in (-10.0, 10.0)]
    logs = np.array(logs) + before.log_weights
    assert logs[0] - logs[1] < -1000.0
    assert found.log_weights[0] == pytest.approx(math.log(1e-12))
    rows[0, 1] = 0.1
    found = after_epoch(before, rows, options_for(2), np.zeros(1)).components
    logs = [multivariate_normal(m, 2.0).logpdf(0.1) for m in (-10.0, 10.0)] + before.log_weights
    np.testing.assert_allclose(
        np.exp(found.log_weights), np.exp(logs) / np.exp(logs).sum(), rtol=1e-9
    )


def test_likelihood_of_what_says_the_same_twice(row: Maker) -> None:
    """S is singular to rounding: the second row adds nothing, and nothing breaks."""
    mean, cov = np.zeros(6), np.diag([1e10, 1, 1, 1, 1, 1.0])
    rows = np.array([row(Kind.LINEAR, 3.0, 1e-10, 0, h=[1, 0, 0, 0, 0, 0])] * 2)
    expected = multivariate_normal(0.0, 1e10).logpdf(3.0)
    assert log_likelihood(mean, cov, rows) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_stop_straight_turn(seed: int, row: Maker) -> None:
    """The right model leads in the second half of each phase, and the mixture beats the single
    constant-velocity filter with the acceleration that suits it best."""
    rng = np.random.default_rng(seed)
    truth = ride()
    epochs = [positions(row, p, rng) for p in truth]
    motions, sojourn_s = interacting_set(), np.array([8.0, 8.0, 6.0])
    covs = np.array([np.diag([1.0, 1, 1, 1, 1, 1, 0.01])] * 3)
    mixture = Mixture(np.zeros((3, 7)), covs, np.log(np.full(3, 1 / 3)))
    errors, leader = [], []
    for rows, p in zip(epochs, truth, strict=True):
        mixture = moved_and_updated(mixture, DT, motions, sojourn_s, rows)
        mean, _ = moments(mixture)
        errors.append(np.sum((mean[POSITION] - p) ** 2))
        leader.append(int(np.argmax(mixture.log_weights)))
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
