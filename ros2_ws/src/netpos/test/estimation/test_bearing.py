"""Bearings under wide priors: against integration over the plane."""

from __future__ import annotations

import math

import filter_rows
import numpy as np
import pytest
from curved_rows import bends, values_of_a_bend
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import (
    BIAS,
    HEADING,
    SAME_BEND,
    VARIANCE,
    Kind,
    curvature_variance,
    linearise,
)
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.state import POSITION, X
from netpos.estimation.update.bearing import fuse_around, fuse_bearing, is_plain_bearing, on_top
from netpos.estimation.update.fusion import W_COV, W_PRIOR, W_USE
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement

RSU = np.array([3.0, -2.0])
SD = 0.05


def _row(azimuth: float, yaw: float = 0.0) -> Array:
    info = RsuInfo(
        rsu_id="a",
        position=np.array([*RSU, 0.0]),
        quaternion=np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]),
    )
    m = RsuMeasurement(
        stamp_ns=1,
        rsu_id="a",
        vue_id="v",
        fields=Field.AZIMUTH,
        azimuth_rad=azimuth - yaw,
        azimuth_var=SD**2,
    )
    row: Array = rsu_rows(m, info, rsu_axes(info), 0)[0]
    return row


def _prior(offset: list[float], correlation: float) -> tuple[Array, Array]:
    mean = np.array([*(RSU + offset), 1.0, -1.0, 5.0, 0.2])
    mix = np.eye(6)
    mix[1, 0] = correlation
    mix[2, :2] = 0.3, -0.2
    mix[4, :3] = 0.5, 0.1, 0.4
    return mean, mix @ np.diag([5.0, 4.0, 3.0, 3.0, 20.0, 1.0]) ** 2 @ mix.T


def _integrated(mean: Array, cov: Array, azimuth: float) -> tuple[Array, Array]:
    """Posterior moments: the position on a polar grid, the rest by the blocks of the prior's
    information matrix. As far as the prior is longer along the bearing than across, it is a wedge,
    its width across growing with the distance, and its second moment along the bearing, about the
    prior's mean, is kept."""
    angle = azimuth + SD * np.linspace(-6, 6, 241)
    r = np.linspace(0, 80, 8001)[1:]
    place = RSU + np.stack(
        [np.outer(np.cos(angle), r).ravel(), np.outer(np.sin(angle), r).ravel()], axis=-1
    )
    along = np.array([math.cos(azimuth), math.sin(azimuth)])
    across = np.array([-along[1], along[0]])
    long, skew = along @ cov[POSITION, POSITION] @ along, across @ cov[POSITION, POSITION] @ along
    strip = max(2.0 - np.trace(cov[POSITION, POSITION]) / long, 0.0)
    reach = place @ along - RSU @ along
    start = (mean[POSITION] - RSU) @ along
    variance = across @ cov[POSITION, POSITION] @ across - skew**2 / long
    variance *= 1.0 - strip + strip * reach**2 / (start**2 + long)
    aside = (place - mean[POSITION]) @ across - skew / long * (reach - start)
    log = -0.5 * ((reach - start) ** 2 / long + aside**2 / variance + np.log(variance))
    log -= 0.5 * np.repeat(((angle - azimuth) / SD) ** 2, r.size)
    weight = np.tile(r, angle.size) * np.exp(log - log.max())
    weight /= weight.sum()
    center = weight @ place
    C = (place - center).T @ ((place - center) * weight[:, None])
    C += strip * (along @ (center - mean[POSITION])) ** 2 * np.outer(along, along)
    information = np.linalg.inv(cov)
    rest = np.linalg.inv(information[2:, 2:])
    slope = -rest @ information[2:, :2]
    joint = np.vstack([np.eye(2), slope])
    expected = joint @ C @ joint.T
    expected[2:, 2:] += rest
    return mean + joint @ (center - mean[POSITION]), expected


@pytest.mark.parametrize(
    ("offset", "azimuth", "correlations"),
    [
        ([8.0, 3.0], 0.4, (0.0, 0.8, 20.0)),
        ([6.0, 0.0], 2.5, (0.0, 0.8)),
        ([0.5, 0.5], -1.0, (0.0, 0.8, 20.0)),
        ([-4.0, 5.0], -0.6, (0.0, 0.8)),
    ],
    ids=["ahead", "behind", "on top", "far behind"],
)
def test_moments_are_those_of_the_plane(
    offset: list[float], azimuth: float, correlations: tuple[float, ...]
) -> None:
    """Correlation 20: a strip across the bearing, much narrower than its shadow on it."""
    for correlation in correlations:
        mean, cov = _prior(offset, correlation)
        expected, expected_cov = _integrated(mean, cov, azimuth)
        x, P = mean.copy(), cov.copy()
        assert fuse_bearing(x, P, _row(azimuth, yaw=0.7), SD**2)
        sd = np.sqrt(np.diag(expected_cov))
        scale = np.outer(sd, sd)
        assert (np.abs(x - expected) < 0.01 * sd).all()
        np.testing.assert_allclose(P / scale, expected_cov / scale, atol=0.01)


