"""Process models against matrix exponentials, numerical integration and the paper's matrices."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.filters.motion import (
    N_CORE,
    SPEED_OF_LIGHT_MPS,
    ProcessNoise,
    StateIndex,
    process_noise,
    transition,
)
from scipy.constants import speed_of_light
from scipy.linalg import expm

NO_BIAS = np.zeros(0)
BIAS_SD = np.array([0.3, 2.0])
BIAS_TAU = np.array([0.7, 40.0])
ACCEL, OFFSET, DRIFT = 1.7, 0.4, 0.9


def drift_matrix(tau: np.ndarray) -> np.ndarray:
    """A of dx = A x dt + noise for [x, y, vx, vy, clock, drift, biases]."""
    A = np.zeros((6 + tau.size, 6 + tau.size))
    A[0, 2] = A[1, 3] = A[4, 5] = 1.0
    A[range(6, 6 + tau.size), range(6, 6 + tau.size)] = -1.0 / tau
    return A


def spectral_density(sd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    core = [0.0, 0.0, ACCEL**2, ACCEL**2, OFFSET**2, DRIFT**2]
    return np.diag(np.concatenate([core, 2.0 * sd**2 / tau]))


def van_loan(dt: float, sd: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F and Q of the continuous model by Van Loan's block exponential."""
    A = drift_matrix(tau)
    n = len(A)
    block = np.block([[-A, spectral_density(sd, tau)], [np.zeros((n, n)), A.T]])
    exponential = expm(block * dt)
    F = exponential[n:, n:].T
    return F, F @ exponential[:n, n:]


def continuous(
    dt: float, sd: np.ndarray = NO_BIAS, tau: np.ndarray = NO_BIAS, **change: float
) -> np.ndarray:
    # The arguments of the other models are made absurd: they must not matter here.
    values = {"accel": ACCEL, "velocity_step": 1e6, "offset": OFFSET, "drift": DRIFT, **change}
    return process_noise(
        ProcessNoise.CONTINUOUS.value,
        dt,
        values["accel"],
        values["velocity_step"],
        values["offset"],
        values["drift"],
        1e6,
        sd,
        tau,
    )


def test_names() -> None:
    assert [s.name for s in StateIndex] == ["X", "Y", "VX", "VY", "CLOCK", "DRIFT"]
    assert [s.value for s in StateIndex] == list(range(N_CORE))
    assert N_CORE == 6
    assert speed_of_light == SPEED_OF_LIGHT_MPS
    assert {p.name.lower(): p.value for p in ProcessNoise} == {
        "continuous": 0,
        "werner": 1,
        "white_acceleration": 2,
    }


@pytest.mark.parametrize("dt", [0.01, 0.3, 2.5])
def test_transition_is_the_matrix_exponential(dt: float) -> None:
    expected = expm(drift_matrix(BIAS_TAU) * dt)
    np.testing.assert_allclose(transition(8, dt, BIAS_TAU), expected, rtol=1e-12, atol=1e-14)


def test_transition_is_eq_35_of_the_paper() -> None:
    T = 0.1
    rows = "1 0 T 0 0 0; 0 1 0 T 0 0; 0 0 1 0 0 0; 0 0 0 1 0 0; 0 0 0 0 1 T; 0 0 0 0 0 1"
    expected = np.array(
        [[float(v) for v in r.replace("T", "0.1").split()] for r in rows.split(";")]
    )
    np.testing.assert_array_equal(transition(6, T, NO_BIAS), expected)


@pytest.mark.parametrize("dt", [0.01, 0.3, 2.5])
def test_continuous_noise_is_the_integral_of_the_model(dt: float) -> None:
    _, expected = van_loan(dt, BIAS_SD, BIAS_TAU)
    np.testing.assert_allclose(continuous(dt, BIAS_SD, BIAS_TAU), expected, rtol=1e-9, atol=1e-14)


