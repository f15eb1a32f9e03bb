"""The mechanisation against closed-form motions, a tenfold-rate reference and SciPy; the
transition of the error state against the mechanisation itself."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from netpos.inertial.strapdown import (
    ACCEL_BIAS,
    ATTITUDE_ERR,
    ERR,
    GYRO_BIAS,
    NAV,
    QUATERNION,
    VELOCITY,
    Earth,
    InertialNoise,
    decay_biases,
    earth_at,
    inject,
    mechanise,
    propagate,
    rotate,
    rotation_of,
    still_earth,
    transition,
)
from scipy.integrate import cumulative_trapezoid, solve_ivp
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
Function = Callable[[Array], Array]

G = 9.80665


def start(velocity: tuple[float, ...] = (0.0, 0.0, 0.0), q: Array | None = None) -> Array:
    nav = np.zeros(NAV)
    nav[VELOCITY:QUATERNION] = velocity
    nav[QUATERNION:ACCEL_BIAS] = (0.0, 0.0, 0.0, 1.0) if q is None else q
    return nav


def run(nav: Array, increments: Array, dt: float, earth: Earth) -> Array:
    """The state after all increments (n, 6), the first without one before it."""
    last, gained = np.zeros(7), np.zeros(3)
    for increment in increments:
        mechanise(nav, increment, dt, last, earth, gained)
    return nav


def integrals(rates: Function, end_s: float, dt: float, fine: int = 200) -> Array:
    """(n, 6) increments of rates(t) (n, 6) over intervals dt, by fine quadrature."""
    n = round(end_s / dt)
    t = np.linspace(0.0, end_s, n * fine + 1)
    total = cumulative_trapezoid(rates(t), t, axis=0, initial=0.0)
    return np.asarray(np.diff(total[::fine], axis=0))


def reference(rates: Function, nav: Array, end_s: float, earth: Earth) -> Array:
    """Navigation equations by an adaptive integrator on rotation matrices: no increments."""

    def slope(t: float, y: Array) -> Array:
        C = y[6:].reshape(3, 3)
        w, f = np.split(rates(np.array([t]))[0], 2)
        dC = C @ skew(w) - skew(earth.rate) @ C
        g = np.array([0.0, 0.0, -earth.gravity_mps2])
        dv = C @ f + g - 2 * np.cross(earth.rate, y[3:6])
        return np.concatenate([y[3:6], dv, dC.ravel()])

    C = Rotation.from_quat(nav[QUATERNION:ACCEL_BIAS]).as_matrix()
    begin = np.concatenate([nav[:QUATERNION], C.ravel()])
    solved = solve_ivp(slope, (0.0, end_s), begin, method="DOP853", rtol=1e-11, atol=1e-11)
    return np.asarray(solved.y[:, -1])


def skew(v: Array) -> Array:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def wild(t: Array) -> Array:
    """Turning about all axes while accelerating: nothing cancels."""
    return np.column_stack(
        [
            0.8 * np.sin(2.1 * t),
            0.6 * np.cos(1.7 * t) + 0.1,
            0.5 + 0.4 * np.sin(0.9 * t),
            2.0 * np.cos(1.3 * t),
            1.5 * np.sin(2.3 * t),
            G + 1.0 * np.sin(3.1 * t),
        ]
    )


def test_rest_stays_at_rest() -> None:
    tilted = Rotation.from_euler("ZYX", [40.0, 10.0, -20.0], degrees=True)
    force = tilted.inv().apply([0.0, 0.0, G])
    nav = run(start(q=tilted.as_quat()), np.tile([0, 0, 0, *(0.01 * force)], (6000, 1)), 0.01,
              still_earth(G))  # fmt: skip
    np.testing.assert_allclose(nav[:QUATERNION], 0.0, atol=1e-9)
    np.testing.assert_allclose(nav[QUATERNION:ACCEL_BIAS], tilted.as_quat(), atol=1e-12)


def test_rest_on_a_turning_earth() -> None:
    """The gyro measures the earth's rate, the accelerometer gravity: nothing moves."""
    earth = earth_at(math.radians(40.1), 1600.0)
    tilted = Rotation.from_euler("ZYX", [130.0, 3.0, 5.0], degrees=True)
    rate, force = tilted.inv().apply([earth.rate, [0.0, 0.0, earth.gravity_mps2]])
    increments = np.tile([*(0.01 * rate), *(0.01 * force)], (60000, 1))
    nav = run(start(q=tilted.as_quat()), increments, 0.01, earth)
    np.testing.assert_allclose(nav[QUATERNION:ACCEL_BIAS], tilted.as_quat(), atol=1e-10)
    np.testing.assert_allclose(nav[VELOCITY:QUATERNION], 0.0, atol=1e-5)
    assert earth.gravity_mps2 == pytest.approx(9.7968, abs=2e-4)  # 40.1 deg, 1600 m


