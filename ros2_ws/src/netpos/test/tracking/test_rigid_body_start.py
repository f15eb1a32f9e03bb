"""The first pose of a device with several antennas, and the first after a silence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from antenna_square import (
    ANTENNAS,
    T0_NS,
    followed,
    heading_error,
    measure,
    standing,
    tracker,
)
from netpos.messages.values import (
    InitialPose,
)
from scipy.stats import chi2

AHEAD = {"left": (3.0, 1.0, 0.0), "right": (3.0, -1.0, 0.0)}


def test_first_heading_is_waited_for(feed: Any) -> None:
    """One antenna off the middle leaves a circle of poses; a second one decides."""
    path, target = standing(2.2), tracker()
    one = {"left": ANTENNAS["left"]}
    for k in range(20):
        for report in feed(target, measure(path, 0.1 * k, antennas=one)):
            assert report.odometry is None
    found = [feed(target, measure(path, 2.0 + 0.1 * k)) for k in range(3)]
    odometry = found[-1][-1].odometry
    assert odometry is not None
    assert abs(heading_error(path, 2.2, odometry)) < math.radians(4.0)


def test_a_noisy_first_heading_is_never_the_opposite_one(feed: Any) -> None:
    """Ranges as noisy as the antennas are apart (0.5 m): what is reported lies within 4.5 sd."""
    for seed in range(25):
        path = standing(0.25 * seed)
        t, report = followed(path, 1.0, seed, feed, sd=0.5)[-1]
        if report.odometry is not None:
            error = heading_error(path, t, report.odometry)
            assert abs(error) < 4.5 * math.sqrt(report.odometry.pose_cov[5, 5])


def test_heading_is_found_anew_after_a_silence(feed: Any) -> None:
    target = tracker(max_gap_s=2.0)
    followed(standing(0.5), 1.0, 5, feed, target)
    path, rng = standing(-2.6), np.random.default_rng(6)
    for k in range(5):
        (report,) = feed(target, measure(path, 10.0 + 0.1 * k, rng))
    assert report.odometry is not None
    assert abs(heading_error(path, 10.4, report.odometry)) < math.radians(6.0)


def test_initial_pose_leaves_the_heading_to_the_lever_arms(feed: Any) -> None:
    for yaw in np.linspace(-3.1, 3.1, 9):
        path, target, rng = standing(float(yaw)), tracker(), np.random.default_rng(7)
        pose = InitialPose(
            stamp_ns=T0_NS,
            vue_id="vue_1",
            position=np.array([1.0, 2.0, 0.0]),
            cov=0.25 * np.eye(3),
        )
        for k in range(10):
            items = measure(path, 0.1 * k, rng)
            (report,) = feed(target, [pose, *items] if k == 0 else items)
        assert report.odometry is not None
        assert abs(heading_error(path, 0.9, report.odometry)) < math.radians(6.0)


@pytest.mark.parametrize("filter_name", ["ekf", "ukf"])
def test_initial_pose_without_iteration(feed: Any, filter_name: str) -> None:
    place, cov = np.array([1.0, 2.0, 0.0]), 0.25 * np.eye(3)
    for yaw in (0.3, -2.6):
        path, target = standing(yaw), tracker(filter=filter_name)
        target.add(InitialPose(stamp_ns=T0_NS, vue_id="vue_1", position=place, cov=cov))
        t, report = followed(path, 3.0, 1, feed, target)[-1]
        assert report.odometry is not None
        assert abs(heading_error(path, t, report.odometry)) < math.radians(6.0)


def test_first_fix_with_antennas_far_ahead(feed: Any) -> None:
    path, target = standing(1.0), tracker()
    (report,) = feed(target, measure(path, 0.0, np.random.default_rng(8), antennas=AHEAD))
    assert report.odometry is not None
    d = report.odometry.position[:2] - path(0.0)[:2]
    assert d @ np.linalg.solve(report.odometry.pose_cov[:2, :2], d) < chi2.ppf(0.9999, 2)


def test_first_fix_close_to_an_rsu(feed: Any) -> None:
    """0.9 m from a corner, with ranges to all four."""
    reports = followed(lambda _: (9.4, 9.3, 0.4), 4.0, 9, feed, sd=0.02)
    assert reports[-1][1].odometry is not None
