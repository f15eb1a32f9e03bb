"""A device with three antennas in a square of four RSUs: its heading is a state of its own."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from antenna_square import (
    ANTENNAS,
    CORNERS,
    T0_NS,
    circle,
    errors,
    followed,
    heading_error,
    measure,
    standing,
    tracker,
    yaw_of,
)
from netpos.estimation.measurement import HEADING, LEVER, linearise
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.state import POSITION
from netpos.messages.values import (
    AngleConvention,
    Array,
    Field,
    RsuInfo,
    RsuMeasurement,
)
from scipy.constants import speed_of_light
from scipy.stats import chi2


def pose_fit(measured: list[RsuMeasurement], start: tuple[float, float, float]) -> Array:
    """Position and heading information (3, 3) of one epoch by differences, beside the engine."""
    rows = []
    for m in measured:
        corner = CORNERS[m.rsu_id.split("_")[0]]

        def distance(p: Array, m: RsuMeasurement = m, corner: Array = corner) -> float:
            c, s = math.cos(p[2]), math.sin(p[2])
            lx, ly, _ = m.lever_arm
            return math.hypot(
                p[0] + c * lx - s * ly - corner[0], p[1] + s * lx + c * ly - corner[1]
            )

        steps = 1e-5 * np.eye(3)
        p = np.array(start)
        rows.append([(distance(p + d) - distance(p - d)) / 2e-5 / 0.05 for d in steps])
    J = np.array(rows)
    information: Array = J.T @ J
    return information


@pytest.mark.parametrize("convention", AngleConvention)
@pytest.mark.parametrize("yaw", [-3.0, 0.4, 2.0])
def test_jacobian_in_the_heading_is_the_difference(
    convention: AngleConvention, yaw: float
) -> None:
    info = RsuInfo(
        rsu_id="r",
        position=np.array([2.0, -1.0, 4.0]),
        quaternion=np.array([0.1, -0.2, 0.3, math.sqrt(1.0 - 0.14)]),
        angle_convention=convention,
    )
    m = RsuMeasurement(
        stamp_ns=1,
        rsu_id="r",
        vue_id="v",
        fields=Field.AZIMUTH | Field.ELEVATION | Field.TOA | Field.RANGE,
        azimuth_var=1e-4,
        elevation_var=1e-4,
        toa_var=(0.1 / speed_of_light) ** 2,
        range_var=0.01,
        lever_arm=(1.5, -0.7, 0.0),
    )
    rows = rsu_rows(m, info, rsu_axes(info), 0, heading=6)
    mean = np.array([6.0, 5.0, 0.0, 0.0, 3.0, 0.0, yaw, 0.0])
    _, H = linearise(rows, mean, 1.2)
    step = 1e-6 * np.eye(8)
    for column in (0, 1, 6):
        ahead, _ = linearise(rows, mean + step[column], 1.2)
        behind, _ = linearise(rows, mean - step[column], 1.2)
        np.testing.assert_allclose(H[:, column], (behind - ahead) / 2e-6, atol=1e-7)
    turned = mean.copy()
    turned[:2] += (
        1.5 * math.cos(yaw) + 0.7 * math.sin(yaw),
        1.5 * math.sin(yaw) - 0.7 * math.cos(yaw),
    )
    rows_at_antenna = rows.copy()
    rows_at_antenna[:, HEADING], rows_at_antenna[:, LEVER:] = -1, 0.0
    np.testing.assert_allclose(
        linearise(rows, mean, 1.2)[0], linearise(rows_at_antenna, turned, 1.2)[0], atol=1e-12
    )


@pytest.mark.parametrize("yaw", [-3.0, 0.4, 2.0])
def test_a_position_fix_is_that_of_the_antenna(yaw: float) -> None:
    """Its Jacobian is the difference, and its decorrelated innovation that of the antenna."""
    cov = np.array([[2.0, 0.7, 0.0], [0.7, 1.0, 0.0], [0.0, 0.0, 1.0]])
    m = RsuMeasurement(
        stamp_ns=1,
        rsu_id="r",
        vue_id="v",
        fields=Field.POSITION,
        position=np.array([7.0, 5.5, 0.0]),
        position_cov=cov,
        lever_arm=(1.5, -0.7, 0.4),
    )
    info = RsuInfo(rsu_id="r", position=np.zeros(3))
    rows = rsu_rows(m, info, rsu_axes(info), 0, heading=6)
    mean = np.array([6.0, 5.0, 0.0, 0.0, 3.0, 0.0, yaw, 0.0])
    innovation, H = linearise(rows, mean, 1.2)
    step = 1e-6 * np.eye(8)
    for column in range(8):
        ahead, _ = linearise(rows, mean + step[column], 1.2)
        behind, _ = linearise(rows, mean - step[column], 1.2)
        np.testing.assert_allclose(H[:, column], (behind - ahead) / 2e-6, atol=1e-7)
    assert np.abs(H[:, 6]).max() > 0.1
    c, s = math.cos(yaw), math.sin(yaw)
    off = m.position[:2] - (6.0 + 1.5 * c + 0.7 * s, 5.0 + 1.5 * s - 0.7 * c)
    assert innovation @ innovation == pytest.approx(
        off @ np.linalg.solve(cov[POSITION, POSITION], off)
    )
    planar = rsu_rows(m, info, rsu_axes(info), 0)  # no heading: the fix is the device's
    off = m.position[:2] - mean[POSITION]
    bare = linearise(planar, mean, 1.2)[0]
    assert bare @ bare == pytest.approx(off @ np.linalg.solve(cov[POSITION, POSITION], off))


@pytest.mark.parametrize("filter_name", ["ekf", "iekf", "ukf", "srukf", "kf"])
def test_fixes_of_two_antennas_tell_the_heading(feed: Any, filter_name: str) -> None:
    """Two metres apart, fixed to 0.1 m each, on a circle."""
    antennas = {"a": (1.0, 0.0, 0.0), "b": (-1.0, 0.0, 0.0)}
    rng, sd = np.random.default_rng(3), 0.1
    target, reports = tracker(filter=filter_name), []
    for name in antennas:
        target.add_rsu(RsuInfo(rsu_id=name, position=np.zeros(3)))
    for k in range(100):
        x, y, yaw = circle(0.1 * k)
        c, s = math.cos(yaw), math.sin(yaw)
        fixes = [
            RsuMeasurement(
                stamp_ns=T0_NS + k * 10**8,
                rsu_id=name,
                vue_id="vue_1",
                expected=2,
                fields=Field.POSITION,
                position=np.array([x + c * arm[0], y + s * arm[0], 0.0])
                + sd * np.append(rng.normal(size=2), 0.0),
                position_cov=sd**2 * np.eye(3),
                lever_arm=arm,
            )
            for name, arm in antennas.items()
        ]
        (report,) = feed(target, fixes)
        reports.append((0.1 * k, report))
    place, turned = errors(circle, reports)
    alone = sd / math.sqrt(2.0)  # of the middle in one axis, and of the heading over 1 m
    assert np.abs(turned).max() < 4.0 * alone
    assert np.sqrt(np.mean(turned[20:] ** 2)) < 0.8 * alone
    assert np.sqrt(np.mean(place[20:] ** 2)) < 0.8 * alone


@pytest.mark.parametrize("yaw", [0.0, 1.3, math.pi - 1e-3, -math.pi + 1e-3, -1.9])
@pytest.mark.parametrize("filter_name", ["ekf", "iekf", "ukf", "srukf"])
def test_heading_of_a_device_at_rest(feed: Any, filter_name: str, yaw: float) -> None:
    path = standing(yaw)
    reports = followed(path, 5.0, 1, feed, tracker(filter=filter_name))
    assert reports[0][1].odometry is not None  # the first epoch is enough
    place, turned = errors(path, reports)
    one_epoch = np.linalg.inv(pose_fit(measure(path, 0.0), path(0.0)))
    assert np.abs(turned).max() < 4.0 * math.sqrt(one_epoch[2, 2])
    assert np.sqrt(np.mean(turned[20:] ** 2)) < 0.8 * math.sqrt(one_epoch[2, 2])
    assert np.sqrt(np.mean(place[20:] ** 2)) < 0.8 * math.sqrt(one_epoch[0, 0])
    for t, report in reports:
        assert report.odometry is not None, t
        assert -math.pi <= yaw_of(report.odometry) <= math.pi


def test_heading_is_not_the_direction_of_motion(feed: Any) -> None:
    """Facing outwards on a circle; the velocity is reported across, to the left."""
    reports = followed(circle, 60.0, 2, feed)  # nearly three turns: past +-pi as often
    place, turned = errors(circle, reports)
    assert np.abs(turned).max() < math.radians(8.0)
    assert np.sqrt(np.mean(turned[20:] ** 2)) < math.radians(2.0)
    assert np.sqrt(np.mean((place[20:] ** 2).sum(axis=1))) < 0.04
    velocity = np.array([r.odometry.linear_velocity for _, r in reports[50:] if r.odometry])
    # a constant velocity model lags behind a centripetal acceleration of 0.36 m/s^2
    np.testing.assert_allclose(velocity.mean(axis=0), [0.0, 1.2, 0.0], atol=0.08)


def test_position_and_heading_errors_are_as_large_as_promised(feed: Any) -> None:
    """Last epochs of independent runs, whose squared normalised errors add up to a chi-square."""
    runs, total, total_heading = 40, 0.0, 0.0
    for seed in range(runs):
        start = 0.37 * seed

        def path(t_s: float, start: float = start) -> tuple[float, float, float]:
            x, y, yaw = circle(t_s)
            return x, y, yaw + start

        t, report = followed(path, 3.0, seed, feed)[-1]
        assert report.odometry is not None
        cov = report.odometry.pose_cov
        d = report.odometry.position[:2] - path(t)[:2]
        total += float(d @ np.linalg.solve(cov[POSITION, POSITION], d))
        total_heading += heading_error(path, t, report.odometry) ** 2 / cov[5, 5]
    assert chi2.ppf(0.001, 2 * runs) < total < chi2.ppf(0.999, 2 * runs)
    assert chi2.ppf(0.001, runs) < total_heading < chi2.ppf(0.999, runs)


def test_lever_arms_matter(feed: Any) -> None:
    """Taken for measurements of base_link, the ranges of the antennas contradict each other."""
    with_arms, _ = errors(circle, followed(circle, 15.0, 4, feed))
    target, rng, without = tracker(motion_model="constant_velocity"), np.random.default_rng(4), []
    for k in range(150):
        bare = measure(circle, 0.1 * k, rng)
        for m in bare:
            m.lever_arm = (0.0, 0.0, 0.0)
        (report,) = feed(target, bare)
        without.append((0.1 * k, report))
    place, _ = errors(circle, without)
    rmse = [np.sqrt(np.mean((e[20:] ** 2).sum(axis=1))) for e in (with_arms, place)]
    assert rmse[0] < 0.2 * rmse[1]


def test_smoothed_heading_is_that_of_the_state(feed: Any) -> None:
    smoothed = [
        odometry
        for _, report in followed(circle, 10.0, 10, feed, tracker(fixed_lag_s=1.0))
        for odometry in report.smoothed
    ]
    turned = [heading_error(circle, (o.stamp_ns - T0_NS) * 1e-9, o) for o in smoothed]
    assert np.abs(turned[20:]).max() < math.radians(8.0)


def test_yaw_rate_is_reported(feed: Any) -> None:
    odometry = followed(circle, 10.0, 11, feed)[-1][1].odometry
    assert odometry is not None
    assert odometry.angular_velocity[2] == pytest.approx(0.3, abs=0.2)
    assert odometry.twist_cov[5, 5] < 1.0


def test_height_of_an_antenna_counts(feed: Any) -> None:
    """Antennas 1 m above base_link, 5 m from an RSU."""
    high = {name: (x, y, 1.0) for name, (x, y, _) in ANTENNAS.items()}
    reports = followed(lambda t: (7.0, 6.0, 0.3 * t), 10.0, 12, feed, sd=0.02, antennas=high)
    assert "gate" not in reports[-1][1].status.rejected


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e12])
def test_a_lever_arm_that_is_none_is_refused(bad: float) -> None:
    target, first = tracker(), measure(circle, 0.0)
    first[0].lever_arm = (bad, 0.0, 0.0)
    assert target.add(first[0]) is not None
