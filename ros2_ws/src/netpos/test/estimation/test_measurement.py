"""Values and Jacobians of the measurement models."""

from __future__ import annotations

import math

import filter_rows
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from measurement_rows import PLANAR, closed_form, random_row, random_state
from netpos.estimation.measurement import (
    BIAS,
    BLOCKED,
    COMMON,
    HEADING,
    KIND,
    LEVER,
    ROW_WIDTH,
    VALUE,
    Kind,
    is_angle,
    linearise,
    predict_row,
    wrap,
)
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.state import VELOCITY
from netpos.messages.values import Field, RsuInfo, RsuMeasurement

ANGLE_KINDS = (Kind.AZIMUTH, Kind.ELEVATION)
CYCLIC_KINDS = (*ANGLE_KINDS, Kind.PHASE)
DIRECTION_KINDS = (*ANGLE_KINDS, Kind.COSINE_Y, Kind.COSINE_Z)


@pytest.mark.parametrize("heading", [-1, 7])
@pytest.mark.parametrize("kind", PLANAR)
@pytest.mark.parametrize("seed", range(20))
def test_value_matches_closed_form(kind: Kind, seed: int, heading: int) -> None:
    rng = np.random.default_rng(seed)
    row, x, height = random_row(rng, kind, heading), random_state(rng), rng.uniform(-3, 3)
    h = np.full(9, 99.0)
    value = predict_row(row, x, height, h)
    assert value == pytest.approx(closed_form(row, x, height), rel=1e-12, abs=1e-11)


@pytest.mark.parametrize("heading", [-1, 7])
@pytest.mark.parametrize("kind", PLANAR)
@pytest.mark.parametrize("seed", range(20))
def test_jacobian_matches_central_differences(kind: Kind, seed: int, heading: int) -> None:
    rng = np.random.default_rng(100 + seed)
    row, x, height = random_row(rng, kind, heading), random_state(rng), rng.uniform(-3, 3)
    h = np.full(9, 99.0)
    predict_row(row, x, height, h)
    eps = 1e-5
    numeric = np.empty(9)
    for i, unit in enumerate(np.eye(9)):
        change = closed_form(row, x + eps * unit, height) - closed_form(
            row, x - eps * unit, height
        )
        numeric[i] = (
            math.remainder(change, 2 * math.pi) / (2 * eps) if kind <= 1 else change / (2 * eps)
        )
    np.testing.assert_allclose(h, numeric, rtol=1e-6, atol=2e-8)


def test_jacobian_of_the_paper() -> None:
    """fokin2020:eq.44: DOA rows (-dy/d2, dx/d2, 0 ...), TOA rows (dx/d, dy/d, 0, 0, 1, 0)."""
    info = RsuInfo(rsu_id="r", position=np.array([1.0, 2.0, 0.0]))
    m = RsuMeasurement(
        stamp_ns=1,
        rsu_id="r",
        vue_id="v",
        fields=Field.AZIMUTH | Field.TOA,
        azimuth_var=1,
        toa_var=1,
    )
    rows = rsu_rows(m, info, rsu_axes(info), 0)
    _, H = linearise(rows, np.array([4.0, 6.0, 9.0, 9.0, 9.0, 9.0]), 0.0)
    np.testing.assert_allclose(H[0], [-4 / 25, 3 / 25, 0, 0, 0, 0], rtol=1e-14)
    np.testing.assert_allclose(H[1], [3 / 5, 4 / 5, 0, 0, 1, 0], rtol=1e-14)


