"""Curves of the second order: closed forms, derivatives, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from netpos.world.quadratic import QuadraticMotion


def test_one_stretch_is_the_polynomial_of_the_paper() -> None:
    motion = QuadraticMotion((10680.0, 3700.0), (-8.2, 23.6), [180.0], [(-0.125, 1.82)])
    state = motion.at([0.0, 15.0, 180.0])
    t = np.array([0.0, 15.0, 180.0])
    np.testing.assert_allclose(state.position[:, 0], 10680 - 8.2 * t - 0.0625 * t**2)
    np.testing.assert_allclose(state.position[:, 1], 3700 + 23.6 * t + 0.91 * t**2)
    np.testing.assert_allclose(state.velocity[:, 1], 23.6 + 1.82 * t)
    assert motion.duration_s == 180.0
    assert motion.smooth


def test_stretches_join_and_derivatives_agree() -> None:
    motion = QuadraticMotion(
        (1.0, -2.0), (3.0, 0.5), [4.0, 2.0, 5.0], [(0.3, -0.2), (0.0, 0.0), (-1.0, 0.4)]
    )
    step = 1e-5
    t = np.linspace(2 * step, motion.duration_s - 2 * step, 777)
    before, now, after = motion.at(t - step), motion.at(t), motion.at(t + step)
    slope = (after.position - before.position) / (2 * step)
    np.testing.assert_allclose(now.velocity, slope, atol=1e-4)
    turn = np.unwrap(np.column_stack([before.yaw, after.yaw])) @ [-1.0, 1.0] / (2 * step)
    away = np.abs(t[:, None] - [4.0, 6.0]).min(axis=1) > 2 * step
    np.testing.assert_allclose(now.yaw_rate[away], turn[away], atol=1e-4)
    np.testing.assert_allclose(now.yaw, np.arctan2(now.velocity[:, 1], now.velocity[:, 0]))
    left, right = motion.at([4.0 - 1e-9, 6.0 - 1e-9]), motion.at([4.0, 6.0])
    np.testing.assert_allclose(left.position, right.position, atol=1e-7)
    np.testing.assert_allclose(left.velocity, right.velocity, atol=1e-7)
    assert motion.at([4.0]).acceleration.tolist() == [[0.0, 0.0]]


def test_at_rest_it_does_not_turn() -> None:
    motion = QuadraticMotion((0.0, 0.0), (0.0, 0.0), [1.0], [(0.0, 0.0)])
    assert motion.at([0.5]).yaw_rate.tolist() == [0.0]


@pytest.mark.parametrize(
    ("durations", "accelerations", "message"),
    [
        ([1.0], [], "1 durations need as many accelerations, got 0"),
        ([], [], "0 durations"),
        ([0.0], [(0.0, 0.0)], r"durations must be finite and > 0 s, got \[0.0\]"),
        ([1.0], [(np.nan, 0.0)], "must be finite"),
    ],
)
def test_refusals(durations: list[float], accelerations: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        QuadraticMotion((0.0, 0.0), (1.0, 0.0), durations, accelerations)


def test_time_outside_is_refused() -> None:
    motion = QuadraticMotion((0.0, 0.0), (1.0, 0.0), [1.0], [(0.0, 0.0)])
    with pytest.raises(ValueError, match="time must be in"):
        motion.at([1.1])
