"""Bounds of the mean NEES of one run: coverage, scale, power, against simulation."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.evaluation.consistency import (
    MeanTest,
    chi2_mean_bounds,
    nees_test,
    nis_test,
    whitened,
)
from netpos.evaluation.correlated import DRAWS, cosine_variances, mean_square_given_shape
from netpos.messages.values import Array
from netpos.reproduction.experiment import setup_of
from netpos.reproduction.fokin2020.paper import WANDER
from scipy.fft import dct
from scipy.linalg import solve_discrete_are, toeplitz
from scipy.signal import lfilter
from scipy.stats import kstest

RATE_HZ = 10.0


def autoregressive(rng: np.random.Generator, n: int, phi: float) -> Array:
    """(n, 2) AR(1) series of variance 1."""
    noise = rng.normal(size=(n, 2))
    noise[1:] *= np.sqrt(1.0 - phi**2)
    return np.asarray(lfilter([1.0], [1.0, -phi], noise, axis=0))


class Filter:
    """Steady-state Kalman filter of position, velocity and a measurement's slow bias; one axis,
    equations written out here.
    """

    def __init__(self, accel: float, sd_m: float, bias_sd_m: float, bias_time_s: float) -> None:
        dt, a = 1.0 / RATE_HZ, np.exp(-1.0 / RATE_HZ / bias_time_s)
        F = np.array([[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, a]])
        Q = np.zeros((3, 3))
        Q[:2, :2] = accel**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        Q[2, 2] = bias_sd_m**2 * (1.0 - a**2)
        H = np.array([[1.0, 0.0, 1.0]])
        prior = solve_discrete_are(F.T, H.T, Q, np.array([[sd_m**2]]))
        self._S = float(prior[0, 0] + 2 * prior[0, 2] + prior[2, 2]) + sd_m**2
        gain = prior @ H.T / self._S
        rest = np.eye(3) - gain @ H
        self._cov = rest @ prior
        self._F, self._rest, self._gain, self._H = F, rest, gain[:, 0], H
        self._q, self._sd = np.linalg.cholesky(Q), sd_m

    def errors(self, rng: np.random.Generator, n: int) -> tuple[Array, Array]:
        """(n, 2) normalised position errors on two axes, and (n,) their joint NIS (2 dof)."""
        e = np.linalg.cholesky(self._cov) @ rng.normal(size=(3, 2))
        process = np.einsum("ij,njm->nim", self._q, rng.normal(size=(n, 3, 2)))
        noise = self._sd * rng.normal(size=(n, 2))
        series, nis = np.empty((n, 2)), np.empty(n)
        for k in range(n):
            e = self._F @ e - process[k]
            innovation = noise[k] - (self._H @ e)[0]
            nis[k] = innovation @ innovation / self._S
            e = e + np.outer(self._gain, innovation)
            series[k] = e[0]
        return series / np.sqrt(self._cov[0, 0]), nis


def verdict(errors: Array) -> MeanTest:
    test = nees_test(errors)
    assert test is not None
    return test


@pytest.mark.parametrize("phi", [-0.6, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("n", [1, 2, 3, 40])
def test_variances_under_the_cosine_transform(n: int, phi: float) -> None:
    """Against the transform of the whole covariance matrix."""
    transform = dct(np.eye(n), norm="ortho", axis=0)
    full = transform @ toeplitz(phi ** np.arange(n)) @ transform.T
    np.testing.assert_allclose(cosine_variances(n, phi), np.diag(full), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("n", "phi"), [(20, 0.5), (50, 0.97), (200, 0.99), (1000, 0.9)])
def test_95_percent_of_consistent_filters_pass(n: int, phi: float) -> None:
    """AR(1) errors, 400 runs: a standard error of 1.1 %."""
    rng = np.random.default_rng([n, int(100 * phi), 5])
    passed = sum(verdict(autoregressive(rng, n, phi)).consistent for _ in range(400))
    assert 0.93 <= passed / 400 <= 0.97


@pytest.mark.parametrize(("n", "least"), [(2000, 0.91), (500, 0.85)])
def test_errors_of_a_kalman_filter_pass_at_the_nominal_rate(n: int, least: float) -> None:
    """Scales of about 0.3 s, 1 s and 10 s, 120 runs: a standard error of 2 %. In 20 times the
    longest scale 95 % pass; in 5 times about 90 %, as it hardly shows.
    """
    model, rng = Filter(1.0, 1.0, 0.7, 10.0), np.random.default_rng(11)
    passed = sum(verdict(model.errors(rng, n)[0]).consistent for _ in range(120))
    assert least <= passed / 120 <= 0.99


def test_errors_of_the_tracker_pass_at_the_nominal_rate() -> None:
    """300 runs of METIS whose motion is drawn from the tracker's own model, cut to several
    lengths after the 20 epochs that never count."""
    setup, passed = setup_of(WANDER), {20: 0, 50: 0, 150: 0}
    for seed in range(1000, 1300):
        run = setup.run(seed)
        error, cov = (run.mean - run.truth)[20:, :2], run.cov[20:, :2, :2]
        normalised, usable = whitened(error, cov)
        assert usable.all()
        for length in passed:
            test = nees_test(normalised[:length])
            assert test is not None
            passed[length] += test.consistent
    assert all(0.93 <= number / 300 <= 0.97 for number in passed.values()), passed


def test_innovations_of_a_kalman_filter_pass_at_the_nominal_rate() -> None:
    """They are white; 400 runs of 100 epochs: a standard error of 1.1 %."""
    model, rng = Filter(1.0, 1.0, 0.7, 10.0), np.random.default_rng(12)
    passed = 0
    for _ in range(400):
        test = nis_test(model.errors(rng, 100)[1], np.full(100, 2.0))
        assert test is not None
        passed += test.consistent
    assert 0.93 <= passed / 400 <= 0.97


@pytest.mark.parametrize("factor", [1e-6, 0.3, 7.0, 1e6])
def test_bounds_do_not_know_the_scale(factor: float) -> None:
    """A filter cannot widen its bounds by large errors, nor one axis those of the other."""
    errors = autoregressive(np.random.default_rng(1), 300, 0.9)
    test, scaled = verdict(errors), verdict(errors * np.array([factor, 1.0]))
    np.testing.assert_allclose(scaled.bounds, test.bounds, rtol=1e-9)
    assert scaled.mean == pytest.approx(np.mean(errors**2, axis=0) @ [factor**2, 1.0])


def test_the_same_errors_give_the_same_bounds() -> None:
    errors = autoregressive(np.random.default_rng(2), 100, 0.5)
    assert verdict(errors) == verdict(errors)


@pytest.mark.parametrize("sd", [0.75, 1.35])
def test_a_covariance_off_by_a_third_is_noticed(sd: float) -> None:
    """40 runs with about 110 independent epochs each."""
    rng = np.random.default_rng(3)
    noticed = sum(not verdict(sd * autoregressive(rng, 1000, 0.9)).consistent for _ in range(40))
    assert noticed >= 36


def test_white_errors_have_the_bounds_of_chi_square() -> None:
    test = verdict(np.random.default_rng(4).normal(size=(1000, 2)))
    np.testing.assert_allclose(test.bounds, chi2_mean_bounds(2, 1000), rtol=0.02)
    assert 800 <= test.n_eff <= 1000


@pytest.mark.parametrize("value", [0.0, 2.0])
def test_constant_errors_are_about_one_value(value: float) -> None:
    """They pass unless one draw of chi-square with 2 degrees of freedom hardly were as large."""
    assert 0.5 < verdict(np.full((400, 2), value)).n_eff < 2.5
    assert not verdict(np.full((400, 2), 4.0)).consistent
    assert verdict(np.full((400, 2), 1.0)).consistent


def test_one_epoch_is_one_chi_square_value() -> None:
    draws = mean_square_given_shape(np.array([3.0]), np.random.default_rng(5))
    assert draws.shape == (DRAWS,)
    assert kstest(draws, "chi2", args=(1,)).pvalue > 0.01


def test_no_epoch_has_no_verdict() -> None:
    assert nees_test(np.zeros((0, 2))) is None


def test_what_is_expected_is_never_outside() -> None:
    """Errors that go round with a device on its rounds, or come in a few bumps, are like no
    mixture of exponentials; their shape alone would have bounds beside the expected 2."""
    t, rng = np.arange(8000) / 8000.0, np.random.default_rng(2)
    rounds = np.stack([np.sin(2 * np.pi * 17 * t), np.cos(2 * np.pi * 17 * t)], axis=1)
    bumps = np.zeros((t.size, 2))
    for at, size in zip(rng.uniform(size=12), 5.0 * rng.normal(size=(12, 2)), strict=True):
        bumps += size * np.exp(-0.5 * ((t - at) / 0.0075) ** 2)[:, None]
    for series in (rounds, bumps):
        errors = series + 0.05 * rng.normal(size=series.shape)
        errors *= np.sqrt(2.0 / np.einsum("ni,ni->n", errors, errors).mean())
        by_shape = sum(mean_square_given_shape(e, np.random.default_rng(0)) for e in errors.T)
        low, high = np.quantile(by_shape, [0.025, 0.975])
        assert not low <= 2.0 <= high
        test = nees_test(errors)
        assert test is not None
        assert test.consistent
