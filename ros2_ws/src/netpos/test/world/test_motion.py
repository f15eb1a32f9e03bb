"""Motion: derivatives by central differences, geometry by hand, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from netpos.world.frames import quaternion_from_yaw, wrap_angle, yaw_from_quaternion
from netpos.world.hills import Hills
from netpos.world.motion import Leg, Motion, follow, follow_legs

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


# To a roundabout, round it and back: three circles of one radius that touch each other.
LOOP = [
    Leg(20.0),
    Leg(10.0 * math.pi / 3, -math.pi / 3),
    Leg(10.0 * 5 * math.pi / 3, 5 * math.pi / 3),
    Leg(10.0 * math.pi / 3, -math.pi / 3),
    Leg(20.0),
]


def test_legs_close_a_loop_and_take_their_length() -> None:
    """20 m, thirds and five thirds of pi at 10 m, and back to where it began."""
    motion = follow_legs([3.0, -2.0], 0.4, LOOP, 4.0)
    assert motion.smooth
    assert motion.duration_s == pytest.approx((40 + 10 * 7 * math.pi / 3) / 4)
    end = motion.at(motion.duration_s)
    np.testing.assert_allclose(end.position[0], [3.0, -2.0], atol=1e-9)
    assert end.yaw[0] == pytest.approx(0.4 + math.pi)
    middle = motion.at(motion.duration_s / 2)
    far = 20.0 + 10.0 * (2 * math.cos(math.pi / 6) + 1)
    np.testing.assert_allclose(
        middle.position[0], [3 + far * math.cos(0.4), -2 + far * math.sin(0.4)]
    )


@given(
    st.floats(1.0, 500.0), st.floats(-7.0, 7.0), st.floats(-3.0, 3.0), st.floats(0.5, 40.0),
    st.floats(0.0, 1.0),
)  # fmt: skip
def test_an_arc_is_a_circle(
    radius: float, turn: float, heading: float, speed: float, share: float
) -> None:
    """Centre, curvature, yaw rate and centripetal acceleration v^2 / r of circular motion."""
    turn = math.copysign(max(abs(turn), 0.01), turn)
    motion = follow_legs([1.0, 2.0], heading, [Leg(radius * abs(turn), turn)], speed)
    state = motion.at(share * motion.duration_s)
    side = math.copysign(1.0, turn)
    centre = np.array([1.0 - side * radius * math.sin(heading),
                       2.0 + side * radius * math.cos(heading)])  # fmt: skip
    out = state.position[0] - centre
    assert np.hypot(*out) == pytest.approx(radius)
    assert state.yaw[0] == pytest.approx(heading + share * turn)
    assert state.yaw_rate[0] == pytest.approx(side * speed / radius)
    np.testing.assert_allclose(state.acceleration[0], -(speed**2) * out / radius**2, atol=1e-6)
    assert float(state.velocity[0] @ out) == pytest.approx(0.0, abs=1e-6 * radius * speed)


def test_speed_and_heading_go_on_from_leg_to_leg() -> None:
    """Ramps of 8 m and 4 s at the ends, over the joints of lines and arcs."""
    motion = follow_legs(
        [0, 0], 0.0, LOOP, 4.0, acceleration_mps2=1.0, pauses_s=[1, 0, 0, 0, 0, 2]
    )
    assert motion.smooth
    t = np.linspace(0.0, motion.duration_s, 40001)
    dt = t[1]
    state = motion.at(t)
    speed = np.hypot(*state.velocity.T)
    assert np.abs(np.diff(speed)).max() <= 1.0 * dt * (1 + 1e-6)
    assert np.abs(np.diff(state.yaw)).max() <= 4.0 / 10.0 * dt * (1 + 1e-6)
    assert motion.duration_s == pytest.approx(1 + 2 + 4 + 4 + (40 + 10 * 7 * math.pi / 3 - 16) / 4)
    assert speed.max() == pytest.approx(4.0)
    way = np.trapezoid(speed, t)
    assert way == pytest.approx(40 + 10 * 7 * math.pi / 3, rel=1e-6)


def test_a_pause_between_legs_is_at_their_joint() -> None:
    motion = follow_legs([0, 0], 0.0, [Leg(8.0), Leg(math.pi, math.pi / 2)], 2.0,
                         acceleration_mps2=2.0, pauses_s=[0, 3, 0])  # fmt: skip
    assert motion.smooth
    at_rest = motion.at([4.6, 7.4])
    np.testing.assert_allclose(at_rest.position, [[8.0, 0.0]] * 2, atol=1e-9)
    np.testing.assert_allclose(at_rest.velocity, 0.0, atol=1e-9)
    assert not follow_legs([0, 0], 0.0, [Leg(8.0)], 2.0, pauses_s=[0, 3]).smooth


@pytest.mark.parametrize(
    ("legs", "more", "message"),
    [
        ([], {}, "at least one leg"),
        ([Leg(0.0)], {}, "leg 0 needs a finite length > 0"),
        ([Leg(1.0), Leg(1.0, math.inf)], {}, "leg 1 needs"),
        ([Leg(1.0)], {"speed_mps": math.nan}, "speed_mps"),
        ([Leg(1.0)], {"pauses_s": [1]}, r"one value per way-point \(2\), got 1"),
        ([Leg(1.0)], {"start": [0.0, math.nan]}, "finite start"),
        ([Leg(1.0)], {"hills": Hills(amplitude_m=1.0), "pauses_s": [1, 0]}, "hills"),
    ],
)
def test_bad_legs_are_refused(legs: list[Leg], more: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {"start": [0.0, 0.0], "heading_rad": 0.0, "speed_mps": 1.0}
    with pytest.raises(ValueError, match=message):
        follow_legs(legs=legs, **(arguments | more))  # type: ignore[arg-type]
