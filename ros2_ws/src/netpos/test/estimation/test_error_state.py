"""The error-state filter: updates against the information form, holes, constraints."""

from __future__ import annotations

import numpy as np
import pytest
from error_states import LEVER_ARM, NOISE, OPEN, driven, linearised, moving
from filter_rows import row
from netpos.estimation.measurement import VARIANCE, Kind
from netpos.estimation.spatial.error_state import (
    MEMORY,
    UNCONSTRAINED,
    Constraints,
    Imu,
    Sensors,
    SlowErrors,
    advance,
    correct,
    doubt_standstill,
)
from netpos.estimation.spatial.space import bend_variance, direction_rows, place_rows
from netpos.estimation.state import (
    ERR_POSITION,
    NAV_POSITION,
    NAV_QUATERNION,
    NAV_VELOCITY,
    Err,
    Nav,
)
from netpos.inertial.strapdown import ERR, GYRO_BIAS, NAV, InertialNoise, inject, still_earth
from netpos.messages.values import Array
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

G = 9.80665


def start(yaw: float = 0.4) -> Array:
    nav = np.zeros(NAV)
    nav[:6] = 5.0, -3.0, 1.0, 2.0, 1.0, 0.0
    nav[NAV_QUATERNION] = Rotation.from_euler("ZYX", [yaw, 0.02, -0.03]).as_quat()
    return nav


def spd(rng: np.random.Generator) -> Array:
    A = rng.normal(size=(ERR, ERR)) * np.repeat([0.5, 0.2, 0.01, 0.01, 1e-3], 3)[:, None]
    return A @ A.T


def test_correct_is_the_information_form() -> None:
    """All rows at once by another route; a fix is linear enough for one step."""
    rng = np.random.default_rng(1)
    nav, cov = start(), spd(rng)
    rows = place_rows(np.array([5.3, -2.8, 2.1]), np.diag([0.4, 0.3, 0.2]), LEVER_ARM)
    z, H = linearised(rows, nav)
    R = np.diag(rows[:, VARIANCE])
    posterior = np.linalg.inv(np.linalg.inv(cov) + H.T @ np.linalg.inv(R) @ H)
    error = posterior @ H.T @ np.linalg.inv(R) @ z
    S = H @ cov @ H.T + R
    expected = nav.copy()
    inject(expected, error)
    nis, used = correct(nav, cov, rows, OPEN, np.zeros(1))
    assert used == 3
    assert nis == pytest.approx(z @ np.linalg.solve(S, z), rel=1e-9)
    np.testing.assert_allclose(nav, expected, atol=2e-4)
    sd = np.sqrt(np.diag(posterior))
    np.testing.assert_allclose(cov / np.outer(sd, sd), posterior / np.outer(sd, sd), atol=0.02)
    np.testing.assert_array_equal(cov, cov.T)


def test_a_fix_far_surer_than_the_prior_leaves_its_own_variance() -> None:
    """Sixteen digits between the two: P - K S K' would leave nothing, or less."""
    nav, cov = start(), np.eye(ERR)
    cov[ERR_POSITION, ERR_POSITION] = 1e8 * np.eye(3)
    rows = place_rows(nav[NAV_POSITION].copy(), 1e-8 * np.eye(3), (0.0, 0.0, 0.0))
    correct(nav, cov, rows, OPEN, np.zeros(1))
    np.testing.assert_allclose(cov[ERR_POSITION, ERR_POSITION], 1e-8 * np.eye(3), rtol=1e-6)
    assert np.linalg.eigvalsh(cov).min() > 0.0


def test_a_row_outside_the_gate_changes_nothing() -> None:
    rng = np.random.default_rng(2)
    nav, cov = start(), spd(rng)
    before, P = nav.copy(), cov.copy()
    rows = place_rows(nav[NAV_POSITION] + 100.0, np.eye(3), LEVER_ARM)
    accepted = np.ones(1)
    gate = np.array([0.0, 10.0, 13.0, 16.0])
    assert correct(nav, cov, rows, gate, accepted) == (0.0, 0)
    assert accepted[0] == 0.0
    np.testing.assert_array_equal(nav, before)
    np.testing.assert_array_equal(cov, P)


