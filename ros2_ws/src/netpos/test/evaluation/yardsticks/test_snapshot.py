"""Snapshots against exact geometry and the Cramér-Rao bound."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from corner_ranges import LEVEL, SQUARE, S, at_rest
from netpos.evaluation.yardsticks import (
    Kind,
    Space,
    ranges,
    residuals,
    snapshot,
    snapshots,
)


@pytest.mark.parametrize("kind", ["range", "tdoa", "azimuth"])
def test_a_snapshot_of_exact_measurements_is_exact(kind: str) -> None:
    position = np.array([6.0, 13.0, 1.0])
    seen = ranges([S] * 4, SQUARE, np.zeros(4), 0.1, np.roll(SQUARE, 1, axis=0))
    if kind == "range":
        seen = ranges([S] * 4, SQUARE, np.zeros(4), 0.1)
    if kind == "azimuth":
        seen = replace(seen, kind=np.full(4, int(Kind.AZIMUTH)))
    seen = replace(seen, value=-residuals(seen, position)[0])
    fix = snapshot(seen, LEVEL)
    assert fix is not None
    np.testing.assert_allclose(fix.state, position[:2], atol=1e-6)


def test_a_snapshot_in_space_finds_the_height() -> None:
    sites = SQUARE + np.array([[0, 0, 0], [0, 0, 4], [0, 0, 0], [0, 0, 6.0]])
    position = np.array([6.0, 13.0, 0.5])
    seen = ranges([S] * 4, sites, np.linalg.norm(position - sites, axis=1), 0.1)
    fix = snapshot(seen, Space(dimensions=3, height_m=1.0))
    assert fix is not None
    np.testing.assert_allclose(fix.state, position, atol=1e-5)


def test_several_antennas_show_the_heading() -> None:
    position, heading = np.array([6.0, 13.0, 1.0]), 2.0
    arms = np.tile([[0.5, 0.0, 0.0], [-0.5, 0.3, 0.0]], (4, 1))
    seen = replace(ranges([S] * 8, np.repeat(SQUARE, 2, axis=0), np.zeros(8), 0.1), lever_arm=arms)
    seen = replace(seen, value=-residuals(seen, position, heading)[0])
    fix = snapshot(seen, LEVEL)
    assert fix is not None
    np.testing.assert_allclose(fix.state[:2], position[:2], atol=1e-6)
    assert math.cos(fix.state[2] - heading) == pytest.approx(1.0)


def test_a_snapshot_reaches_the_bound_of_a_device_at_rest() -> None:
    """In the middle of a square the four rays are at right angles: the information of n ranges per
    corner is 2 n cos(elevation)^2 / sd^2 along each axis (Cramér-Rao)."""
    rng, sd, position = np.random.default_rng(11), 0.3, np.array([10.0, 10.0, 1.0])
    level2 = 200.0 / (200.0 + 4.0)
    bound = sd**2 / (2 * 10 * level2)
    errors = []
    for _ in range(300):
        fix = snapshot(at_rest(position, sd, 1, rng), LEVEL)
        assert fix is not None
        np.testing.assert_allclose(fix.cov, bound * np.eye(2), rtol=0.05, atol=0.05 * bound)
        errors.append(fix.state - position[:2])
    # 600 squared errors: relative sd of their mean sqrt(2 / 600) = 0.058
    assert np.mean(np.square(errors)) == pytest.approx(bound, rel=4 * 0.058)


@pytest.mark.parametrize("count", [0, 1])
def test_a_snapshot_refuses_too_few_measurements(count: int) -> None:
    seen = ranges([S] * 4, SQUARE, np.full(4, 14.0), 0.1)
    assert snapshot(seen, LEVEL) is not None
    assert snapshot(seen.take(slice(0, count)), LEVEL) is None


def test_a_snapshot_refuses_two_sides_of_a_pair_of_rsus() -> None:
    """Two ranges alone meet north and south of the line through the RSUs."""
    position = np.array([8.0, 6.0, 1.0])
    seen = ranges([S] * 2, SQUARE[:2], np.linalg.norm(position - SQUARE[:2], axis=1), 0.1)
    assert snapshot(seen, LEVEL) is None
    known = snapshot(seen, LEVEL, start=position[:2] + 1.0)
    assert known is not None
    np.testing.assert_allclose(known.state, position[:2], atol=1e-5)


def test_a_snapshot_refuses_one_bearing_from_afar() -> None:
    """Two bearings that are nearly parallel leave the distance open: sd above 5 m."""
    rsu = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]])
    seen = replace(ranges([S] * 2, rsu, np.zeros(2), 0.1), kind=np.full(2, int(Kind.AZIMUTH)))
    seen = replace(seen, value=-residuals(seen, np.array([50.0, 30.0, 1.0]))[0])
    assert snapshot(seen, LEVEL, start=np.array([50.0, 30.0])) is None


def test_a_snapshot_leaves_out_a_range_that_is_far_off() -> None:
    position = np.array([6.0, 13.0, 1.0])
    seen = at_rest(position, 0.01, 1, np.random.default_rng(5))
    wrong = seen.value.copy()
    wrong[7] += 0.5
    fix = snapshot(replace(seen, value=wrong), LEVEL)
    assert fix is not None
    assert np.linalg.norm(fix.state - position[:2]) < 0.01


def test_a_series_of_snapshots_uses_one_second_and_is_silent_without_measurements() -> None:
    position = np.array([6.0, 13.0, 1.0])
    seen = at_rest(position, 0.1, 6, np.random.default_rng(5))
    away = (seen.stamp_ns > 2 * S) & (seen.stamp_ns < 5 * S)
    path = snapshots(seen.take(~away), LEVEL)
    times = path.stamp_ns / S
    assert times.min() == 1.0
    assert not ((times > 2.0) & (times < 5.0)).any()
    # at 5 s only one stamp is in the window, at 5.9 s ten are
    variances = path.position_cov[:, 0, 0]
    assert variances[times == 5.0][0] == pytest.approx(10 * variances[-1], rel=0.05)
    np.testing.assert_allclose(path.position[:, 2], 1.0)
