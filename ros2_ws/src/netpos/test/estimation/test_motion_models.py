"""Motion models against finite differences, an ODE solver and Van Loan's discretisation."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from netpos.estimation.motion import (
    NO_BIAS,
    Model,
    Parameter,
    ProcessNoise,
    extra_states,
    motion_parameters,
    noise,
    own_index,
    propagate,
    transition,
)
from netpos.estimation.motion.constant_turn import arc
from netpos.estimation.state import POSITION, VELOCITY, X
from netpos.messages.values import Array
from scipy.integrate import solve_ivp
from scipy.linalg import expm

BIAS = np.array([[2.0, 0.5], [30.0, 7.0]])


def moved(mean: Array, dt: float, motion: Array, bias: Array = NO_BIAS) -> Array:
    x = mean.copy()
    propagate(x, dt, motion, bias)
    return x


def matrix(fill: Callable[..., None], mean: Array, dt: float, motion: Array, bias: Array) -> Array:
    M = np.full((mean.size, mean.size), np.nan)
    fill(mean, dt, motion, bias, M)
    return M


def state_of(model: Model, extras: int, rng: np.random.Generator) -> Array:
    mean = rng.normal(size=6 + extras + 2) * 3.0
    if model in {Model.CONSTANT_TURN, Model.INERTIAL}:
        mean[6] *= 0.1
    return mean


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("model", list(Model))
def test_jacobian_by_differences(model: Model, seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = motion_parameters(model, yaw_increment=0.2, speed_increment=0.7)
    mean = state_of(model, extra_states(model), rng)
    if seed == 3:
        mean[VELOCITY] *= 0.01  # creeping
    F, step = matrix(transition, mean, 0.3, motion, BIAS), 1e-5
    for j in range(mean.size):
        e = step * np.eye(mean.size)[j]
        column = moved(mean + e, 0.3, motion, BIAS) - moved(mean - e, 0.3, motion, BIAS)
        np.testing.assert_allclose(F[:, j], column / (2 * step), rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("model", [Model.CONSTANT_VELOCITY, Model.STATIONARY])
def test_shared_states_of_other_models_are_zeroed(model: Model) -> None:
    """In an interacting set the turn rate is no business of these: zero, of known variance."""
    motion = motion_parameters(model, extras=1, idle=0.3, turn_rate=7.0)
    mean = np.arange(1.0, 10.0)
    x, F = moved(mean, 0.5, motion, BIAS), matrix(transition, mean, 0.5, motion, BIAS)
    Q = matrix(noise, mean, 0.5, motion, BIAS)
    assert x[6] == 0.0
    assert (F[6] == 0.0).all()
    assert (F[:, 6] == 0.0).all()
    assert Q[6, 6] == pytest.approx(0.09 * 0.5)
    np.testing.assert_allclose(x[7:], mean[7:] * np.exp(-0.5 / BIAS[1]), rtol=1e-14)


@pytest.mark.parametrize("rate", [0.7, -0.2, 1e-3, 1e-5, -1e-8, 0.0])
def test_constant_turn_is_the_differential_equation(rate: float) -> None:
    mean = np.array([3.0, -2.0, 8.0, 5.0, 100.0, 0.4, rate])

    def flow(_: float, s: Array) -> list[float]:
        return [s[2], s[3], -rate * s[3], rate * s[2], s[5], 0.0, 0.0]

    solved = solve_ivp(flow, (0.0, 1.7), mean, rtol=1e-12, atol=1e-12).y[:, -1]
    result = moved(mean, 1.7, motion_parameters(Model.CONSTANT_TURN))
    np.testing.assert_allclose(result, solved, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_constant_turn_has_no_seam(sign: float) -> None:
    """The series of small angles meets the closed form, in value and derivative."""
    motion, at = motion_parameters(Model.CONSTANT_TURN), sign * 1e-4 / 0.5
    states = [np.array([0.0, 0, 8.0, 5.0, 0, 0, at * (1.0 + e)]) for e in (-1e-7, 1e-7)]
    series, closed = (moved(s, 0.5, motion) for s in states)
    np.testing.assert_allclose(series[:6], closed[:6], rtol=1e-9, atol=1e-9)
    F, G = (matrix(transition, s, 0.5, motion, NO_BIAS) for s in states)
    np.testing.assert_allclose(F, G, rtol=1e-9, atol=1e-6)


def test_constant_acceleration_is_the_differential_equation() -> None:
    mean = np.array([3.0, -2.0, 8.0, 5.0, 100.0, 0.4, 1.2, -0.7])

    def flow(_: float, s: Array) -> list[float]:
        return [s[2], s[3], s[6], s[7], s[5], 0.0, 0.0, 0.0]

    solved = solve_ivp(flow, (0.0, 2.3), mean, rtol=1e-12, atol=1e-12).y[:, -1]
    result = moved(mean, 2.3, motion_parameters(Model.CONSTANT_ACCELERATION))
    np.testing.assert_allclose(result, solved, rtol=1e-10)


@pytest.mark.parametrize("angle", [9.9e-5, -5e-5, 0.0])
def test_a_hardly_turning_device_follows_the_power_series(angle: float) -> None:
    """sin(r t) / r and (1 - cos(r t)) / r and what they change with r, by exact fractions."""
    dt, x = 0.5, Fraction(angle)
    turn: list[Fraction] = [Fraction(0)] * 4
    for k in range(4):
        sign, odd, even = (-1) ** k, math.factorial(2 * k + 1), math.factorial(2 * k + 2)
        turn[0] += sign * x ** (2 * k) / odd
        turn[1] += sign * x ** (2 * k + 1) / even
        turn[2] += sign * 2 * k * x ** max(2 * k - 1, 0) / odd
        turn[3] += sign * (2 * k + 1) * x ** (2 * k) / even
    expected = [dt * float(turn[0]), dt * float(turn[1])]
    expected += [dt**2 * float(turn[2]), dt**2 * float(turn[3])]
    share = np.array([0.0, angle**2 / 9.0, angle**2 / 9.0, 0.0]) + 1e-14  # what is left out
    assert (np.abs(np.subtract(arc(angle / dt, dt), expected)) <= share * np.abs(expected)).all()


def test_stationary_stands_still() -> None:
    mean = np.array([3.0, -2.0, 8.0, 5.0, 100.0, 0.4])
    result = moved(mean, 2.0, motion_parameters(Model.STATIONARY))
    np.testing.assert_allclose(result, [3.0, -2.0, 0.0, 0.0, 100.8, 0.4], rtol=1e-15)


def van_loan(A: Array, Qc: Array, dt: float) -> Array:
    """Integral of exp(A s) Qc exp(A' s) over dt (Van Loan 1978)."""
    n = A.shape[0]
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -A, Qc, A.T
    E = expm(block * dt)
    result: Array = E[n:, n:].T @ E[:n, n:]
    return result


@pytest.mark.parametrize("dt", [0.01, 0.5, 4.0])
@pytest.mark.parametrize(
    "model",
    [
        Model.CONSTANT_VELOCITY,
        Model.CONSTANT_ACCELERATION,
        Model.CONSTANT_TURN,
        Model.RIGID_BODY,
    ],
)
def test_continuous_noise_is_van_loans(model: Model, dt: float) -> None:
    """White acceleration or jerk, the two-state clock, biases; a walking turn rate acts on itself
    only, or on the heading of a rigid body."""
    extras = extra_states(model)
    n = 6 + extras + 2
    motion = motion_parameters(
        model, accel=0.7, jerk=0.4, offset_density=0.2, drift_density=0.3, turn_rate=0.15
    )
    A, Qc = np.zeros((n, n)), np.zeros((n, n))
    A[0, 2] = A[1, 3] = A[4, 5] = 1.0
    Qc[4, 4], Qc[5, 5] = 0.2**2, 0.3**2
    if model == Model.CONSTANT_ACCELERATION:
        A[2, 6] = A[3, 7] = 1.0
        Qc[6, 6] = Qc[7, 7] = 0.4**2
    else:
        Qc[2, 2] = Qc[3, 3] = 0.7**2
    if model == Model.CONSTANT_TURN:
        Qc[6, 6] = 0.15**2
    if model == Model.RIGID_BODY:
        A[6, 7], Qc[7, 7] = 1.0, 0.15**2
    for i in range(2):
        k = 6 + extras + i
        A[k, k], Qc[k, k] = -1.0 / BIAS[1, i], 2.0 * BIAS[0, i] ** 2 / BIAS[1, i]
    Q = matrix(noise, np.zeros(n), dt, motion, BIAS)
    np.testing.assert_allclose(Q, van_loan(A, Qc, dt), rtol=1e-9, atol=1e-15)


def test_noise_per_step() -> None:
    """fokin2020:eq.4 and eq.36 do not ask how long a step takes but for G."""
    values = {"accel": 0.7, "velocity_step": 0.3, "drift_step": 0.2}
    Q = matrix(
        noise, np.zeros(6), 0.5, motion_parameters(noise=ProcessNoise.WERNER, **values), NO_BIAS
    )
    np.testing.assert_allclose(Q, np.diag([0, 0, 0.09, 0.09, 0, 0.04]), rtol=1e-14)
    G = np.array([[0.125, 0], [0, 0.125], [0.5, 0], [0, 0.5], [0, 0], [0, 0]])
    motion = motion_parameters(noise=ProcessNoise.WHITE_ACCELERATION, **values)
    expected = 0.49 * G @ G.T + np.diag([0, 0, 0, 0, 0, 0.04])
    np.testing.assert_allclose(
        matrix(noise, np.zeros(6), 0.5, motion, NO_BIAS), expected, rtol=1e-14
    )


def test_stationary_noise_is_a_slow_creep() -> None:
    """A speed of the given sd at the end of the step, gained evenly: half of it acts on the
    position."""
    motion = motion_parameters(Model.STATIONARY, rest_speed=0.2)
    w = np.array([0.2 * 0.5 / 2, 0.2])
    Q = matrix(noise, np.zeros(6), 0.5, motion, NO_BIAS)
    for axis in range(2):
        at = np.ix_([axis, axis + 2], [axis, axis + 2])
        np.testing.assert_allclose(Q[at], np.outer(w, w), rtol=1e-14)
    assert Q[X.PX, X.PY] == Q[X.PX, X.VY] == Q[X.VX, X.VY] == 0.0


@pytest.mark.parametrize("dt", [0.0, -1.0])
def test_no_noise_without_time(dt: float) -> None:
    assert (matrix(noise, np.ones(6), dt, motion_parameters(accel=1.0), NO_BIAS) == 0.0).all()


def test_inertial_noise_by_sampling() -> None:
    """A small random heading error turns the velocity and half of it the step's way."""
    dt = 0.4
    motion = motion_parameters(Model.INERTIAL, gyro=0.01, gyro_bias=0.02, accel_bias=0.03)
    before = np.array([0.0, 0.0, 6.0, 2.0, 0.0, 0.0, 0.0, 0.0])
    after = moved(before, dt, motion)
    Q = matrix(noise, after, dt, motion, NO_BIAS)
    rng, samples = np.random.default_rng(0), []
    for error in 0.01 * math.sqrt(dt) * rng.normal(size=20_000):
        motion[Parameter.YAW_INCREMENT] = error
        samples.append((moved(before, dt, motion) - after)[:4])
    np.testing.assert_allclose(Q[:4, :4], np.cov(np.array(samples).T), rtol=0.05, atol=1e-6)
    assert Q[6, 6] == pytest.approx(0.02**2 * dt)
    assert Q[7, 7] == pytest.approx(0.03**2 * dt)


def test_inertial_on_a_circle() -> None:
    """Exact increments, biased by what the state knows: the device comes round to its start, and
    the chord's error falls with the square of the step."""
    ends = []
    for steps in (50, 100):
        dt = 10.0 / steps
        motion = motion_parameters(
            Model.INERTIAL,
            yaw_increment=2.0 * math.pi / steps + 0.03 * dt,
            speed_increment=-0.2 * dt,
        )
        mean = np.array([1.0, 2.0, 6.0, 0.0, 0.0, 0.0, 0.03, -0.2])
        radius, furthest = 6.0 * 10.0 / (2.0 * math.pi), 0.0
        for k in range(1, steps + 1):
            propagate(mean, dt, motion, NO_BIAS)
            angle = 2.0 * math.pi * k / steps
            circle = np.array(
                [1.0 + radius * math.sin(angle), 2.0 + radius * (1 - math.cos(angle))]
            )
            furthest = max(furthest, float(np.abs(mean[POSITION] - circle).max()))
        np.testing.assert_allclose(mean[POSITION], [1.0, 2.0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(mean[VELOCITY], [6.0, 0.0], rtol=1e-9, atol=1e-9)
        ends.append(furthest)
    assert ends[0] < 0.04
    assert ends[1] == pytest.approx(ends[0] / 4.0, rel=0.02)


def test_inertial_speeds_up() -> None:
    """A forward acceleration acts along the velocity, but for the share of the creeping speed."""
    motion = motion_parameters(Model.INERTIAL, speed_increment=1.0)
    result = moved(np.array([0.0, 0, 6.0, 8.0, 0, 0, 0, 0]), 0.5, motion)
    gain = 1.0 * 10.0 / math.sqrt(100.0 + 0.04)
    np.testing.assert_allclose(result[2:4], (10.0 + gain) * np.array([0.6, 0.8]), rtol=1e-12)
    np.testing.assert_allclose(result[:2], 0.5 * (10.0 + gain / 2) * np.array([0.6, 0.8]))
    at_rest = moved(np.zeros(8), 0.5, motion)
    assert (at_rest == 0.0).all()


def test_parameters_by_name() -> None:
    motion = motion_parameters(Model.CONSTANT_TURN, ProcessNoise.WERNER, turn_rate=0.1)
    assert motion[Parameter.MODEL] == Model.CONSTANT_TURN
    assert motion[Parameter.NOISE] == ProcessNoise.WERNER
    assert motion[Parameter.EXTRAS] == 1
    assert motion[own_index(Model.CONSTANT_TURN, "turn_rate")] == 0.1
    with pytest.raises(KeyError, match="speed"):
        motion_parameters(speed=1.0)


def test_inertial_noise_is_per_second() -> None:
    """Steps between IMU samples are of any length: the noise kinds per step are for the clock."""
    states, values = np.zeros(8), {"accel": 0.7, "velocity_step": 0.3}
    plain = matrix(noise, states, 0.5, motion_parameters(Model.INERTIAL, **values), NO_BIAS)
    for kind in (ProcessNoise.WERNER, ProcessNoise.WHITE_ACCELERATION):
        motion = motion_parameters(Model.INERTIAL, kind, drift_step=0.2, **values)
        Q = matrix(noise, states, 0.5, motion, NO_BIAS)
        np.testing.assert_allclose(Q[:4, :4], plain[:4, :4], rtol=1e-14)
        assert Q[X.DRIFT, X.DRIFT] == pytest.approx(0.04)
    np.testing.assert_allclose(
        plain[::2, ::2][:2, :2], 0.49 * np.array([[1 / 24, 1 / 8], [1 / 8, 0.5]])
    )
