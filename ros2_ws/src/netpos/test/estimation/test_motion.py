"""Process models against matrix exponentials, numerical integration and the paper's matrices, and
the prediction with them."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation import motion
from netpos.estimation.forms import ekf
from netpos.estimation.motion import (
    SPEED_OF_LIGHT_MPS,
    Model,
    Parameter,
    ProcessNoise,
    extra_states,
    motion_parameters,
)
from netpos.estimation.motion.table import MODELS
from netpos.estimation.state import X
from netpos.messages.values import Array
from scipy.constants import speed_of_light
from scipy.linalg import expm

NO_BIAS = np.zeros(0)  # as the sd or the time constants of no bias at all
BIAS_SD = np.array([0.3, 2.0])
BIAS_TAU = np.array([0.7, 40.0])
ACCEL, OFFSET, DRIFT = 1.7, 0.4, 0.9
ONES = dict.fromkeys(
    ("accel", "velocity_step", "offset_density", "drift_density", "drift_step"), 1.0
)


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


def transition(n: int, dt: float, tau: np.ndarray) -> np.ndarray:
    """F of constant velocity; the state does not matter."""
    F, mean = np.full((n, n), np.nan), np.full(n, 1e6)
    bias = np.array([np.full(tau.size, 1e6), tau])
    motion.transition(mean, dt, motion_parameters(), bias, F)
    np.testing.assert_array_equal(mean, 1e6)
    return F


def process_noise(
    kind: ProcessNoise,
    dt: float,
    sd: np.ndarray = NO_BIAS,
    tau: np.ndarray = NO_BIAS,
    **values: float,
) -> np.ndarray:
    """Q of constant velocity; the parameters not given are absurd: they must not matter."""
    needed = {"model", "noise", "states", "extras", "velocity_step_sd", "own"}
    of_others = {name for model in MODELS for name in model.own}
    absurd = dict.fromkeys({p.name.lower() for p in Parameter} - needed | of_others, 1e6)
    parameters = motion_parameters(noise=kind, **absurd | values)
    Q = np.full((6 + sd.size, 6 + sd.size), np.nan)
    motion.noise(np.full(6 + sd.size, 1e6), dt, parameters, np.array([sd, tau]), Q)
    return Q


def continuous(dt: float, sd: np.ndarray = NO_BIAS, tau: np.ndarray = NO_BIAS) -> np.ndarray:
    values = {"accel": ACCEL, "offset_density": OFFSET, "drift_density": DRIFT}
    return process_noise(ProcessNoise.CONTINUOUS, dt, sd, tau, **values)


def test_names() -> None:
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
        Q = process_noise(ProcessNoise.WERNER, dt, velocity_step=0.2, drift_step=0.3)
        expected = np.diag([0.0, 0.0, 0.2**2, 0.2**2, 0.0, 0.3**2])
        np.testing.assert_allclose(Q, expected, rtol=1e-15)


def test_white_acceleration_noise_is_eq_36_of_the_paper() -> None:
    T, accel_sd, drift_sd = 0.25, 1.3, 0.07
    G = np.array([[T**2 / 2, 0], [0, T**2 / 2], [T, 0], [0, T]])
    expected = np.zeros((6, 6))
    expected[:4, :4] = G @ G.T * accel_sd**2
    expected[5, 5] = drift_sd**2
    kind = ProcessNoise.WHITE_ACCELERATION
    Q = process_noise(kind, T, accel=accel_sd, drift_step=drift_sd)
    np.testing.assert_allclose(Q, expected, rtol=1e-14)


@pytest.mark.parametrize("kind", list(ProcessNoise))
@pytest.mark.parametrize("dt", [0.0, -1.0])
def test_no_time_no_noise(kind: ProcessNoise, dt: float) -> None:
    Q = process_noise(kind, dt, BIAS_SD, BIAS_TAU, **ONES)
    np.testing.assert_array_equal(Q, np.zeros((8, 8)))


def test_no_time_no_motion() -> None:
    np.testing.assert_array_equal(transition(8, 0.0, BIAS_TAU), np.eye(8))


@pytest.mark.parametrize("kind", list(ProcessNoise))
@pytest.mark.parametrize("dt", [1e-3, 1.0, 1e4])
def test_biases_stay_at_their_stationary_variance(kind: ProcessNoise, dt: float) -> None:
    F = transition(8, dt, BIAS_TAU)
    Q = process_noise(kind, dt, BIAS_SD, BIAS_TAU, **ONES)
    P = np.diag(np.concatenate([np.zeros(6), BIAS_SD**2]))
    after = (F @ P @ F.T + Q)[6:, 6:]
    np.testing.assert_allclose(after, np.diag(BIAS_SD**2), rtol=1e-12, atol=1e-15)
    assert np.all(Q[:6, 6:] == 0.0)


@pytest.mark.parametrize("dt", [0.01, 0.3, 2.5])
def test_propagate_is_the_transition(dt: float) -> None:
    """Constant velocity is linear: f x = F x, in place, with and without biases."""
    rng = np.random.default_rng(1)
    for tau in (NO_BIAS, BIAS_TAU):
        before = rng.normal(size=6 + tau.size)
        after = before.copy()
        motion.propagate(after, dt, motion_parameters(), np.array([np.ones(tau.size), tau]))
        np.testing.assert_allclose(after, expm(drift_matrix(tau) * dt) @ before, rtol=1e-12)


@pytest.mark.parametrize("kind", list(ProcessNoise))
def test_add_noise_adds_to_what_is_there(kind: ProcessNoise) -> None:
    rng = np.random.default_rng(2)
    cov, bias = rng.normal(size=(8, 8)), np.array([BIAS_SD, BIAS_TAU])
    before = cov.copy()
    motion.add_noise(np.zeros(8), 0.4, motion_parameters(noise=kind, **ONES), bias, cov)
    Q = process_noise(kind, 0.4, BIAS_SD, BIAS_TAU, **ONES)
    np.testing.assert_array_equal(Q, Q.T)
    np.testing.assert_allclose(cov, before + Q, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("kind", list(ProcessNoise))
@pytest.mark.parametrize("position_sd", [0.0, 0.4])
def test_a_velocity_step_allowed_for(kind: ProcessNoise, position_sd: float) -> None:
    """A step of velocity of 3 m/s sd, 0.2 s ago: 0.6 m of position go with it, and nothing of the
    clock or the biases."""
    plain = process_noise(kind, 0.4, BIAS_SD, BIAS_TAU, **ONES)
    step = {
        "velocity_step_sd": 3.0,
        "velocity_step_age": 0.2,
        "velocity_step_position_sd": position_sd,
    }
    Q = process_noise(kind, 0.4, BIAS_SD, BIAS_TAU, **step, **ONES)
    G = np.zeros((8, 2))
    G[0, 0] = G[1, 1] = 0.6
    G[2, 0] = G[3, 1] = 3.0
    expected = G @ G.T + position_sd**2 * np.diag([1.0, 1.0, 0, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(Q - plain, expected, rtol=1e-12, atol=1e-14)


def random_spd(rng: np.random.Generator, n: int) -> Array:
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


def predicted(
    x: Array, P: Array, dt: float, parameters: Array, bias: Array = motion.NO_BIAS
) -> tuple[Array, Array]:
    mean, cov = x.copy(), P.copy()
    ekf.predict(mean, cov, dt, parameters, bias)
    return mean, cov


NOISE = {
    "accel": 0.9,
    "velocity_step": 0.8,
    "offset_density": 0.3,
    "drift_density": 0.2,
    "drift_step": 0.6,
    "idle": 0.55,
    "turn_rate": 0.5,
    "jerk": 0.7,
    "rest_speed": 0.4,
    "gyro": 0.1,
    "gyro_bias": 0.2,
    "accel_bias": 0.3,
    "yaw_increment": 0.25,
    "speed_increment": 1.1,
    "velocity_step_sd": 0.6,
    "velocity_step_age": 0.2,
}
BIASES = np.array([[2.0, 0.5], [1.5, 0.3]])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", list(ProcessNoise))
@pytest.mark.parametrize("biases", [0, 2])
def test_predict_with_constant_velocity(biases: int, kind: ProcessNoise, seed: int) -> None:
    """F P F' + Q of six and eight states; F and the decay of the biases written out."""
    rng = np.random.default_rng(seed)
    n, dt, bias = 6 + biases, 0.7, BIASES[:, :biases].copy()
    x, P, parameters = (
        rng.normal(size=n),
        random_spd(rng, n),
        motion_parameters(noise=kind, **NOISE),
    )
    F, Q = np.eye(n), np.empty((n, n))
    F[X.PX, X.VX] = F[X.PY, X.VY] = F[X.CLOCK, X.DRIFT] = dt
    F[range(6, n), range(6, n)] = np.exp(-dt / bias[1])
    motion.noise(x, dt, parameters, bias, Q)
    mean, cov = predicted(x, P, dt, parameters, bias)
    np.testing.assert_allclose(mean, F.dot(x), rtol=1e-14)
    np.testing.assert_allclose(cov, np.einsum("ij,jk,lk->il", F, P, F) + Q, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(cov, cov.T)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("model", "extras"),
    [
        (Model.CONSTANT_VELOCITY, 1),
        (Model.CONSTANT_TURN, 1),
        (Model.CONSTANT_ACCELERATION, 2),
        (Model.STATIONARY, 0),
        (Model.INERTIAL, 2),
    ],
)
def test_predict_with_any_model(model: Model, extras: int, seed: int) -> None:
    """F at the state before the step, Q at the state after it."""
    rng = np.random.default_rng(seed)
    n, dt = 6 + extras + 2, 0.3
    x, P = rng.normal(size=n), random_spd(rng, n)
    parameters = motion_parameters(model, extras=max(extras, extra_states(model)), **NOISE)
    F, Q, after = np.empty((n, n)), np.empty((n, n)), x.copy()
    motion.transition(x, dt, parameters, BIASES, F)
    motion.propagate(after, dt, parameters, BIASES)
    motion.noise(after, dt, parameters, BIASES, Q)
    mean, cov = predicted(x, P, dt, parameters, BIASES)
    np.testing.assert_array_equal(mean, after)
    np.testing.assert_allclose(cov, np.einsum("ij,jk,lk->il", F, P, F) + Q, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(cov, cov.T)


STILL = [
    (Model.CONSTANT_VELOCITY, 0),
    (Model.CONSTANT_VELOCITY, 2),
    (Model.CONSTANT_ACCELERATION, 2),
]


@pytest.mark.parametrize(("model", "extras"), STILL)
def test_predict_symmetrises_what_rounding_made_unsymmetric(model: Model, extras: int) -> None:
    P = 2.0 * np.eye(6 + extras)
    P[X.VX, X.DRIFT], P[X.DRIFT, X.VX] = (
        1.0 + 1e-9,
        1.0 - 1e-9,
    )  # a velocity and the drift: F leaves them alone
    _, cov = predicted(np.zeros(6 + extras), P, 0.5, motion_parameters(model, extras=extras))
    np.testing.assert_allclose([cov[X.VX, X.DRIFT], cov[X.DRIFT, X.VX]], 1.0, rtol=1e-15)
    np.testing.assert_array_equal(cov, cov.T)


def test_predict_symmetrises_beside_biases() -> None:
    P = 2.0 * np.eye(6 + BIASES.shape[1])
    P[X.VX, X.DRIFT], P[X.DRIFT, X.VX] = 1.0 + 1e-9, 1.0 - 1e-9
    _, cov = predicted(np.zeros(len(P)), P, 0.5, motion_parameters(), BIASES)
    np.testing.assert_allclose([cov[X.VX, X.DRIFT], cov[X.DRIFT, X.VX]], 1.0, rtol=1e-15)
    np.testing.assert_array_equal(cov, cov.T)


@pytest.mark.parametrize(("model", "extras"), STILL)
@pytest.mark.parametrize("dt", [0.0, -1e-9, -1.0])
def test_predict_does_nothing_without_time(dt: float, model: Model, extras: int) -> None:
    rng = np.random.default_rng(0)
    x, P = rng.normal(size=6 + extras), rng.normal(size=(6 + extras, 6 + extras))
    mean, cov = predicted(x, P, dt, motion_parameters(model, extras=extras, **NOISE))
    np.testing.assert_array_equal(mean, x)
    np.testing.assert_array_equal(cov, P)


def test_parameters_given_to_predict_are_left_alone() -> None:
    parameters, bias = motion_parameters(**NOISE), BIASES.copy()
    before = parameters.copy()
    predicted(np.ones(8), np.eye(8), 0.5, parameters, bias)
    np.testing.assert_array_equal(parameters, before)
    np.testing.assert_array_equal(bias, BIASES)