def test_circle_at_constant_speed() -> None:
    """Rate w and centripetal force v w are constant in the body: closed form of the plane."""
    speed, rate, dt, n = 15.0, 0.3, 0.01, 4000
    increments = np.tile(dt * np.array([0, 0, rate, 0, speed * rate, G]), (n, 1))
    nav = run(start((speed, 0, 0)), increments, dt, still_earth(G))
    yaw, radius = rate * n * dt, speed / rate
    position = [radius * math.sin(yaw), radius * (1 - math.cos(yaw)), 0.0]
    np.testing.assert_allclose(nav[:3], position, atol=2e-4)
    np.testing.assert_allclose(nav[3:6], [speed * math.cos(yaw), speed * math.sin(yaw), 0],
                               atol=1e-5)  # fmt: skip
    np.testing.assert_allclose(nav[6:10], Rotation.from_euler("z", yaw).as_quat(), atol=1e-12)


def test_constant_rotation_is_exact() -> None:
    rate = np.array([0.5, -1.1, 0.7])
    increments = np.tile([*(0.02 * rate), 0, 0, 0], (500, 1))
    nav = run(start(), increments, 0.02, still_earth(G))
    expected = Rotation.from_rotvec(rate * 10.0)
    assert (Rotation.from_quat(nav[6:10]) * expected.inv()).magnitude() < 1e-11


def coning_drift(dt: float, *, corrected: bool) -> float:
    """Attitude error [rad] after 10 s of classical coning, q = (0, sin(a/2) cos wt,
    sin(a/2) sin wt, cos(a/2)): the body rates are closed forms."""
    half, w = 0.5 * math.radians(2.0), 2 * math.pi * 5.0

    def attitude(t: float) -> Rotation:
        s = math.sin(half)
        return Rotation.from_quat([0.0, s * math.cos(w * t), s * math.sin(w * t), math.cos(half)])

    def rates(t: Array) -> Array:
        a = 2 * half
        zero = np.zeros_like(t)
        return np.column_stack(
            [
                np.full_like(t, -w * (1 - math.cos(a))),
                -w * math.sin(a) * np.sin(w * t),
                w * math.sin(a) * np.cos(w * t),
                zero, zero, zero,
            ]
        )  # fmt: skip

    nav = start(q=attitude(0.0).as_quat())
    last, gained = np.zeros(7), np.zeros(3)
    for increment in integrals(rates, 10.0, dt):
        mechanise(nav, increment, dt, last, still_earth(G), gained)
        if not corrected:
            last[:] = 0.0
    return float((Rotation.from_quat(nav[6:10]) * attitude(10.0).inv()).magnitude())


def test_coning_is_corrected() -> None:
    """Uncorrected the motion looks like a turn; the two-interval correction leaves 3 % of it."""
    without, corrected = (coning_drift(0.01, corrected=c) for c in (False, True))
    assert without > 1e-3
    assert corrected < 0.03 * without


def test_sculling_is_corrected() -> None:
    """Roll and sideways force in phase push the body up; only cross terms of two intervals see
    it."""
    w, a, f = 2 * math.pi * 5.0, math.radians(2.0), 5.0

    def rates(t: Array) -> Array:
        zero = np.zeros_like(t)
        return np.column_stack(
            [a * w * np.cos(w * t), zero, zero, zero, f * np.sin(w * t), np.full_like(t, G)]
        )

    truth = reference(rates, start(), 4.0, still_earth(G))
    corrected = run(start(), integrals(rates, 4.0, 0.01), 0.01, still_earth(G))
    without = start()
    for increment in integrals(rates, 4.0, 0.01):
        mechanise(without, increment, 0.01, np.zeros(7), still_earth(G), np.zeros(3))
    error = np.abs(without[VELOCITY:QUATERNION] - truth[3:6]).max()
    assert error > 5e-3
    assert np.abs(corrected[VELOCITY:QUATERNION] - truth[3:6]).max() < 0.05 * error


