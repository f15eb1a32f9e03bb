"""The smoother against FilterPy's and against batch least squares."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from netpos.estimation import smooth
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import Kind
from netpos.estimation.motion import (
    NO_BIAS,
    Model,
    ProcessNoise,
    motion_parameters,
    noise,
    propagate,
    transition,
)
from netpos.messages.values import Array

Maker = Callable[..., Array]
OPEN = np.array([np.inf])
MOTION = motion_parameters(accel=1.0, offset_density=0.3, drift_density=0.2)
BIAS = np.array([[2.0], [20.0]])
H = np.array([[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 1.0, 0], [1, 1, 0, 0, 1, 0.0]])


def filtered(
    row: Maker, dts: Array, motion: Array, bias: Array, prior: tuple[Array, Array], seed: int = 0
) -> tuple[Array, Array, Array]:
    """Filtered means and covariances of random LINEAR values, and the values."""
    rng = np.random.default_rng(seed)
    mean, cov = prior[0].copy(), prior[1].copy()
    means, covs, values = [], [], rng.normal(size=(dts.size + 1, 3)) * 3.0
    work = ekf.workspace(mean.size, 3)
    for k, z in enumerate(values):
        if k:
            ekf.predict(mean, cov, dts[k - 1], motion, bias)
        rows = np.array([row(Kind.LINEAR, z[i], 1.0 + i, i, h=H[i]) for i in range(3)])
        ekf.update(mean, cov, rows, 0.0, OPEN, 1, np.zeros(3), work)
        means.append(mean.copy())
        covs.append(cov.copy())
    return np.array(means), np.array(covs), values


def matrices(mean: Array, dt: float, motion: Array, bias: Array) -> tuple[Array, Array]:
    F, Q = np.empty((mean.size, mean.size)), np.empty((mean.size, mean.size))
    transition(mean, dt, motion, bias, F)
    noise(mean, dt, motion, bias, Q)
    return F, Q


def batch(
    dts: Array, motion: Array, bias: Array, prior: tuple[Array, Array], values: Array
) -> tuple[Array, Array]:
    """All states at once from the normal equations of prior, steps and measurements."""
    n, count = prior[0].size, dts.size + 1
    information, vector = np.zeros((count * n, count * n)), np.zeros(count * n)
    P_inv = np.linalg.inv(prior[1])
    information[:n, :n] += P_inv
    vector[:n] += P_inv @ prior[0]
    h = np.zeros((3, n))
    h[:, :6] = H
    R_inv = np.diag([1.0, 1 / 2, 1 / 3])
    for k in range(count):
        at = slice(k * n, (k + 1) * n)
        information[at, at] += h.T @ R_inv @ h
        vector[at] += h.T @ R_inv @ values[k]
        if k:
            F, Q = matrices(prior[0], dts[k - 1], motion, bias)
            both = slice((k - 1) * n, (k + 1) * n)
            A = np.hstack([-F, np.eye(n)])
            information[both, both] += A.T @ np.linalg.inv(Q) @ A
    cov = np.linalg.inv(information)
    blocks = np.array([cov[k * n : (k + 1) * n, k * n : (k + 1) * n] for k in range(count)])
    return (cov @ vector).reshape(count, n), blocks


def test_smoother_equals_batch_least_squares(row: Maker, random_cov: Maker) -> None:
    rng = np.random.default_rng(1)
    dts, prior = rng.uniform(0.5, 2.0, 12), (rng.normal(size=7), random_cov(rng, 7))
    means, covs, values = filtered(row, dts, MOTION, BIAS, prior)
    kept, kept_covs = means.copy(), covs.copy()
    smoothed, smoothed_covs = smooth.rts(dts, means, covs, MOTION[None], BIAS)
    expected, expected_covs = batch(dts, MOTION, BIAS, prior, values)
    np.testing.assert_allclose(smoothed, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(smoothed_covs, expected_covs, rtol=1e-9, atol=1e-9)
    assert (smoothed_covs == smoothed_covs.transpose(0, 2, 1)).all()
    assert (means == kept).all()
    assert (covs == kept_covs).all()
    window = slice(4, 13)
    lagged, lagged_covs = smooth.rts(dts[4:], means[window], covs[window], MOTION[None], BIAS)
    np.testing.assert_allclose(lagged[0], expected[4], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(lagged_covs[0], expected_covs[4], rtol=1e-9, atol=1e-9)


def test_smoother_equals_filterpys(row: Maker, random_cov: Maker) -> None:
    rng = np.random.default_rng(2)
    dts, prior = np.full(30, 0.7), (rng.normal(size=6), random_cov(rng, 6))
    means, covs, _ = filtered(row, dts, MOTION, NO_BIAS, prior)
    reference = KalmanFilter(dim_x=6, dim_z=3)
    reference.F, reference.Q = matrices(prior[0], 0.7, MOTION, NO_BIAS)
    expected, expected_covs, _, _ = reference.rts_smoother(means, covs)
    smoothed, smoothed_covs = smooth.rts(dts, means, covs, MOTION[None], NO_BIAS)
    np.testing.assert_allclose(smoothed, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(smoothed_covs, expected_covs, rtol=1e-9, atol=1e-9)


def test_curved_motion_goes_through_the_model(random_cov: Maker) -> None:
    """The textbook's equations with f and its Jacobian, and a motion of its own for each step."""
    rng = np.random.default_rng(3)
    motions = np.array(
        [motion_parameters(Model.CONSTANT_TURN, accel=a, turn_rate=0.1) for a in (0.5, 2.0, 1.0)]
    )
    motions[:, 5:7] = 0.1
    means = np.cumsum(rng.normal(size=(4, 7)) * 0.3, axis=0)
    means += np.array([0, 0, 3, 1, 0, 0, 0.4])
    covs, dts = np.array([random_cov(rng, 7, 0.1) for _ in range(4)]), np.array([0.5, 0.3, 0.8])
    expected, expected_cov = means[-1], covs[-1]
    smoothed, smoothed_covs = smooth.rts(dts, means, covs, motions, NO_BIAS)
    for k in (2, 1, 0):
        F, _ = matrices(means[k], dts[k], motions[k], NO_BIAS)
        predicted = means[k].copy()
        propagate(predicted, dts[k], motions[k], NO_BIAS)
        _, Q = matrices(predicted, dts[k], motions[k], NO_BIAS)
        P = F @ covs[k] @ F.T + Q
        C = covs[k] @ F.T @ np.linalg.inv(P)
        expected_cov = covs[k] + C @ (expected_cov - P) @ C.T
        expected = means[k] + C @ (expected - predicted)
        np.testing.assert_allclose(smoothed[k], expected, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(smoothed_covs[k], expected_cov, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("model", [Model.CONSTANT_VELOCITY, Model.STATIONARY])
def test_two_entries_at_one_time_are_one(model: Model, random_cov: Maker) -> None:
    """dt = 0: the later one knows all the earlier one does."""
    rng = np.random.default_rng(4)
    means, covs = rng.normal(size=(2, 6)), np.array([random_cov(rng, 6) for _ in range(2)])
    smoothed, smoothed_covs = smooth.rts(
        np.zeros(1), means, covs, motion_parameters(model)[None], NO_BIAS
    )
    np.testing.assert_allclose(smoothed[0], means[1], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(smoothed_covs[0], covs[1], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("kind", [ProcessNoise.WERNER, ProcessNoise.WHITE_ACCELERATION])
def test_singular_prediction(kind: ProcessNoise, row: Maker) -> None:
    """Clock known, noise without position part: the pseudo-inverse says the same, nothing blows up
    and what is known stays."""
    motion = motion_parameters(noise=kind, accel=0.5, velocity_step=0.3)
    dts, prior = np.full(15, 0.5), (np.zeros(6), np.diag([4.0, 4, 1, 1, 0, 0]))
    means, covs, _ = filtered(row, dts, motion, NO_BIAS, prior)
    smoothed, smoothed_covs = smooth.rts(dts, means, covs, motion[None], NO_BIAS)
    F, Q = matrices(prior[0], 0.5, motion, NO_BIAS)
    expected, expected_cov = means[-1], covs[-1]
    for k in range(14, -1, -1):
        P = F @ covs[k] @ F.T + Q
        C = covs[k] @ F.T @ np.linalg.pinv(P, rcond=1e-11, hermitian=True)
        expected = means[k] + C @ (expected - F @ means[k])
        expected_cov = covs[k] + C @ (expected_cov - P) @ C.T
        np.testing.assert_allclose(smoothed[k], expected, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(smoothed_covs[k], expected_cov, rtol=1e-9, atol=1e-8)
        assert np.linalg.eigvalsh(smoothed_covs[k]).min() > -1e-12
    assert (smoothed[:, 4:] == 0.0).all()


def test_smoothing_helps_and_stays_definite(row: Maker) -> None:
    """Over a simulated ride every variance shrinks, positions come closer to the truth and the
    errors keep to the covariance."""
    rng = np.random.default_rng(5)
    dts, count = np.full(200, 0.2), 201
    F, Q = matrices(np.zeros(6), 0.2, MOTION, NO_BIAS)
    truth, root = [np.zeros(6)], np.linalg.cholesky(Q)
    for _ in dts:
        truth.append(F @ truth[-1] + root @ rng.normal(size=6))
    mean, cov, work = rng.normal(size=6), np.eye(6), ekf.workspace(6, 3)
    means, covs = np.empty((count, 6)), np.empty((count, 6, 6))
    for k in range(count):
        if k:
            ekf.predict(mean, cov, 0.2, MOTION, NO_BIAS)
        z = H @ truth[k] + rng.normal(size=3) * np.sqrt([1.0, 2, 3])
        rows = np.array([row(Kind.LINEAR, z[i], 1.0 + i, i, h=H[i]) for i in range(3)])
        ekf.update(mean, cov, rows, 0.0, OPEN, 1, np.zeros(3), work)
        means[k], covs[k] = mean, cov
    smoothed, smoothed_covs = smooth.rts(dts, means, covs, MOTION[None], NO_BIAS)
    away, smoothed_away = means - np.array(truth), smoothed - np.array(truth)
    assert np.mean(smoothed_away[:, 0] ** 2) < 0.7 * np.mean(away[:, 0] ** 2)
    diagonals = np.diagonal(smoothed_covs, axis1=1, axis2=2)
    assert (diagonals <= np.diagonal(covs, axis1=1, axis2=2) * (1 + 1e-9)).all()
    assert np.linalg.eigvalsh(smoothed_covs).min() > 0.0
    nees = np.mean(
        [e @ np.linalg.solve(P, e) for e, P in zip(smoothed_away, smoothed_covs, strict=True)]
    )
    assert 3.0 < nees < 10.0
