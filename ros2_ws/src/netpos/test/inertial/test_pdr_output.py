"""Velocity of a step and its covariance against differences and Monte Carlo."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.inertial.pdr_output import step_velocity


def test_step_velocity_matches_petukhov_variances() -> None:
    """Eqs. 7-8 as printed, term by term, by central differences of eq. 6."""
    length, duration, heading, sd_l, sd_h = 0.7, 0.55, 0.9, 0.06, 0.12
    velocity, cov = step_velocity(length, duration, heading, sd_l, sd_h)

    def v(a: float, b: float) -> np.ndarray:
        return np.array([a / duration * math.cos(b), a / duration * math.sin(b)])

    h = 1e-6
    dl = (v(length + h, heading) - v(length - h, heading)) / (2 * h)
    dh = (v(length, heading + h) - v(length, heading - h)) / (2 * h)
    expected = sd_l**2 * np.outer(dl, dl) + sd_h**2 * np.outer(dh, dh)
    np.testing.assert_allclose(velocity, v(length, heading), rtol=1e-12)
    np.testing.assert_allclose(cov, expected, rtol=1e-7)


def test_step_velocity_covariance_by_monte_carlo() -> None:
    rng = np.random.default_rng(11)
    n, heading = 200_000, -2.0
    lengths = rng.normal(0.7, 0.03, n)
    headings = rng.normal(heading, 0.05, n)
    sample = np.cov(lengths / 0.5 * np.cos(headings), lengths / 0.5 * np.sin(headings))
    _, cov = step_velocity(0.7, 0.5, heading, 0.03, 0.05)
    np.testing.assert_allclose(cov, sample, atol=0.02 * float(np.max(np.abs(cov))))


def test_step_velocity_refuses_no_duration() -> None:
    with pytest.raises(ValueError, match="duration"):
        step_velocity(0.7, 0.0, 0.0, 0.1, 0.1)
