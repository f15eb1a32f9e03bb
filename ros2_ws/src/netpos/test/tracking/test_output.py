"""State to odometry and clock state: SciPy rotations, covariances by sampling, differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.level.protection import protection_level
from netpos.estimation.state import CLOCK_DRIFT, POSITION, VELOCITY, X
from netpos.messages.values import Array, TrackState
from netpos.tracking import TrackerConfig, output
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation


def spd(seed: int, scale: float = 1.0) -> Array:
    A = np.random.default_rng(seed).normal(size=(8, 8))
    return scale * (A @ A.T + 0.5 * np.eye(8))


def state(vx: float, vy: float) -> Array:
    return np.array([10.0, 20.0, vx, vy, 30.0, 0.5, 0.1, 0.2])


@pytest.mark.parametrize("velocity", [(5.0, 0.0), (-3.0, 4.0), (0.0, -8.0), (-6.0, -1e-3)])
def test_heading_variance_by_differences(velocity: tuple[float, float]) -> None:
    cov = spd(1, 0.01)
    yaw, variance = output.heading(state(*velocity), cov, last=9.0)
    assert yaw == pytest.approx(math.atan2(velocity[1], velocity[0]))
    eps, gradient = 1e-6, np.zeros(2)
    for i in range(2):
        step = np.eye(2)[i] * eps
        ahead, back = np.array(velocity) + step, np.array(velocity) - step
        turn = math.atan2(ahead[1], ahead[0]) - math.atan2(back[1], back[0])
        gradient[i] = math.remainder(turn, 2 * math.pi) / (2 * eps)
    assert variance == pytest.approx(gradient @ cov[VELOCITY, VELOCITY] @ gradient, rel=1e-6)


def test_heading_variance_by_sampling() -> None:
    rng = np.random.default_rng(3)
    cov = np.eye(6)
    cov[VELOCITY, VELOCITY] = [[0.04, 0.01], [0.01, 0.09]]
    v = rng.multivariate_normal([6.0, 3.0], cov[VELOCITY, VELOCITY], size=200_000)
    _, variance = output.heading(state(6.0, 3.0)[:6], cov, 0.0)
    assert variance == pytest.approx(np.arctan2(v[:, 1], v[:, 0]).var(), rel=0.02)


def test_heading_holds_the_last_one_where_the_speed_does_not_stand_out() -> None:
    nothing_known = math.pi**2 / 3  # variance of a uniform angle
    cov = np.eye(6)
    limit = nothing_known / 4
    speed = 1.0 / math.sqrt(limit)  # variance = 1 / speed^2
    assert output.heading(state(speed * 0.999, 0.0), cov, 1.25) == (1.25, nothing_known)
    yaw, variance = output.heading(state(speed * 1.001, 0.0), cov, 1.25)
    assert yaw == 0.0
    assert variance == pytest.approx(limit / 1.001**2)
    # at rest, however well the velocity is known
    assert output.heading(state(0.9e-6, 0.0), 1e-30 * cov, -0.5) == (-0.5, nothing_known)
    assert output.heading(state(0.0, 1.1e-6), 1e-30 * cov, -0.5)[0] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5, math.pi])
def test_odometry(yaw: float) -> None:
    mean, cov = state(3.0, -4.0), spd(2)
    odometry = output.odometry(123, "vue_9", mean, cov, 1.5, yaw, 0.02)
    assert (odometry.stamp_ns, odometry.vue_id) == (123, "vue_9")
    np.testing.assert_array_equal(odometry.position, [10.0, 20.0, 1.5])
    turn = Rotation.from_euler("z", yaw)
    assert (Rotation.from_quat(odometry.quaternion) * turn.inv()).magnitude() < 1e-12
    assert np.linalg.norm(odometry.quaternion) == pytest.approx(1.0)
    # the twist is the map velocity seen from the body: turning it back gives the state
    np.testing.assert_allclose(turn.apply(odometry.linear_velocity), [3.0, -4.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(odometry.angular_velocity, 0.0)
    back = turn.as_matrix()[:2, :2]
    np.testing.assert_allclose(
        back @ odometry.twist_cov[:2, :2] @ back.T, cov[VELOCITY, VELOCITY], atol=1e-12
    )
    np.testing.assert_array_equal(odometry.pose_cov[:2, :2], cov[POSITION, POSITION])
    assert odometry.pose_cov[5, 5] == 0.02


def test_what_is_taken_for_granted_has_its_own_variance_and_no_correlation() -> None:
    """Of 1 m, 0.2 rad, 1 m/s and 1 rad/s: not zero, and no ellipsoid of a kilometre in RViz."""
    odometry = output.odometry(1, "v", state(1.0, 0.0), spd(2), 0.0, 0.3, 0.02)
    np.testing.assert_allclose(np.diag(odometry.pose_cov)[2:5], [1.0, 0.04, 0.04])
    np.testing.assert_allclose(np.diag(odometry.twist_cov)[2:], 1.0)
    for cov in (odometry.pose_cov, odometry.twist_cov):
        assert cov.shape == (6, 6)
        rest = cov.copy()
        rest[:2, :2] = 0.0
        np.testing.assert_array_equal(rest - np.diag(np.diag(rest)), 0.0)


def test_moving_along_the_heading_is_forward() -> None:
    odometry = output.odometry(1, "v", state(3.0, 4.0), spd(2), 0.0, math.atan2(4.0, 3.0), 0.1)
    np.testing.assert_allclose(odometry.linear_velocity, [5.0, 0.0, 0.0], atol=1e-12)


def test_clock_state_in_seconds() -> None:
    cov = spd(4)
    clock = output.clock_state(77, "vue_9", state(0.0, 0.0)[4:6], cov[CLOCK_DRIFT, CLOCK_DRIFT])
    assert (clock.stamp_ns, clock.vue_id) == (77, "vue_9")
    assert clock.offset_s == pytest.approx(30.0 / speed_of_light, rel=1e-14)
    assert clock.drift == pytest.approx(0.5 / speed_of_light, rel=1e-14)
    np.testing.assert_allclose(
        clock.cov, cov[CLOCK_DRIFT, CLOCK_DRIFT] / speed_of_light**2, rtol=1e-14
    )


def test_largest_sd() -> None:
    cov = spd(5)
    expected = math.sqrt(np.linalg.eigvalsh(cov[POSITION, POSITION])[-1])
    assert output.largest_sd(cov) == pytest.approx(expected, rel=1e-12)
    assert output.largest_sd(np.zeros((6, 6))) == 0.0
    assert output.largest_sd(-np.eye(6)) == 0.0  # rounding below a covariance of zero


@pytest.mark.parametrize(
    ("heard_ns", "position_sd", "decided", "expected"),
    [
        (None, 0.0, True, TrackState.WAITING),
        (0, 1.0, True, TrackState.TRACKING),
        (0, 1.0001, True, TrackState.INITIALISING),
        (-1, 0.0, True, TrackState.COASTING),
        (-1, 0.0, False, TrackState.COASTING),
        (0, 0.5, False, TrackState.AMBIGUOUS),
        (0, 50.0, False, TrackState.AMBIGUOUS),
    ],
)
def test_what_a_track_is_worth(
    heard_ns: int | None, position_sd: float, decided: bool, expected: TrackState
) -> None:
    config = TrackerConfig(coast_after_s=2.0, initial_position_sd_max_m=1.0)
    state = output.track_state(config, 2_000_000_000, heard_ns, position_sd, decided=decided)
    assert state is expected


@pytest.mark.parametrize("missing", ["bounded", "placed"])
def test_a_fix_without_a_level_or_a_place_is_not_ready(missing: str) -> None:
    state = output.track_state(TrackerConfig(), 0, 0, 0.1, **{missing: False})
    assert state is TrackState.INITIALISING


@pytest.mark.parametrize("velocity", [(5.0, -2.0), (1e-3, 0.0)])
@pytest.mark.parametrize("heading", [-1, 6])
def test_all_of_a_track_in_one_go(velocity: tuple[float, float], heading: int) -> None:
    """What ``describe`` says is what its parts say."""
    mean, cov = state(*velocity), spd(6, 0.01)
    said, clock, yaw, sd_m, radius_m = output.describe(7, "v", mean, cov, 1.5, 0.4, heading, 1e-3)
    expected_yaw, yaw_var = output.heading(mean, cov, 0.4, heading)
    expected = output.odometry(7, "v", mean, cov, 1.5, expected_yaw, yaw_var)
    if heading >= 0:
        output.with_yaw_rate(expected, mean, cov, heading)
    assert yaw == pytest.approx(expected_yaw, abs=1e-15)
    for name in ("position", "quaternion", "linear_velocity", "angular_velocity"):
        np.testing.assert_allclose(getattr(said, name), getattr(expected, name), atol=1e-14)
    np.testing.assert_allclose(said.pose_cov, expected.pose_cov, rtol=1e-12)
    np.testing.assert_allclose(said.twist_cov, expected.twist_cov, rtol=1e-12)
    told = output.clock_state(7, "v", mean[CLOCK_DRIFT], cov[CLOCK_DRIFT, CLOCK_DRIFT])
    assert (clock.offset_s, clock.drift) == (told.offset_s, told.drift)
    np.testing.assert_allclose(clock.cov, told.cov, rtol=1e-14)
    assert sd_m == output.largest_sd(cov)
    assert radius_m == protection_level(cov[POSITION, POSITION], 1e-3)


def test_a_covariance_that_is_none_is_not_described() -> None:
    cov = np.eye(6)
    cov[X.PX, X.PY] = cov[X.PY, X.PX] = 1.5
    with pytest.raises(ValueError, match="covariance"):
        output.describe(7, "v", np.ones(6), cov, 1.5, 0.0, -1, 1e-4)