def test_antenna_ahead_of_a_device_heading_north() -> None:
    """Device at (3, 2), antenna 2 m ahead of it at (3, 4): turning left moves it west, that is
    nearer by 3/5 of 2 m per rad; all kinds see the same move."""
    row = filter_rows.row(Kind.RANGE, 0.0, 1.0, lever_arm=(2.0, 0.0, 0.0))
    x, h, row[HEADING] = np.array([3.0, 2.0, 0, 0, 7.0, 0, math.pi / 2]), np.empty(7), 6
    for kind, value, gradient in (
        (Kind.RANGE, 5.0, [0.6, 0.8, 0, 0, 0, 0, -1.2]),
        (Kind.TOA, 12.0, [0.6, 0.8, 0, 0, 1, 0, -1.2]),
        (Kind.AZIMUTH, math.atan2(4, 3), [-4 / 25, 3 / 25, 0, 0, 0, 0, 8 / 25]),
    ):
        row[KIND] = kind
        assert predict_row(row, x, 0.0, h) == pytest.approx(value, rel=1e-15)
        np.testing.assert_allclose(h, gradient, rtol=1e-14, atol=1e-15)
    row[KIND], row[LEVER:BLOCKED] = Kind.RANGE, (0.0, 1.0, 0.0)  # on its left: at (2, 2)
    assert predict_row(row, x, 0.0, h) == pytest.approx(math.sqrt(8), rel=1e-15)


def test_unbiased_row_leaves_bias_states_alone() -> None:
    rng = np.random.default_rng(5)
    row, x = random_row(rng, Kind.RANGE), random_state(rng)
    row[BIAS] = row[COMMON] = -1
    h = np.full(9, 99.0)
    value = predict_row(row, x, 1.0, h)
    assert value == pytest.approx(closed_form(row, x, 1.0) - x[6] - x[8])
    np.testing.assert_array_equal(h[6:], 0.0)


@pytest.mark.parametrize("kind", DIRECTION_KINDS)
def test_directly_above_the_rsu_stays_finite(kind: Kind) -> None:
    row, h = filter_rows.row(kind, 0.0, 1.0, origin=(1.0, 2.0, 5.0)), np.zeros(6)
    value = predict_row(row, np.array([1.0, 2.0, 0, 0, 0, 0]), 1.0, h)
    expected = {
        Kind.AZIMUTH: 0.0,
        Kind.ELEVATION: -math.pi / 2,
        Kind.COSINE_Y: 0.0,
        Kind.COSINE_Z: -1,
    }
    assert value == pytest.approx(expected[kind], abs=1e-6)
    assert np.isfinite(h).all()


def test_floors_at_the_rsu_and_at_rest() -> None:
    """At the RSU itself and at standstill the gradient is 0 or finite, never NaN."""
    row, h = filter_rows.row(Kind.RANGE, 0.0, 1.0), np.zeros(6)
    assert predict_row(row, np.zeros(6), 0.0, h) == pytest.approx(1e-6)
    np.testing.assert_array_equal(h, 0.0)
    row[KIND] = Kind.AZIMUTH
    # 1e-12 m^2 floor of the squared distance: the gradient at 1 nm is 1e-9 / 1e-12.
    predict_row(row, np.array([1e-9, 0, 0, 0, 0, 0]), 0.0, h)
    np.testing.assert_allclose(h, [0, 1e3, 0, 0, 0, 0], rtol=1e-9)
    row[KIND] = Kind.SPEED
    assert predict_row(row, np.zeros(6), 0.0, h) == 0.0
    np.testing.assert_array_equal(h, 0.0)
    # 1e-6 m/s floor of the speed, in both components.
    predict_row(row, np.array([0, 0, 1e-7, 2e-7, 0, 0]), 0.0, h)
    np.testing.assert_allclose(h[VELOCITY], [0.1, 0.2], rtol=1e-9)
    predict_row(row, np.array([0, 0, 0.3, -0.4, 0, 0]), 0.0, h)
    np.testing.assert_allclose(h[VELOCITY], [0.6, -0.8], rtol=1e-14)


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (math.pi, -math.pi),
        (-math.pi, -math.pi),
        (math.pi - 1e-12, math.pi - 1e-12),
        (-math.pi - 1e-12, math.pi - 1e-12),
        (1.5 * math.pi, -0.5 * math.pi),
        (-1.5 * math.pi, 0.5 * math.pi),
        (5 * math.pi, -math.pi),
        (-5 * math.pi, -math.pi),
    ],
)
def test_wrap_at_its_boundaries(angle: float, wrapped: float) -> None:
    assert wrap(angle) == pytest.approx(wrapped, abs=1e-14)
    assert -math.pi <= wrap(angle) < math.pi