def test_groups_are_gated_apart() -> None:
    rng = np.random.default_rng(3)
    nav, cov = start(), spd(rng)
    good, bad = (
        place_rows(nav[NAV_POSITION] + shift, np.eye(3), (0.0, 0.0, 0.0), group)
        for group, shift in enumerate((0.1, 50.0))
    )
    accepted = np.zeros(2)
    _, used = correct(nav, cov, np.vstack([good, bad]), np.full(4, 16.0), accepted)
    assert used == 3
    assert accepted.tolist() == [1.0, 0.0]
    assert np.abs(nav[NAV_POSITION] - start()[NAV_POSITION]).max() < 0.2


def test_a_bearing_is_iterated_to_the_most_probable_place() -> None:
    """20 m from the station, 2 m and 5 m uncertain, half a radian off: one linearisation leaves
    the distance as it was, the iterated update ends where the cost is smallest."""
    nav, cov = moving(0.0), 1e-9 * np.eye(ERR)
    nav[Nav.PX] = 20.0
    cov[ERR_POSITION, ERR_POSITION] = np.diag([4.0, 25.0, 0.01])
    bearing = row(Kind.AZIMUTH, 0.5, 0.01)
    variance = 0.01 + bend_variance(bearing, nav, cov)

    def cost(p: Array) -> float:
        prior = (p[0] - 20.0) ** 2 / 4.0 + p[1] ** 2 / 25.0
        return float(prior + (0.5 - np.arctan2(p[1], p[0])) ** 2 / variance)

    best = minimize(cost, [19.0, 8.0], method="Nelder-Mead", options={"xatol": 1e-7}).x
    correct(nav, cov, bearing[None], OPEN, np.zeros(1))
    np.testing.assert_allclose(nav[:2], best, atol=0.1)
    assert best[0] < 19.7


def level(n: int, rate: float = 0.0) -> tuple[Array, Array]:
    """Stamps and rates of a level vehicle at constant speed, 100 Hz."""
    stamps = np.arange(1, n + 1, dtype=np.int64) * 10_000_000
    return stamps, np.tile([0.0, 0.0, rate, 0.0, 0.0, G], (n, 1))


def test_advance_is_the_same_however_it_is_cut() -> None:
    stamps, rates = level(300, 0.2)
    rates[:, 3] = 0.5
    sensors, ends = Sensors(NOISE, still_earth(), UNCONSTRAINED), []
    for cuts in ([3_000_000_000], [777_000_000, 1_500_000_000, 3_000_000_000]):
        nav, cov, memory, now = moving(5.0), 1e-4 * np.eye(ERR), np.zeros(MEMORY), 0
        for end in cuts:
            assert advance(nav, cov, memory, now, end, Imu(stamps, rates), sensors) == 0.0
            now = end
        ends.append((nav, cov))
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=1e-9)
    np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=1e-2, atol=1e-10)


@pytest.mark.parametrize("missing", ["middle", "end", "begin", "all"])
def test_a_hole_of_the_imu_is_counted_and_opens_the_covariance(missing: str) -> None:
    stamps, rates = level(300)
    keep = {
        "middle": (stamps <= 10**9) | (stamps > 2 * 10**9),
        "end": stamps <= 2 * 10**9,
        "begin": stamps > 10**9,
        "all": stamps < 0,
    }[missing]
    sds = []
    for mask in (np.ones(300, dtype=bool), keep):
        nav, cov = moving(5.0), 1e-8 * np.eye(ERR)
        blind = driven(nav, cov, Imu(stamps[mask], rates[mask]), 3.0)
        np.testing.assert_allclose(nav[:6], [15.0, 0, 0, 5.0, 0, 0], atol=1e-6)
        sds.append((blind, np.sqrt(cov[Err.VX, Err.VX])))
    (whole, sure), (blind, unsure) = sds
    assert whole == 0.0
    assert blind == pytest.approx(3.0 if missing == "all" else 1.0, abs=0.02)
    assert unsure > 0.9 > 10 * sure


