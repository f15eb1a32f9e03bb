"""What measurements should read, by hand and by finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from corner_ranges import SQUARE, S
from netpos.evaluation.yardsticks import (
    Kind,
    Observations,
    Space,
    ranges,
    residuals,
)
from netpos.messages.values import Array
from scipy.spatial.transform import Rotation


def angles(kind: Kind, rsu: Array, yaw: float, value: float) -> Observations:
    seen = ranges([S], rsu[None], np.array([value]), 0.1)
    axes = Rotation.from_euler("z", yaw).as_matrix().T[None]
    return replace(seen, kind=np.array([int(kind)]), axes=axes)


def every_kind() -> Observations:
    """A range, a TDOA, and an angle of each kind, of a turned device with lever arms."""
    seen = ranges([S] * 5, SQUARE[[0, 1, 2, 3, 0]], np.ones(5), 0.1, SQUARE[[2, 2, 3, 1, 1]])
    axes = Rotation.from_euler("ZYX", [[0.3, 0.1, -0.2]] * 5).as_matrix()
    arms = np.array(
        [[0.2, 0.1, 0.3], [0.0, 0.4, 0.0], [0.1, 0.0, 0.0], [0.3, 0.2, 0.1], [0, 0, 0]]
    )
    kinds = np.array([Kind.RANGE, Kind.TDOA, Kind.AZIMUTH, Kind.AZIMUTH_CONE, Kind.ELEVATION])
    return replace(seen, kind=kinds.astype(np.int64), axes=axes, lever_arm=arms)


def test_expected_values_by_hand() -> None:
    """3 m east and 4 m north of an RSU that looks north, 12 m below it."""
    rsu, position = np.array([1.0, 2.0, 15.0]), np.array([4.0, 6.0, 3.0])
    north = math.pi / 2
    for kind, expected in (
        (Kind.RANGE, 13.0),
        (Kind.AZIMUTH, -math.atan2(3, 4)),
        (Kind.AZIMUTH_CONE, -math.asin(3 / 13)),
        (Kind.ELEVATION, -math.asin(12 / 13)),
    ):
        error, _ = residuals(angles(kind, rsu, north, 0.0), position)
        assert error[0] == pytest.approx(-expected, abs=1e-12), kind


def test_an_azimuth_behind_the_rsu_wraps() -> None:
    seen = angles(Kind.AZIMUTH, np.zeros(3), 0.0, math.radians(179))
    error, _ = residuals(seen, np.array([-1.0, -math.tan(math.radians(2)), 0.0]))
    assert error[0] == pytest.approx(math.radians(-3))


def test_a_tdoa_is_the_difference_of_two_ranges() -> None:
    rng = np.random.default_rng(3)
    first, second, position = SQUARE[[0, 1, 2]], SQUARE[[3, 2, 0]], rng.uniform(0, 20, 3)
    zero = np.zeros(3)
    far, far_slope = residuals(ranges([S] * 3, second, zero, 0.1), position)
    near, near_slope = residuals(ranges([S] * 3, first, zero, 0.1), position)
    error, slope = residuals(ranges([S] * 3, first, zero, 0.1, second), position)
    np.testing.assert_allclose(error, far - near, atol=1e-12)
    np.testing.assert_allclose(slope, far_slope - near_slope, atol=1e-12)


def test_derivatives_are_those_of_central_differences() -> None:
    seen, position, heading, h = every_kind(), np.array([7.0, 4.0, 1.5]), 0.7, 1e-6
    _, slope = residuals(seen, position, heading)
    for k in range(4):
        step = np.eye(4)[k] * h
        up, _ = residuals(seen, position + step[:3], heading + step[3])
        down, _ = residuals(seen, position - step[:3], heading - step[3])
        np.testing.assert_allclose(slope[:, k], (down - up) / (2 * h), atol=1e-7)


def test_observations_refuse_what_is_not_in_order() -> None:
    with pytest.raises(ValueError, match="stamps decrease"):
        ranges([2, 1], SQUARE[:2], np.ones(2), 0.1)
    with pytest.raises(ValueError, match="not finite"):
        ranges([1, 2], SQUARE[:2], np.array([1.0, math.nan]), 0.1)
    with pytest.raises(ValueError, match="sd is not positive"):
        ranges([1, 2], SQUARE[:2], np.ones(2), 0.0)
    with pytest.raises(ValueError, match="dimensions must be 2 or 3"):
        Space(dimensions=1)