@pytest.mark.parametrize("turns", [-3, -1, 1, 3, 1001])
def test_wrap_beside_its_boundaries(turns: int) -> None:
    """Odd multiples of pi and the floats about them: within [-pi, pi), and the same angle."""
    angle = turns * math.pi
    below, above = math.nextafter(angle, -math.inf), math.nextafter(angle, math.inf)
    for a in (math.nextafter(below, -math.inf), below, angle, above):
        wrapped = wrap(a)
        assert -math.pi <= wrapped < math.pi
        assert abs(math.remainder(wrapped - a, 2 * math.pi)) <= 1e-15 * max(abs(a), 1.0)
        if -math.pi <= a < math.pi:
            assert wrapped == a


def test_only_azimuth_and_elevation_are_wrapped() -> None:
    row = np.zeros(ROW_WIDTH)
    angles = []
    for kind in Kind:
        row[KIND] = kind
        if is_angle(row):
            angles.append(kind)
    assert tuple(angles) == ANGLE_KINDS


@settings(max_examples=300, deadline=None)
@given(st.floats(-1e12, 1e12))
def test_wrap_is_the_ieee_remainder(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi <= wrapped < math.pi
    apart = math.remainder(wrapped - math.remainder(angle, 2 * math.pi), 2 * math.pi)
    assert abs(apart) <= 1e-15 * abs(angle) + 1e-14


@pytest.mark.parametrize("kind", ANGLE_KINDS)
@pytest.mark.parametrize("side", [1, -1])
def test_angle_innovation_crosses_pi(kind: Kind, side: int) -> None:
    """Measured just one side of +-pi, predicted just the other: a small innovation."""
    row, x = filter_rows.row(kind, 0.0, 1.0), np.array([-10.0, -side * 0.1, 0, 0, 0, 0])
    row[VALUE] = predict_row(row, x, 0.0, np.empty(6)) + 0.02 + side * 2 * math.pi
    innovation, _ = linearise(row[None], x, 0.0)
    assert innovation[0] == pytest.approx(0.02, abs=1e-12)


@pytest.mark.parametrize("kind", [k for k in PLANAR if k not in CYCLIC_KINDS])
def test_other_innovations_are_not_wrapped(kind: Kind) -> None:
    rng = np.random.default_rng(3)
    row, x = random_row(rng, kind), random_state(rng)
    row[VALUE] = closed_form(row, x, 0.0) + 9.0
    innovation, _ = linearise(row[None], x, 0.0)
    assert innovation[0] == pytest.approx(9.0)


def test_innovation_is_measured_minus_predicted_for_every_row() -> None:
    rng = np.random.default_rng(4)
    x = random_state(rng)
    rows = np.array([random_row(rng, kind) for kind in PLANAR])
    offsets = np.linspace(0.1, 0.8, len(rows))
    rows[:, VALUE] = [closed_form(r, x, 0.5) + o for r, o in zip(rows, offsets, strict=True)]
    innovation, H = linearise(rows, x, 0.5)
    np.testing.assert_allclose(innovation, offsets, atol=1e-11)
    for row, h in zip(rows, H, strict=True):
        single = np.empty(9)
        predict_row(row, x, 0.5, single)
        np.testing.assert_array_equal(h, single)


def test_a_kind_that_no_sensor_has_gives_no_value() -> None:
    row, h = filter_rows.row(Kind.RANGE, 0.0, 1.0, origin=(1.0, 2.0, 3.0)), np.empty(6)
    for kind in (max(Kind) + 1, 62):
        row[KIND] = kind
        assert math.isnan(predict_row(row, np.ones(6), 0.0, h))
