"""Steps of a walk and what dead reckoning says of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.measurement import GATE_VARIANCE, GROUP, VARIANCE, linearise
from netpos.reproduction.petukhov.steps import (
    Person,
    StepErrors,
    reported_velocity,
    steps_of,
    velocity_rows,
)

CORNERS = np.array([[0.0, 0.0], [5.7, 0.0], [5.7, 4.5], [0.0, 4.5], [0.0, 0.0]])
PAUSES = np.full(5, 1.02)


def test_the_rectangle_has_the_steps_of_the_paper() -> None:
    steps = steps_of(CORNERS, PAUSES, 1.0, 0.6375)
    assert len(steps.start_s) == 32
    assert steps.length_m.sum() == pytest.approx(20.4)
    assert (steps.end_s - steps.start_s).sum() == pytest.approx(20.4)
    assert steps.end_s[-1] + PAUSES[-1] == pytest.approx(25.5)
    assert steps.start_s[0] == 1.02
    np.testing.assert_allclose(np.cos(steps.heading_rad[[0, 9, 16, 25]]), [1, 0, -1, 0], atol=1e-9)


def test_one_error_lasts_a_step_and_standing_is_zero() -> None:
    steps = steps_of(CORNERS, PAUSES, 1.0, 0.6375)
    times = np.arange(255) * 0.1
    rows, step = velocity_rows(times, steps, StepErrors(), np.random.default_rng(1), 0.0)
    velocities = np.array([reported_velocity(pair) for pair in rows])
    assert (rows[..., GROUP] == 1).all()
    at_rest = (times < 1.02 - 1e-6) | (times >= 24.48 - 1e-6)
    np.testing.assert_array_equal(step[at_rest], -1)
    np.testing.assert_allclose(velocities[step < 0], 0.0, atol=1e-12)
    for s in range(32):
        assert np.ptp(velocities[step == s], axis=0).max() < 1e-9
    assert len(np.unique(np.round(velocities[step >= 0], 9), axis=0)) == 32


def test_errors_have_the_stated_covariance() -> None:
    """petukhov:eq.7, 8, by many draws of one step and by the rows' own weights."""
    steps = steps_of(np.array([[0.0, 0.0], [3.0, 4.0]]), np.zeros(2), 1.0, 0.6375)
    errors = StepErrors(length_sd_m=0.02, heading_sd_rad=0.05)
    rng, velocities, weighed = np.random.default_rng(2), [], []
    truth = np.array([0.0, 0.0, 0.6, 0.8, 0.0, 0.0])
    for _ in range(3000):
        rows, _ = velocity_rows(np.array([0.1]), steps, errors, rng, 0.0)
        velocities.append(reported_velocity(rows[0]))
        innovation, _ = linearise(rows[0], truth, 0.0)
        weighed.append(innovation**2)
    along, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    off = np.array(velocities) - truth[2:4]
    step_s = steps.end_s[0] - steps.start_s[0]
    assert (off @ along).std() == pytest.approx(0.02 / step_s, rel=0.05)
    assert (off @ across).std() == pytest.approx(0.05, rel=0.05)
    np.testing.assert_allclose(np.mean(weighed, axis=0), 1.0, rtol=0.1)


def test_errors_that_last_weigh_less() -> None:
    steps = steps_of(CORNERS, PAUSES, 1.0, 0.6375)
    times = np.array([1.1, 1.2, 1.6, 3.0])
    rng = np.random.default_rng(3)
    rows, _ = velocity_rows(times, steps, StepErrors(), rng, 0.6)
    np.testing.assert_allclose(rows[:, 0, VARIANCE], [6.0, 6.0, 1.5, 1.0])  # as if heard before
    np.testing.assert_array_equal(rows[..., GATE_VARIANCE], 1.0)
    assert math.isfinite(rows.sum())


def test_a_person_with_longer_steps_is_reported_slower() -> None:
    """True steps 25 % longer than reported and 0.2 rad to the left of the reported heading."""
    steps = steps_of(np.array([[0.0, 0.0], [6.0, 0.0]]), np.zeros(1), 1.0, 0.6)
    exact = StepErrors(length_sd_m=1e-9, heading_sd_rad=1e-9)
    person = Person(length_factor=1.25, heading_offset_rad=0.2)
    rows, _ = velocity_rows(np.array([0.3]), steps, exact, np.random.default_rng(0), 0.0, person)
    expected = 0.8 * np.array([math.cos(0.2), -math.sin(0.2)])
    np.testing.assert_allclose(reported_velocity(rows[0]), expected, atol=1e-6)