@pytest.mark.parametrize("earth", [still_earth(G), Earth(G, np.array([0.0, 1e-4, 2e-4]))])
def test_wild_motion_against_a_reference_integration(earth: Earth) -> None:
    nav = start((3.0, -1.0, 0.5), Rotation.from_euler("ZYX", [0.3, -0.2, 0.1]).as_quat())
    truth = reference(wild, nav, 20.0, earth)
    ours = run(nav, integrals(wild, 20.0, 0.01), 0.01, earth)
    C = np.empty((3, 3))
    rotation_of(ours[6:10], C)
    np.testing.assert_allclose(C, truth[6:].reshape(3, 3), atol=3e-6)
    np.testing.assert_allclose(ours[3:6], truth[3:6], atol=3e-4)
    np.testing.assert_allclose(ours[:3], truth[:3], atol=4e-3)


def test_against_a_tenfold_rate_without_corrections() -> None:
    """At a tenth of the interval plain rotations and forces (SciPy) give the same motion."""
    dt, end_s = 0.01, 10.0
    fine = integrals(wild, end_s, dt / 10, fine=20)
    C, v, p = Rotation.identity(), np.zeros(3), np.zeros(3)
    for increment in fine:
        half = Rotation.from_rotvec(increment[:3] / 2)
        before = v
        v = v + (C * half).apply(increment[3:]) - [0.0, 0.0, G * dt / 10]
        p = p + (before + v) / 2 * dt / 10
        C = C * Rotation.from_rotvec(increment[:3])
    ours = run(start(), fine.reshape(-1, 10, 6).sum(axis=1), dt, still_earth(G))
    assert (Rotation.from_quat(ours[6:10]) * C.inv()).magnitude() < 2e-6
    np.testing.assert_allclose(ours[3:6], v, atol=5e-5)
    np.testing.assert_allclose(ours[:3], p, atol=3e-4)


def test_intervals_of_any_length_fit_together() -> None:
    """Cut in two unequal parts the interval gives the same motion to the order of the correction:
    its factor follows the lengths."""
    t = np.concatenate([[0.0], np.cumsum(np.tile([0.004, 0.016], 250))])
    fine = np.linspace(0.0, t[-1], 100 * 1000 + 1)
    total = cumulative_trapezoid(wild(fine), fine, axis=0, initial=0.0)
    index = np.rint(t / fine[1]).astype(int)
    nav, last, gained = start(), np.zeros(7), np.zeros(3)
    for increment, dt in zip(np.diff(total[index], axis=0), np.diff(t), strict=True):
        mechanise(nav, increment, float(dt), last, still_earth(G), gained)
    truth = reference(wild, start(), float(t[-1]), still_earth(G))
    C = np.empty((3, 3))
    rotation_of(nav[6:10], C)
    np.testing.assert_allclose(C, truth[6:].reshape(3, 3), atol=2e-6)
    np.testing.assert_allclose(nav[3:6], truth[3:6], atol=1e-4)


def test_biases_are_taken_off() -> None:
    nav = start()
    nav[ACCEL_BIAS:GYRO_BIAS] = 0.1, -0.2, 0.3
    nav[GYRO_BIAS:] = 0.01, 0.02, -0.03
    increment = 0.01 * np.array([0.01, 0.02, -0.03, 0.1, -0.2, G + 0.3])
    run(nav, np.tile(increment, (100, 1)), 0.01, still_earth(G))
    np.testing.assert_allclose(nav[:QUATERNION], 0.0, atol=1e-12)


def test_rotations_agree_with_scipy() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        q, turn = Rotation.random(rng=rng), rng.normal(size=3)
        for in_map in (False, True):
            ours = q.as_quat()
            rotate(ours, turn, in_map)
            step = Rotation.from_rotvec(turn)
            expected = step * q if in_map else q * step
            assert (Rotation.from_quat(ours) * expected.inv()).magnitude() < 1e-12
            C = np.empty((3, 3))
            rotation_of(ours, C)
            np.testing.assert_allclose(C, expected.as_matrix(), atol=1e-12)


def error_between(true: Array, nav: Array) -> Array:
    """(ERR,) of a true state against an estimate: the inverse of ``inject``, by SciPy."""
    turned = Rotation.from_quat(true[6:10]) * Rotation.from_quat(nav[6:10]).inv()
    return np.concatenate([true[:6] - nav[:6], turned.as_rotvec(), true[10:] - nav[10:]])


def test_inject_closes_the_loop() -> None:
    rng = np.random.default_rng(4)
    nav = start((1.0, 2.0, 3.0), Rotation.random(rng=rng).as_quat())
    error = 0.3 * rng.normal(size=ERR)
    true = nav.copy()
    inject(true, error)
    np.testing.assert_allclose(error_between(true, nav), error, atol=1e-12)