@pytest.mark.parametrize(("aside", "rel"), [(0.5, 0.02), (60.0, 0.05)])
def test_a_bearing_that_contradicts_is_weighed_like_any(aside: float, rel: float) -> None:
    """A narrow prior 100 m away: across the bearing two normals, half a metre or 60 m apart."""
    mean, cov = np.array([*RSU, 0.0, 0.0, 0.0, 0.0]), np.eye(6)
    mean[POSITION] += 100.0, aside
    cov[X.PX, X.PX] = 1e-4
    assert fuse_bearing(mean, cov, _row(0.0), 0.01**2)
    assert mean[X.PY] - RSU[1] == pytest.approx(aside / 2.0, rel=rel)
    assert cov[X.PY, X.PY] == pytest.approx(0.5, rel=rel)
    assert mean[X.PX] - RSU[0] == pytest.approx(100.0, abs=0.1)


def test_other_rows_follow_at_the_result() -> None:
    """A range beside the bearing, one of three of the same bend, and one that is not used; a
    bearing under a prior that is none is fused linearised, too."""
    mean, cov = _prior([6.0, 0.0], 0.3)
    rows = np.array(
        [
            filter_rows.row(Kind.RANGE, 9.0, 0.2, 0, (8.0, 5.0, 1.0)),
            _row(2.5),
            filter_rows.row(Kind.RANGE, 1.0, 0.2, 2, (8.0, 5.0, 1.0)),
        ]
    )
    rows[0, SAME_BEND] = 2.0
    for is_flat in (False, True):
        if is_flat:
            cov[0], cov[:, 0] = 0.0, 0.0
        work = ekf.workspace(6, 3)
        work[W_PRIOR], work[W_COV : W_COV + 6], work[W_USE, :3] = mean, cov, (1.0, 1.0, 0.0)
        x, P = np.full(6, 7.0), np.full((6, 6), 7.0)
        fuse_around(x, P, rows, 0.5, work)
        expected, expected_cov, linear = mean.copy(), cov.copy(), rows[:2]
        if not is_flat:
            assert fuse_bearing(expected, expected_cov, rows[1], SD**2)
            linear = rows[:1]
        z, H = linearise(linear, expected, 0.5)
        z -= bends(expected, expected_cov, linear, 0.5)
        bent = [curvature_variance(r, expected, expected_cov, 0.5) for r in linear]
        extra = values_of_a_bend(expected, linear) * bent
        gain = expected_cov @ H.T
        gain @= np.linalg.inv(H @ gain + np.diag(linear[:, VARIANCE] + extra))
        np.testing.assert_allclose(x, expected + gain @ z, rtol=1e-9)
        np.testing.assert_allclose(P, expected_cov - gain @ H @ expected_cov, atol=1e-9)


def test_far_away_it_is_the_linear_update() -> None:
    mean, cov = _prior([900.0, 200.0], 0.3)
    row = _row(math.atan2(200.0, 900.0) + 0.002)
    x, P = mean.copy(), cov.copy()
    assert fuse_bearing(x, P, row, 1e-6)
    d = np.array([900.0, 200.0])
    h = np.zeros(6)
    h[POSITION] = np.array([-d[1], d[0]]) / (d @ d)
    s = h @ cov @ h + 1e-6
    np.testing.assert_allclose(x, mean + cov @ h * 0.002 / s, atol=0.03)
    np.testing.assert_allclose(P, cov - np.outer(cov @ h, cov @ h) / s, atol=0.02 * 400.0)
    assert abs(P[X.PX, X.PX] / (cov - np.outer(cov @ h, cov @ h) / s)[0, 0] - 1) < 0.01


def test_a_strip_across_a_far_bearing_is_cut_where_it_is() -> None:
    """A kilometre long and some centimetres wide, 1.3 km away: the linear update, on a piece of
    the bearing that is a ten thousandth of what the prior leaves open."""
    mean, cov = np.array([*RSU, 1.0, -1.0, 5.0, 0.2]), np.eye(6)
    mean[POSITION] += 1200.0, 500.0
    turn = np.array([[12.0, -5.0], [5.0, 12.0]]) / 13.0  # along and across the bearing
    strip = 200.0**2 * np.array([[1.0, 1.0], [1.0, 1.0 + 1e-8]])
    cov[POSITION, POSITION] = turn @ strip @ turn.T
    row = _row(math.atan2(5.0, 12.0))
    x, P = mean.copy(), cov.copy()
    assert fuse_bearing(x, P, row, 1e-10)
    h = np.zeros(6)
    h[POSITION] = turn[:, 1] / 1300.0
    gain = cov @ h / (h @ cov @ h + 1e-10)
    expected = cov - np.outer(gain, h @ cov)
    sd = np.sqrt(np.diag(expected))
    assert (np.abs(x - mean) < 0.01 * sd).all()
    np.testing.assert_allclose(P / np.outer(sd, sd), expected / np.outer(sd, sd), atol=0.01)


