"""map -> odom from poses in both, against transforms composed as matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.messages.values import Array
from netpos.world.map_to_odom import MapToOdom

S = 1_000_000_000


def turned(yaw: float) -> Array:
    return np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])


def matrix(position: Array, q: Array) -> Array:
    x, y, z, w = q
    full = np.eye(4)
    full[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    full[:3, 3] = position
    return full


def test_of_one_stamp() -> None:
    """map -> odom times odom -> base is map -> base."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        joined = MapToOdom()
        poses = []
        for _ in range(2):
            q = rng.normal(size=4)
            poses.append((rng.normal(size=3), q / np.linalg.norm(q)))
        assert joined.add_odom(S, *poses[1]) == []
        ((stamp, position, q),) = joined.add_map(S, *poses[0])
        assert stamp == S
        product = matrix(position, q) @ matrix(*poses[1])
        np.testing.assert_allclose(product, matrix(*poses[0]), atol=1e-12)


def test_a_pose_in_map_waits_for_one_in_odom() -> None:
    """Between two poses that in odom is interpolated: half the way, half the turn."""
    joined = MapToOdom()
    joined.add_odom(S, np.array([0.0, 0.0, 0.0]), turned(0.0))
    assert joined.add_map(S + S // 4, np.array([5.0, 0.0, 0.0]), turned(0.0)) == []
    ((stamp, position, q),) = joined.add_odom(S + S // 2, np.array([2.0, 0.0, 0.0]), turned(0.4))
    assert stamp == S + S // 4
    product = matrix(position, q) @ matrix(np.array([1.0, 0.0, 0.0]), turned(0.2))
    np.testing.assert_allclose(product, matrix(np.array([5.0, 0.0, 0.0]), turned(0.0)), atol=1e-12)


def test_nothing_is_extrapolated_nor_put_into_a_gap() -> None:
    joined = MapToOdom()
    zero = np.zeros(3), turned(0.0)
    joined.add_odom(2 * S, *zero)
    assert joined.add_map(S, *zero) == [], "older than all that is known"
    assert joined.add_map(4 * S, *zero) == []
    assert joined.add_odom(6 * S, *zero) == [], "a gap of 4 s"
    assert not joined.is_lost
    for k in range(20):
        joined.add_map((7 + k) * S, *zero)
    assert joined.is_lost


def test_time_that_was_set_back_starts_anew() -> None:
    joined = MapToOdom()
    zero = np.zeros(3), turned(0.0)
    joined.add_odom(100 * S, *zero)
    joined.add_odom(5 * S, *zero)
    assert len(joined.add_map(5 * S, *zero)) == 1


@pytest.mark.parametrize("late_ns", [0, 1])
def test_repeated_and_backward_poses_are_left_out(late_ns: int) -> None:
    joined = MapToOdom()
    joined.add_odom(S, np.zeros(3), turned(0.0))
    joined.add_odom(S - late_ns, np.ones(3), turned(0.0))
    ((_, position, _),) = joined.add_map(S, np.zeros(3), turned(0.0))
    np.testing.assert_array_equal(position, np.zeros(3))