@pytest.mark.parametrize("earth", [still_earth(G), Earth(G, np.array([0.0, 2e-3, 5e-3]))])
def test_transition_is_the_derivative_of_the_mechanisation(earth: Earth) -> None:
    """Central differences of ten intervals with every error at their begin, every entry."""
    dt, n, tau = 0.01, 10, 30.0
    increments = integrals(wild, 0.1, dt)
    q = Rotation.from_euler("ZYX", [1.0, 0.2, -0.3]).as_quat()
    nav = start((10.0, 5.0, 1.0), q)
    nav[ACCEL_BIAS:] = 0.05, -0.03, 0.02, 0.004, -0.002, 0.003

    def moved(error: Array) -> Array:
        state, last, gained = nav.copy(), np.zeros(7), np.zeros(3)
        inject(state, error)
        for increment in increments:
            mechanise(state, increment, dt, last, earth, gained)
            decay_biases(state, dt, tau)
        return state

    h = 1e-4
    base = moved(np.zeros(ERR))
    numeric = np.empty((ERR, ERR))
    for j in range(ERR):
        up, down = (moved(s * h * np.eye(ERR)[j]) for s in (1, -1))
        numeric[:, j] = (error_between(up, base) - error_between(down, base)) / (2 * h)
    first, last_C = np.empty((3, 3)), np.empty((3, 3))
    rotation_of(nav[6:10], first)
    rotation_of(base[6:10], last_C)
    state, last, gained = nav.copy(), np.zeros(7), np.zeros(3)
    for increment in increments:
        mechanise(state, increment, dt, last, earth, gained)
    Phi = transition(gained, 0.5 * (first + last_C), n * dt, tau, earth)
    scale = np.array([1.0] * 3 + [10.0] * 3 + [1.0] * 3 + [1.0] * 3 + [10.0] * 3)
    np.testing.assert_allclose(Phi, numeric, atol=2e-3, rtol=0.02)
    assert np.abs((Phi - numeric) / scale[:, None])[ATTITUDE_ERR:].max() < 1e-3
    assert np.abs(numeric[:ATTITUDE_ERR, ATTITUDE_ERR:]).max() > 0.5  # there is something to miss


def test_propagation_against_quadrature() -> None:
    """Phi P Phi' plus the integral of Phi(s) Q Phi(s)' over the interval, by Simpson's rule."""
    noise = InertialNoise(0.02, 0.003, 0.1, 0.01, 50.0)
    gained, C, dt = np.array([0.1, -0.2, 0.95]), Rotation.from_euler("z", 0.7).as_matrix(), 0.1
    rate = 2.0 / 50.0
    Q = np.diag([0.0] * 3 + [0.02**2] * 3 + [0.003**2] * 3 + [rate * 0.01] * 3 + [rate * 1e-4] * 3)
    rng = np.random.default_rng(1)
    A = rng.normal(size=(ERR, ERR)) * 1e-3
    cov = A @ A.T
    parts = []
    for share in (0.0, 0.5, 1.0):
        part = transition(share * gained, C, max(share * dt, 1e-12), 50.0, still_earth(G))
        parts.append(part @ Q @ part.T)
    Phi = transition(gained, C, dt, 50.0, still_earth(G))
    expected = Phi @ cov @ Phi.T + dt / 6 * (parts[0] + 4 * parts[1] + parts[2])
    propagate(cov, Phi, dt, noise)
    np.testing.assert_array_equal(cov, cov.T)
    np.testing.assert_allclose(np.diag(cov), np.diag(expected), rtol=2e-2)
    np.testing.assert_allclose(cov, expected, atol=5e-7)


def test_noise_alone_grows_as_its_densities_say() -> None:
    """From a state known exactly: density^2 times time; for the biases 2 sd^2 / tau times time."""
    noise, dt = InertialNoise(0.02, 0.003, 0.1, 0.01, 50.0), 0.1
    cov = np.zeros((ERR, ERR))
    propagate(cov, transition(np.zeros(3), np.eye(3), dt, 50.0, still_earth(G)), dt, noise)
    expected = np.repeat([0.02**2, 0.003**2, 2 / 50 * 0.1**2, 2 / 50 * 0.01**2], 3) * dt
    np.testing.assert_allclose(np.diag(cov)[3:], expected, rtol=0.02)


def test_a_latitude_beyond_the_pole_is_refused() -> None:
    with pytest.raises(ValueError, match="latitude_rad"):
        earth_at(1.6)
