"""Coarse alignment on ways whose position, speed and heading are known in closed form."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from netpos.inertial.alignment import Course, fit_course, level, way_of
from netpos.world.motion import Motion, follow
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
G = 9.80665
HZ = 100


def imu_of(motion: Motion, end_s: float, tilt: Rotation) -> tuple[Array, Array]:
    """Times (n,) and rates (n, 6) of a body tilted by ``tilt`` against its level axes."""
    t = np.arange(1, round(end_s * HZ) + 1) / HZ
    state = motion.at(t - 0.5 / HZ)
    turn = Rotation.from_euler("z", -state.yaw[:, None])
    acceleration = turn.apply(np.column_stack([state.acceleration, np.full(len(t), G)]))
    rate = np.column_stack([np.zeros((len(t), 2)), state.yaw_rate])
    return t, np.hstack([tilt.inv().apply(rate), tilt.inv().apply(acceleration)])


def aligned(
    motion: Motion,
    end_s: float,
    sd_m: float = 0.0,
    tilt: Rotation | None = None,
    seed: int = 1,
    begin_s: float = 0.0,
) -> tuple[Course | None, Array]:
    """The course from one fix a second, and the true position, heading and speed at the end."""
    times, rates = imu_of(motion, end_s, tilt or Rotation.identity())
    fix_s = np.arange(begin_s, end_s + 1e-9, 1.0)
    fixes = motion.at(fix_s).position
    fixes = fixes + sd_m * np.random.default_rng(seed).normal(size=fixes.shape)
    cov = np.tile(max(sd_m, 0.01) ** 2 * np.eye(2), (len(fix_s), 1, 1))
    end = motion.at(end_s)
    speed = math.hypot(*end.velocity[0])
    truth = np.array([*end.position[0], end.yaw[0], speed])
    return fit_course(way_of(times, rates, fix_s), fixes, cov), truth


CURVE = follow([[0, 0], [80, 0], [80, 80], [0, 80]], 8.0, corner_radius_m=20.0)
FROM_REST = follow(
    [[0, 0], [-30, 60], [-60, 120]], 5.0, acceleration_mps2=0.8, pauses_s=[5.0, 0.0, 0.0]
)


@pytest.mark.parametrize(("motion", "end_s"), [(CURVE, 20.0), (FROM_REST, 12.0)])
def test_course_without_noise_is_the_true_one(motion: Motion, end_s: float) -> None:
    """Levelling takes the mean acceleration for tilt, and the fit finds it again."""
    course, truth = aligned(motion, end_s)
    assert course is not None
    np.testing.assert_allclose(course.position, truth[:2], atol=0.3)
    assert math.remainder(course.heading - truth[2], math.tau) == pytest.approx(0.0, abs=0.05)
    assert course.speed == pytest.approx(truth[3], abs=0.3)


def test_tilt_is_found_under_way() -> None:
    """A straight ramp-up: the mean acceleration is not tilt."""
    tilt = Rotation.from_euler("ZYX", [0.0, 0.04, -0.03])
    course, _ = aligned(FROM_REST, 11.0, tilt=tilt)
    assert course is not None
    assert course.pitch == pytest.approx(0.04, abs=0.01)
    assert course.roll == pytest.approx(-0.03, abs=0.01)


def test_the_way_counts_from_its_first_fix() -> None:
    """The IMU runs 7 s before: the speed gained and turned until then are not counted."""
    course, truth = aligned(FROM_REST, 16.0, begin_s=7.0)
    assert course is not None
    np.testing.assert_allclose(course.position, truth[:2], atol=0.3)
    assert course.speed == pytest.approx(truth[3], abs=0.2)
    times, rates = imu_of(FROM_REST, 16.0, Rotation.identity())
    way = way_of(times, rates, np.arange(7.0, 16.1))
    elapsed = way.time_s
    assert elapsed[0] == 0.0
    np.testing.assert_allclose(way.D[:4, 0], elapsed[:4] ** 2 / 2, atol=0.05)  # still straight
    gained = FROM_REST.at(8.0).velocity[0] - FROM_REST.at(7.0).velocity[0]
    mean = np.hypot(*FROM_REST.at(16.0).velocity[0]) / 16.0  # levelled away
    assert way.gained[1] == pytest.approx(np.hypot(*gained) - mean, abs=0.03)
    assert way.B[1, 0] == pytest.approx(way.gained[1] / 2, abs=0.05)


def test_a_steady_turn_is_no_roll() -> None:
    """2.2 m/s^2 to the side look like 0.22 rad."""
    circle = follow([[0, 0], [60, 0], [60, 60], [0, 60], [0, 1]], 8.0, corner_radius_m=29.0)
    course, _ = aligned(circle, 22.0, begin_s=5.0)
    assert course is not None
    assert abs(course.roll) < 0.06


def test_errors_are_as_large_as_claimed() -> None:
    errors = []
    for seed in range(60):
        course, truth = aligned(CURVE, 12.0, sd_m=2.0, seed=seed)
        assert course is not None
        estimate = np.array([*course.position, course.heading, course.speed])
        error = estimate - truth
        error[2] = math.remainder(error[2], math.tau)
        errors.append(error / np.sqrt(np.diag(course.cov)))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (rms > 0.6).all()
    assert (rms < 1.5).all()


def test_at_rest_the_heading_is_open() -> None:
    course, _ = aligned(FROM_REST, 4.0, sd_m=1.0)
    assert course is None or math.sqrt(course.cov[2, 2]) > 0.5


def test_two_fixes_are_too_few() -> None:
    times, rates = imu_of(CURVE, 2.0, Rotation.identity())
    way = way_of(times, rates, np.array([0.0, 1.0]))
    assert fit_course(way, np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1))) is None


def test_level_is_the_inverse_of_gravity() -> None:
    turn = Rotation.from_euler("ZYX", [1.0, 0.3, -0.2])
    roll, pitch = level(turn.inv().apply([0.0, 0.0, G]))
    assert (roll, pitch) == pytest.approx((-0.2, 0.3))
    with pytest.raises(ValueError, match="accelerometer"):
        level(np.zeros(3))
