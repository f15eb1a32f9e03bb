"""Extrapolation against the closed forms of constant acceleration under white jerk."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from netpos.messages.values import NetworkTrack
from netpos.tracking.networks.common_instant import at_common_instant, step_matrices
from scipy.linalg import expm

NS = 1_000_000_000


def test_step_matrices_against_van_loan() -> None:
    """F and Q from the matrix exponential of the continuous model."""
    A, G = np.zeros((6, 6)), np.zeros((6, 6))
    A[0, 2] = A[1, 3] = A[2, 4] = A[3, 5] = 1.0
    G[4, 4] = G[5, 5] = 0.7**2
    dt = 0.35
    big = expm(np.block([[-A, G], [np.zeros((6, 6)), A.T]]) * dt)
    F = big[6:, 6:].T
    found_F, found_Q = step_matrices(round(dt * NS), 0.7)
    np.testing.assert_allclose(found_F, F, atol=1e-12)
    np.testing.assert_allclose(found_Q, F @ big[:6, 6:], atol=1e-12)


def test_tracks_of_different_stamps_meet(track: Callable[..., NetworkTrack]) -> None:
    mean = np.array([10.0, -4.0, 3.0, 1.0, 0.5, -0.2])
    a, b = track("wifi", 0.0, mean=mean), track("wimax", 0.8, 5.0)
    moved = at_common_instant([a, b], b.stamp_ns, 0.7)
    t = 0.8
    expected = [
        10 + 3 * t + 0.25 * t * t,
        -4 + t - 0.1 * t * t,
        3 + 0.5 * t,
        1 - 0.2 * t,
        0.5,
        -0.2,
    ]
    np.testing.assert_allclose(moved.mean[0], expected, atol=1e-12)
    F, Q = step_matrices(round(t * NS), 0.7)
    np.testing.assert_allclose(moved.cov[0], F @ a.cov @ F.T + Q, atol=1e-12)
    np.testing.assert_allclose(moved.own_cov[0], F @ a.own_cov @ F.T, atol=1e-12)
    np.testing.assert_array_equal(moved.mean[1], b.mean)
    np.testing.assert_array_equal(moved.cov[1], b.cov)
