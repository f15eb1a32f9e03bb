"""Bearings under wide priors: against integration over the plane."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.filters import ekf
from netpos.filters.bearing import fuse_bearing, is_plain_bearing, on_top
from netpos.filters.fusion import W_USE
from netpos.filters.measurement import BIAS, HEADING
from netpos.filters.rows import rsu_axes, rsu_rows
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
    information matrix."""
    angle = azimuth + SD * np.linspace(-6, 6, 241)
    r = np.linspace(0, 80, 8001)[1:]
    place = RSU + np.stack(
        [np.outer(np.cos(angle), r).ravel(), np.outer(np.sin(angle), r).ravel()], axis=-1
    )
    off = place - mean[:2]
    log = -0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.inv(cov[:2, :2]), off)
    log -= 0.5 * np.repeat(((angle - azimuth) / SD) ** 2, r.size)
    weight = np.tile(r, angle.size) * np.exp(log - log.max())
    weight /= weight.sum()
    center = weight @ place
    C = (place - center).T @ ((place - center) * weight[:, None])
    information = np.linalg.inv(cov)
    rest = np.linalg.inv(information[2:, 2:])
    slope = -rest @ information[2:, :2]
    joint = np.vstack([np.eye(2), slope])
    expected = joint @ C @ joint.T
    expected[2:, 2:] += rest
    return mean + joint @ (center - mean[:2]), expected


@pytest.mark.parametrize("correlation", [0.0, 0.8])
@pytest.mark.parametrize(
    ("offset", "azimuth"),
    [([8.0, 3.0], 0.4), ([6.0, 0.0], 2.5), ([0.5, 0.5], -1.0), ([-4.0, 5.0], -0.6)],
    ids=["ahead", "behind", "on top", "far behind"],
)
def test_moments_are_those_of_the_plane(
    offset: list[float], azimuth: float, correlation: float
) -> None:
    mean, cov = _prior(offset, correlation)
    expected, expected_cov = _integrated(mean, cov, azimuth)
    x, P = mean.copy(), cov.copy()
    assert fuse_bearing(x, P, _row(azimuth, yaw=0.7), SD**2)
    sd = np.sqrt(np.diag(expected_cov))
    assert (np.abs(x - expected) < 0.01 * sd).all()
    np.testing.assert_allclose(P / np.outer(sd, sd), expected_cov / np.outer(sd, sd), atol=0.01)


def test_far_away_it_is_the_linear_update() -> None:
    mean, cov = _prior([900.0, 200.0], 0.3)
    row = _row(math.atan2(200.0, 900.0) + 0.002)
    x, P = mean.copy(), cov.copy()
    assert fuse_bearing(x, P, row, 1e-6)
    d = np.array([900.0, 200.0])
    h = np.zeros(6)
    h[:2] = np.array([-d[1], d[0]]) / (d @ d)
    s = h @ cov @ h + 1e-6
    np.testing.assert_allclose(x, mean + cov @ h * 0.002 / s, atol=0.03)
    np.testing.assert_allclose(P, cov - np.outer(cov @ h, cov @ h) / s, atol=0.02 * 400.0)
    assert abs(P[0, 0] / (cov - np.outer(cov @ h, cov @ h) / s)[0, 0] - 1) < 0.01


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
    """A strip along the bearing, cut in its middle: the range keeps its second moment, which of a
    half-normal is that of the normal."""
    mean, cov = np.array([*RSU, 0.0, 0.0, 0.0, 0.0]), np.eye(6)
    cov[0, 0], cov[1, 1] = 36.0, 1e-4
    once, again = (mean.copy(), cov.copy()), (mean.copy(), cov.copy())
    assert fuse_bearing(*once, _row(0.0), SD**2)
    assert fuse_bearing(*again, _row(0.0), SD**2, True)
    np.testing.assert_array_equal(once[0], again[0])
    moved = once[0][0] - RSU[0]
    strip = 1.0 - 1e-4 / 36.0
    assert again[1][0, 0] == pytest.approx(once[1][0, 0] + strip * moved**2, rel=1e-9)
    assert again[1][0, 0] == pytest.approx(36.0, rel=0.03)
    np.testing.assert_allclose(again[1][1:, 1:], once[1][1:, 1:], rtol=1e-9)
    round_cov = 4.0 * np.eye(6)
    first, other = (mean.copy(), round_cov.copy()), (mean.copy(), round_cov.copy())
    fuse_bearing(*first, _row(0.4), SD**2)
    fuse_bearing(*other, _row(0.4), SD**2, True)
    np.testing.assert_allclose(other[1], first[1], rtol=1e-9, atol=1e-12)


def test_bearings_cut_at_the_rsu_do_not_make_sure() -> None:
    """The prior passes the RSU while the device, 20 m before it, goes on being seen there."""
    mean, cov = np.array([RSU[0] - 3.0, RSU[1], 0.0, 0.0, 0.0, 0.0]), np.eye(6)
    cov[0, 0], cov[1, 1] = 64.0, 0.04
    rows, gate, work = _row(0.0)[None], np.array([0.0, np.inf]), ekf.workspace(6, 1)
    for _ in range(60):
        ekf.update(mean, cov, rows, 0.0, gate, 8, np.zeros(1), work)
    error = RSU[0] + 20.0 - mean[0]
    assert error**2 < 12.0 * cov[0, 0]


@pytest.mark.parametrize(("distance", "near"), [(1.99, True), (2.01, False)])
def test_an_rsu_is_near_within_two_sd(distance: float, near: bool) -> None:
    rows, work = _row(0.0)[None], ekf.workspace(6, 1)
    cov, mean = np.diag([0.5, 0.5, 1.0, 1.0, 1.0, 1.0]), np.zeros(6)
    mean[:2] = RSU + distance * np.array([0.6, -0.8])
    work[W_USE, 0] = 1.0
    assert on_top(mean, cov, rows, work) is near
    work[W_USE, 0] = 0.0
    assert not on_top(mean, cov, rows, work)