def test_a_vehicle_does_not_slip() -> None:
    """A wrong heading shows as sideways speed and is found, with the sideways velocity."""
    stamps, rates = level(1000)
    nav, cov = moving(10.0), np.diag([0.01] * 6 + [1e-4, 1e-4, 0.01] + [1e-6] * 6)
    nav[NAV_QUATERNION] = Rotation.from_euler("z", 0.1).as_quat()
    held = Constraints(0.1, 0.1, 0.0, 0.0, 0.0)
    driven(nav, cov, Imu(stamps, rates), 10.0, held)
    C = Rotation.from_quat(nav[NAV_QUATERNION])
    assert abs(C.inv().apply(nav[NAV_VELOCITY])[1]) < 0.02
    assert abs(C.as_euler("ZYX")[0]) < 0.02


@pytest.mark.parametrize(("quiet", "standing"), [(True, True), (False, False)])
def test_standstill_shows_the_gyro_bias(quiet: bool, standing: bool) -> None:
    """At rest with a biased gyro; an IMU that shakes is not at rest."""
    rng = np.random.default_rng(6)
    stamps, rates = level(1000)
    rates[:, :3] += [0.002, -0.001, 0.003]
    rates += (0.001 if quiet else 0.5) * rng.normal(size=rates.shape)
    cov = np.diag([1.0] * 3 + [0.01] * 3 + [1e-6] * 2 + [0.01] + [1e-6] * 3 + [1e-4] * 3)
    noise = NOISE._replace(gyro_bias_sd_radps=0.01)
    rest = Constraints(0.0, 0.0, 0.02, 0.5, 0.1)
    nav = moving(0.0)
    driven(nav, cov, Imu(stamps, rates), 10.0, rest, noise)
    known = np.abs(nav[GYRO_BIAS:] - [0.002, -0.001, 0.003]).max() < 5e-4
    assert known is np.bool_(standing)
    assert (np.sqrt(cov[Err.VX, Err.VX]) < 0.01) is np.bool_(standing)


@pytest.mark.parametrize("sd", [0.1, 20.0])
def test_a_quiet_cruise_is_no_standstill(sd: float) -> None:
    """However little is known of the speed."""
    stamps, rates = level(500)
    nav, cov = moving(15.0), np.diag([0.01] * 3 + [sd**2] * 3 + [1e-8] * 9)
    rest = Constraints(0.0, 0.0, 0.02, 0.5, 0.1)
    driven(nav, cov, Imu(stamps, rates), 5.0, rest)
    assert nav[Nav.VX] == pytest.approx(15.0, abs=1e-6)


def test_setting_off_gently_ends_a_standstill() -> None:
    """0.3 m/s^2 after 5 s of rest: |f| grows by 0.005 m/s^2 only, and the gyro is still."""
    stamps, rates = level(700)
    rates[500:, 3] = 0.3
    nav, cov = moving(0.0), np.diag([0.01] * 3 + [1.0] * 3 + [1e-8] * 9)
    rest = Constraints(0.0, 0.0, 0.02, 0.2, 0.05)
    driven(nav, cov, Imu(stamps, rates), 7.0, rest)
    assert nav[Nav.VX] == pytest.approx(0.6, abs=0.05)


def test_a_doubted_standstill_is_not_held() -> None:
    stamps, rates = level(800)
    rest, sds = Constraints(0.0, 0.0, 0.02, 0.2, 0.05), []
    for doubted in (False, True):
        nav, cov, memory = moving(0.0), np.diag([1.0] * 6 + [1e-8] * 9), np.zeros(MEMORY)
        if doubted:
            doubt_standstill(memory)
        driven(nav, cov, Imu(stamps, rates), 8.0, rest, memory=memory)
        sds.append(np.sqrt(cov[Err.VX, Err.VX]))
    assert sds[0] < 0.02
    assert sds[1] > 0.9


