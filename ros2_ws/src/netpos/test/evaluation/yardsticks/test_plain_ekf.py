"""The plain filter against the information form and closed-form variances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from corner_ranges import LEVEL, S, at_rest
from netpos.evaluation.yardsticks import (
    PlainConfig,
    Space,
    plain_ekf,
    ranges,
)
from netpos.messages.values import Array


def constant_velocity_kalman(z: Array, dt: float, q: float, R: float, v0: float) -> Array:
    """Information form of the same filter on one axis with direct positions: (n, 2) means and
    variances of the position."""
    F = np.array([[1, dt], [0, 1]])
    Q = q**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    x, P = np.array([z[0], 0.0]), np.diag([R, v0**2])
    out = [(x[0], P[0, 0])]
    for value in z[1:]:
        x, P = F @ x, F @ P @ F.T + Q
        Y = np.linalg.inv(P) + np.diag([1 / R, 0])
        x = np.linalg.solve(Y, np.linalg.inv(P) @ x + np.array([value / R, 0]))
        P = np.linalg.inv(Y)
        out.append((x[0], P[0, 0]))
    return np.array(out)


def test_the_plain_filter_is_the_linear_one_with_far_rsus() -> None:
    """Pairs of RSUs 10 km east and west, north and south: half the difference of two ranges is the
    position, and their curvatures cancel. The first stamp is a snapshot."""
    rng, n, dt, away = np.random.default_rng(2), 40, 0.5, 1e4
    way = np.column_stack([1.3 * dt * np.arange(n), -0.4 * dt * np.arange(n)])
    far = away * np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]])
    signs = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    heard = way @ signs.T + 0.2 * rng.standard_normal((n, 4))
    stamps = np.repeat(S + (np.arange(n) * dt * S).astype(np.int64), 4)
    seen = ranges(stamps, np.tile(far, (n, 1)), (heard + away).ravel(), 0.2)
    config = PlainConfig(gate_sd=1e9)
    run = plain_ekf(seen, Space(), config)
    for axis in range(2):
        z = (heard[:, 2 * axis] - heard[:, 2 * axis + 1]) / 2
        expected = constant_velocity_kalman(z, dt, config.accel_density, 0.02, 10.0)
        np.testing.assert_allclose(run.estimate.position[:, axis], expected[:, 0], atol=2e-3)
        cov = run.estimate.position_cov[:, axis, axis]
        np.testing.assert_allclose(cov, expected[:, 1], rtol=1e-3)


def test_the_plain_filter_s_nis_is_that_of_its_measurements() -> None:
    """A device at rest; without acceleration the filter's model is exact: NIS 1 a measurement."""
    seen = at_rest(np.array([6.0, 13.0, 1.0]), 0.2, 60, np.random.default_rng(8))
    run = plain_ekf(seen, LEVEL, PlainConfig(accel_density=1e-3, initial_speed_sd_mps=1.0))
    counted = [s for s in run.statuses if s.nis_dof]
    mean = sum(s.nis for s in counted) / sum(s.nis_dof for s in counted)
    # 2396 values of variance 2
    assert mean == pytest.approx(1.0, abs=4 * math.sqrt(2 / 2396))


@pytest.mark.parametrize(("off_sd", "rejected"), [(3.9, 0), (4.1, 1)])
def test_the_gate_of_the_plain_filter_at_its_boundary(off_sd: float, rejected: int) -> None:
    """A range is off by this many sd of its innovation."""
    position = np.array([10.0, 10.0, 1.0])
    seen = at_rest(position, 0.2, 30, np.random.default_rng(8))
    seen = replace(seen, value=np.linalg.norm(position - seen.rsu, axis=1))
    before = plain_ekf(seen.take(slice(0, -4)), LEVEL)
    config, dt = PlainConfig(), 0.1
    assert before.statuses[-1].rejected == {"gate": 0}
    # the steady position variance predicted for the last stamp, along a ray at 45 degrees
    P = np.diag([0.2**2, 100.0])
    Q = config.accel_density**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    F, level2 = np.array([[1, dt], [0, 1]]), 200.0 / 204.0
    for _ in range(2000):
        P = F @ P @ F.T + Q
        prior = P[0, 0]
        P = np.linalg.inv(np.linalg.inv(P) + np.diag([2 * level2 / 0.04, 0]))
    wrong = seen.value.copy()
    wrong[-4] += off_sd * math.sqrt(prior * level2 + 0.04)
    after = plain_ekf(replace(seen, value=wrong), LEVEL)
    assert after.statuses[-1].rejected == {"gate": rejected}
    assert after.statuses[-1].accepted == len(seen) - rejected


def test_the_plain_filter_starts_anew_after_a_silence_and_where_all_is_refused() -> None:
    here, there = np.array([4.0, 5.0, 1.0]), np.array([15.0, 9.0, 1.0])
    rng = np.random.default_rng(4)
    before, after = at_rest(here, 0.1, 5, rng), at_rest(there, 0.1, 5, rng)
    for pause_s in (0, 60):
        later = replace(after, stamp_ns=after.stamp_ns + (5 + pause_s) * S)
        both = ranges(
            np.concatenate([before.stamp_ns, later.stamp_ns]),
            np.vstack([before.rsu, later.rsu]),
            np.concatenate([before.value, later.value]),
            0.1,
        )
        run = plain_ekf(both, LEVEL)
        times = run.estimate.stamp_ns / S - 6 - pause_s
        error = np.linalg.norm(run.estimate.position[:, :2] - there[:2], axis=1)
        patience = 0.0 if pause_s else PlainConfig().restart_after_s + 0.2
        assert error[times > patience].max() < 0.5
        assert not ((times > -pause_s - 0.05) & (times < -0.05)).any()
