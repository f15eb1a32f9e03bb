"""Motion: derivatives by central differences, geometry by hand, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from netpos.world.frames import quaternion_from_yaw, wrap_angle, yaw_from_quaternion
from netpos.world.hills import Hills
from netpos.world.motion import Motion, follow

ZIGZAG = [[0, 0], [20, 0], [20, 15], [35, 20], [35, 40]]


def _rounded() -> Motion:
    return follow(
        ZIGZAG, 3.0, corner_radius_m=2.5, acceleration_mps2=1.5, pauses_s=[1, 0, 0, 0, 0.5]
    )


def test_velocity_acceleration_and_yaw_rate_are_the_derivatives() -> None:
    motion = _rounded()
    step = 1e-5
    t = np.linspace(2 * step, motion.duration_s - 2 * step, 1571)
    now, before, after = motion.at(t), motion.at(t - step), motion.at(t + step)
    slope = (after.position - before.position) / (2 * step)
    np.testing.assert_allclose(now.velocity, slope, atol=1e-4)
    turn = (after.yaw - before.yaw) / (2 * step)
    curve = (after.velocity - before.velocity) / (2 * step)
    kink = np.abs(curve - now.acceleration).max(axis=1) > 1e-3  # the instants between pieces
    assert kink.sum() <= 12
    np.testing.assert_allclose(now.yaw_rate[~kink], turn[~kink], atol=1e-4)


def test_path_is_continuous_and_ends_at_the_last_waypoint() -> None:
    motion = _rounded()
    assert motion.smooth
    t = np.linspace(0, motion.duration_s, 20001)
    state = motion.at(t)
    gap = np.hypot(*np.diff(state.position, axis=0).T)
    assert gap.max() <= 3.0 * (t[1] - t[0]) * (1 + 1e-9)
    assert np.abs(np.diff(state.velocity, axis=0)).max() < 0.01
    np.testing.assert_allclose(state.position[[0, -1]], [ZIGZAG[0], ZIGZAG[-1]], atol=1e-9)
    np.testing.assert_allclose(state.velocity[[0, -1]], 0, atol=1e-6)


def test_right_turn_by_hand() -> None:
    """5 m radius: tangents 5 m, arc 2.5 pi m, curvature -1/5."""
    motion = follow([[0, 0], [60, 0], [60, -60]], 3.0, corner_radius_m=5.0)
    assert motion.duration_s == pytest.approx((110 + 2.5 * math.pi) / 3)
    middle = motion.at((55 + 1.25 * math.pi) / 3)
    reach = 5 * math.sin(math.pi / 4)
    np.testing.assert_allclose(middle.position[0], [55 + reach, -5 + reach])
    assert middle.yaw[0] == pytest.approx(-math.pi / 4)
    assert middle.yaw_rate[0] == pytest.approx(-0.6)
    assert np.hypot(*middle.acceleration[0]) == pytest.approx(9 / 5)


def test_sharp_corner_turns_at_once_and_is_not_smooth() -> None:
    motion = follow([[0, 0], [10, 0], [10, 10]], 2.0)
    assert not motion.smooth
    state = motion.at([4.999, 5.0, 10.0])
    np.testing.assert_allclose(state.yaw, [0, math.pi / 2, math.pi / 2])
    np.testing.assert_allclose(state.position[2], [10, 10])


def test_pause_turns_on_the_spot() -> None:
    motion = follow([[0, 0], [10, 0], [10, 10]], 2.0, pauses_s=[1, 2, 1], acceleration_mps2=2.0)
    assert motion.smooth
    assert motion.duration_s == pytest.approx(1 + 6 + 2 + 6 + 1)  # each leg: 1 s up, 4 s, 1 s down
    state = motion.at([7.0, 8.0, 8.999])
    np.testing.assert_allclose(state.position, [[10, 0]] * 3, atol=1e-9)
    np.testing.assert_allclose(state.yaw[:2], [0, math.pi / 4], atol=1e-9)


def test_short_leg_never_reaches_cruising_speed() -> None:
    motion = follow([[0, 0], [1, 0]], 10.0, pauses_s=[1, 1], acceleration_mps2=1.0)
    assert motion.duration_s == pytest.approx(1 + 2 + 1)
    assert np.hypot(*motion.at(2.0).velocity[0]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": [[0, 0]], "speed_mps": 1}, "at least two"),
        ({"points": [[0, 0], [0, 0]], "speed_mps": 1}, "same point"),
        ({"points": [[0, 0], [math.nan, 0]], "speed_mps": 1}, "finite way-points"),
        ({"points": [[0, 0], [1, 0]], "speed_mps": 0}, "speed_mps must be"),
        ({"points": [[0, 0], [1, 0]], "speed_mps": 1, "pauses_s": [1]}, "one value per way-point"),
        (
            {"points": [[0, 0], [4, 0], [4, 4]], "speed_mps": 1, "corner_radius_m": 4.001},
            "too short for corner_radius_m",
        ),
        (
            {"points": ZIGZAG, "speed_mps": 1, "corner_radius_m": 1, "pauses_s": [0, 1, 0, 0, 0]},
            "rounded corner",
        ),
        (
            {
                "points": [[0, 0], [1, 0]],
                "speed_mps": 9,
                "pauses_s": [1, 0],
                "acceleration_mps2": 1,
            },
            "raise acceleration_mps2",
        ),
    ],
)
def test_bad_motion_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        follow(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize("time_s", [-1e-3, 5.001, math.nan])
def test_time_outside_the_motion_is_refused(time_s: float) -> None:
    with pytest.raises(ValueError, match="time must be in"):
        follow([[0, 0], [5, 0]], 1.0).at([time_s])


@given(st.floats(-1e4, 1e4))
def test_frames(angle: float) -> None:
    wrapped = float(wrap_angle(angle))
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    back = float(yaw_from_quaternion(quaternion_from_yaw(angle)))
    assert math.cos(back - angle) == pytest.approx(1.0)


def test_hills_are_checked() -> None:
    with pytest.raises(ValueError, match="amplitude_m"):
        Hills(amplitude_m=-1.0)
    with pytest.raises(ValueError, match="period_s"):
        Hills(amplitude_m=1.0, period_s=math.inf)
    with pytest.raises(ValueError, match="no pauses"):
        follow([[0, 0], [9, 0]], 1.0, pauses_s=[1, 0], hills=Hills(amplitude_m=1.0))