def test_the_attitude_is_that_of_the_middle_of_a_chunk() -> None:
    """Turning at 2 rad/s, a bias ahead drives the velocity along the mean heading of 0.1 rad."""
    stamps, rates = level(10, 2.0)
    nav, cov = moving(0.0), np.diag([0.0] * 9 + [1.0, 0.0, 0.0] + [0.0] * 3)
    quiet = InertialNoise(0.0, 0.0, 0.0, 0.0, 1e9)
    driven(nav, cov, Imu(stamps, rates), 0.1, UNCONSTRAINED, quiet)
    assert np.arctan2(-cov[4, 9], -cov[3, 9]) == pytest.approx(0.1, abs=2e-3)


def test_estimated_biases_fade_with_their_time() -> None:
    stamps, rates = level(1000)
    nav = moving(0.0)
    nav[10:] = 0.1, 0.2, 0.3, 0.01, 0.02, 0.03
    known = nav[10:].copy()
    driven(nav, np.eye(ERR), Imu(stamps, rates), 10.0)
    np.testing.assert_allclose(nav[10:], np.exp(-0.1) * known, rtol=1e-9)


def test_constraint_rows_follow_their_covariance() -> None:
    """Velocity rows on a velocity of variance P and R: the posterior of a scalar."""
    nav, cov = moving(0.0), np.diag([1.0] * 3 + [4.0] * 3 + [1e-9] * 9)
    rows = direction_rows(Kind.BODY_VELOCITY, np.eye(3), np.ones(3), np.ones(3), 0)
    correct(nav, cov, rows, OPEN, np.zeros(1))
    np.testing.assert_allclose(nav[NAV_VELOCITY], 4.0 / 5.0, rtol=1e-6)
    np.testing.assert_allclose(np.diag(cov)[3:6], 4.0 / 5.0, rtol=1e-6)


def test_slow_errors_move_as_their_models_say_and_leave_the_rest_alone() -> None:
    """Clock and one bias over 10 s against closed forms; the core is the same to the bit."""
    stamps, rates = level(1000, 0.1)
    rates[:, 3] = 0.2
    slow = SlowErrors(0.5, 0.2, np.array([[2.0], [30.0]]))
    cov = np.diag([1.0] * 3 + [0.1] * 3 + [1e-4] * 3 + [1e-3] * 6 + [9.0, 4.0, 0.25])
    nav = np.append(moving(5.0), [100.0, 7.0, 1.5])
    core, core_cov = moving(5.0), cov[:ERR, :ERR].copy()
    for x, P in ((nav, cov), (core, core_cov)):
        sensors = Sensors(NOISE, still_earth(), Constraints(0.1, 0.1, 0.0, 0.0, 0.0), slow)
        advance(x, P, np.zeros(MEMORY), 0, 10**10, Imu(stamps, rates), sensors)
    np.testing.assert_array_equal(nav[:NAV], core)
    np.testing.assert_array_equal(cov[:ERR, :ERR], core_cov)
    np.testing.assert_allclose(nav[NAV:], [170.0, 7.0, 1.5 * np.exp(-10 / 30)], rtol=1e-12)
    q, t = 0.2**2, 10.0
    clock = [
        [9.0 + 4.0 * t**2 + 0.25 * t + q * t**3 / 3, 4.0 * t + q * t**2 / 2],
        [4.0 * t + q * t**2 / 2, 4.0 + q * t],
    ]
    np.testing.assert_allclose(cov[ERR : ERR + 2, ERR : ERR + 2], clock, rtol=1e-9)
    fade = np.exp(-2 * t / 30.0)
    assert cov[ERR + 2, ERR + 2] == pytest.approx(0.25 * fade + 4.0 * (1 - fade), rel=1e-9)
    np.testing.assert_array_equal(cov[:ERR, ERR:], 0.0)
