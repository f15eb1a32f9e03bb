"""White acceleration on top of a straight way: moments over draws, smoothness between instants."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.world.motion import follow
from netpos.world.wander import Wander

DENSITY, STEP_S = 0.3, 0.05
WAY = follow([[0.0, 0.0], [40.0, 0.0]], 4.0)


def _wander(seed: int) -> Wander:
    return Wander(WAY, DENSITY, STEP_S, np.random.default_rng(seed))


@pytest.mark.parametrize("t", [0.05, 2.0, 9.95])
def test_deviations_have_the_moments_of_integrated_white_noise(t: float) -> None:
    states = [_wander(seed).body_at(t) for seed in range(2000)]
    p = np.array([s.position[0, :2] for s in states]) - [4.0 * t, 0.0]
    v = np.array([s.velocity[0, :2] for s in states]) - [4.0, 0.0]
    expected = DENSITY**2 * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
    for axis in range(2):
        sample = np.cov(p[:, axis], v[:, axis])
        np.testing.assert_allclose(
            sample / expected, np.ones((2, 2)), atol=5 * math.sqrt(2 / 2000)
        )
    assert abs(np.corrcoef(p[:, 0], p[:, 1])[0, 1]) < 5 / math.sqrt(2000)


def test_increments_of_the_velocity_are_white() -> None:
    state = _wander(1).body_at(STEP_S * np.arange(200))
    steps = np.diff(state.velocity[:, 0])
    assert abs(np.corrcoef(steps[:-1], steps[1:])[0, 1]) < 5 / math.sqrt(198)
    assert np.std(steps) == pytest.approx(DENSITY * math.sqrt(STEP_S), rel=0.2)


def test_velocity_and_yaw_rate_are_the_derivatives() -> None:
    wander, h = _wander(2), 1e-5
    t = np.linspace(0.011, 9.9, 400)
    before, here, after = (wander.body_at(t + s) for s in (-h, 0.0, h))
    np.testing.assert_allclose(
        (after.position - before.position) / (2 * h), here.velocity, atol=1e-4
    )
    yaw = [np.arctan2(s.velocity[:, 1], s.velocity[:, 0]) for s in (before, after)]
    inside = np.abs((t / STEP_S) % 1 - 0.5) < 0.49
    np.testing.assert_allclose(
        ((yaw[1] - yaw[0]) / (2 * h))[inside], here.angular_velocity[inside, 2], atol=1e-3
    )
    course = np.arctan2(here.velocity[:, 1], here.velocity[:, 0])
    np.testing.assert_allclose(here.rotation.as_euler("zyx")[:, 0], course, atol=1e-12)


@pytest.mark.parametrize(("density", "step_s"), [(0.0, 0.1), (0.1, 0.0), (math.nan, 0.1)])
def test_bad_values_are_refused(density: float, step_s: float) -> None:
    with pytest.raises(ValueError, match="must be finite and > 0"):
        Wander(WAY, density, step_s, np.random.default_rng(0))


def test_times_outside_the_motion_are_refused() -> None:
    with pytest.raises(ValueError, match=r"time must be in \[0, 10.0\] s"):
        _wander(1).body_at(10.1)