def test_continuous_noise_by_plain_summation() -> None:
    """The same integral by the midpoint rule, so that not both routes share an exponential."""
    dt, steps = 0.8, 2000
    ages = (np.arange(steps) + 0.5) * dt / steps
    D = spectral_density(NO_BIAS, NO_BIAS)
    total = np.zeros((6, 6))
    for age in ages:
        F = np.eye(6) + drift_matrix(NO_BIAS) * age  # exact: the core model is nilpotent
        total += F @ D @ F.T * dt / steps
    np.testing.assert_allclose(continuous(dt), total, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(("a", "b"), [(0.1, 0.4), (1.0, 1e-3), (0.0, 0.7)])
def test_continuous_noise_adds_over_time(a: float, b: float) -> None:
    """Predicting over a + b is predicting over a, then over b."""
    F = transition(8, b, BIAS_TAU)
    both = F @ continuous(a, BIAS_SD, BIAS_TAU) @ F.T + continuous(b, BIAS_SD, BIAS_TAU)
    np.testing.assert_allclose(continuous(a + b, BIAS_SD, BIAS_TAU), both, rtol=1e-12, atol=1e-16)
    np.testing.assert_allclose(
        transition(8, a + b, BIAS_TAU), F @ transition(8, a, BIAS_TAU), rtol=1e-14
    )


def test_werner_noise_is_eq_4_of_the_paper() -> None:
    """Per step, whatever its length; the noise of the other models does not enter."""
    for dt in (0.01, 3.0):
        Q = process_noise(ProcessNoise.WERNER.value, dt, 1e6, 0.2, 1e6, 1e6, 0.3, NO_BIAS, NO_BIAS)
        expected = np.diag([0.0, 0.0, 0.2**2, 0.2**2, 0.0, 0.3**2])
        np.testing.assert_allclose(Q, expected, rtol=1e-15)


def test_white_acceleration_noise_is_eq_36_of_the_paper() -> None:
    T, accel_sd, drift_sd = 0.25, 1.3, 0.07
    G = np.array([[T**2 / 2, 0], [0, T**2 / 2], [T, 0], [0, T]])
    expected = np.zeros((6, 6))
    expected[:4, :4] = G @ G.T * accel_sd**2
    expected[5, 5] = drift_sd**2
    kind = ProcessNoise.WHITE_ACCELERATION.value
    Q = process_noise(kind, T, accel_sd, 1e6, 1e6, 1e6, drift_sd, NO_BIAS, NO_BIAS)
    np.testing.assert_allclose(Q, expected, rtol=1e-14)


@pytest.mark.parametrize("kind", list(ProcessNoise))
@pytest.mark.parametrize("dt", [0.0, -1.0])
def test_no_time_no_noise(kind: ProcessNoise, dt: float) -> None:
    Q = process_noise(kind.value, dt, 1.0, 1.0, 1.0, 1.0, 1.0, BIAS_SD, BIAS_TAU)
    np.testing.assert_array_equal(Q, np.zeros((8, 8)))


def test_no_time_no_motion() -> None:
    np.testing.assert_array_equal(transition(8, 0.0, BIAS_TAU), np.eye(8))


@pytest.mark.parametrize("kind", list(ProcessNoise))
@pytest.mark.parametrize("dt", [1e-3, 1.0, 1e4])
def test_biases_stay_at_their_stationary_variance(kind: ProcessNoise, dt: float) -> None:
    F = transition(8, dt, BIAS_TAU)
    Q = process_noise(kind.value, dt, 1.0, 1.0, 1.0, 1.0, 1.0, BIAS_SD, BIAS_TAU)
    P = np.diag(np.concatenate([np.zeros(6), BIAS_SD**2]))
    after = (F @ P @ F.T + Q)[6:, 6:]
    np.testing.assert_allclose(after, np.diag(BIAS_SD**2), rtol=1e-12, atol=1e-15)
    assert np.all(Q[:6, 6:] == 0.0)