def test_only_plain_bearings_are_taken() -> None:
    row = _row(0.3)
    assert is_plain_bearing(row)
    for column in (BIAS, HEADING):
        other = row.copy()
        other[column] = 6
        assert not is_plain_bearing(other)


def test_a_device_behind_the_rsu_is_not_put_on_top_of_it() -> None:
    """The most probable place is the RSU's own, where no bearing says anything."""
    mean, cov = _prior([11.0, 0.0], 0.0)
    azimuth = 2.3
    expected, expected_cov = _integrated(mean, cov, azimuth)
    x, P = mean.copy(), cov.copy()
    rows = _row(azimuth)[None]
    gate = np.array([0.0, np.inf])
    ekf.update(x, P, rows, 0.0, gate, 8, np.zeros(1), ekf.workspace(6, 1))
    sd = np.sqrt(np.diag(expected_cov))
    assert np.hypot(*(expected[:2] - RSU)) > 1.0
    assert (np.abs(x - expected) < 0.02 * sd).all()
    np.testing.assert_allclose(P / np.outer(sd, sd), expected_cov / np.outer(sd, sd), atol=0.02)


def test_the_same_bearing_again_tells_the_side_and_no_distance() -> None:
    """A strip along the bearing, cut in its middle: the range has the mean of a half-normal and
    keeps its second moment, which is that of the normal."""
    mean, cov = np.array([*RSU, 0.0, 0.0, 0.0, 0.0]), np.eye(6)
    cov[X.PX, X.PX], cov[X.PY, X.PY] = 36.0, 1e-4
    assert fuse_bearing(mean, cov, _row(0.0), SD**2)
    assert mean[X.PX] - RSU[0] == pytest.approx(6.0 * math.sqrt(2.0 / math.pi), rel=0.03)
    assert cov[X.PX, X.PX] == pytest.approx(36.0, rel=0.03)
    np.testing.assert_array_equal(cov[2:, 2:], np.eye(4))


def test_bearings_of_a_strip_do_not_push_it_away() -> None:
    """Twenty bearings of a strip that they keep narrow: there is more plane farther away, and each
    would say so again."""
    mean, cov = np.zeros(6), np.eye(6)
    mean[POSITION] = RSU[0] + 12.0, RSU[1]
    cov[X.PX, X.PX] = 4.0**2
    for _ in range(20):
        cov[X.PY, X.PY] = 0.7**2  # the device has moved
        assert fuse_bearing(mean, cov, _row(0.0), SD**2)
    assert 12.0 < mean[X.PX] - RSU[0] < 13.5
    assert 3.0**2 < cov[X.PX, X.PX] < 4.0**2


def test_bearings_cut_at_the_rsu_do_not_make_sure() -> None:
    """The prior passes the RSU while the device, 20 m before it, goes on being seen there."""
    mean, cov = np.array([RSU[0] - 3.0, RSU[1], 0.0, 0.0, 0.0, 0.0]), np.eye(6)
    cov[X.PX, X.PX], cov[X.PY, X.PY] = 64.0, 0.04
    rows, gate, work = _row(0.0)[None], np.array([0.0, np.inf]), ekf.workspace(6, 1)
    for _ in range(60):
        ekf.update(mean, cov, rows, 0.0, gate, 8, np.zeros(1), work)
    error = RSU[0] + 20.0 - mean[X.PX]
    assert error**2 < 12.0 * cov[X.PX, X.PX]


@pytest.mark.parametrize(("distance", "near"), [(3.99, True), (4.01, False)])
def test_an_rsu_is_near_within_two_sd(distance: float, near: bool) -> None:
    rows, work = _row(0.0)[None], ekf.workspace(6, 1)
    cov, mean = np.diag([1.5, 2.5, 1.0, 1.0, 1.0, 1.0]), np.zeros(6)
    mean[POSITION] = RSU + distance * np.array([0.6, -0.8])
    work[W_USE, 0] = 1.0
    assert on_top(mean, cov, rows, work) is near
    work[W_USE, 0] = 0.0
    assert not on_top(mean, cov, rows, work)
