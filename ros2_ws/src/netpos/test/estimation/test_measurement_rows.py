"""Rows made of measurements."""

from __future__ import annotations

import math

import numpy as np
import pytest
from measurement_rows import random_info, random_state
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    KIND,
    LEVER,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
    linearise,
)
from netpos.estimation.rows import (
    WHITE,
    RowErrors,
    linear_rows,
    put_measurement,
    rsu_axes,
    rsu_place,
    rsu_rows,
    scalar_kinds,
    speed_row,
)
from netpos.estimation.state import X
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

ALL_FIELDS = Field.AZIMUTH | Field.ELEVATION | Field.TOA | Field.RANGE | Field.POSITION


@pytest.mark.parametrize("seed", range(5))
def test_axes_turn_map_vectors_into_the_rsus_axes(seed: int) -> None:
    info = random_info(np.random.default_rng(seed), AngleConvention.SPHERICAL)
    d = np.array([3.0, -1.0, 0.5])
    expected = Rotation.from_quat(info.quaternion).inv().apply(d)
    np.testing.assert_allclose(rsu_axes(info).reshape(3, 3) @ d, expected, atol=1e-13)


def full_measurement(info: RsuInfo, target: Array, clock_m: float) -> RsuMeasurement:
    """Noise-free measurement of ``target`` written with SciPy, in the convention of the RSU."""
    d = target - info.position
    ux, uy, uz = Rotation.from_quat(info.quaternion).inv().apply(d)
    r = float(np.linalg.norm(d))
    if info.angle_convention is AngleConvention.CONE:
        azimuth, elevation = math.asin(uy / r), math.asin(uz / r)
    else:
        azimuth, elevation = math.atan2(uy, ux), math.asin(uz / r)
    return RsuMeasurement(
        stamp_ns=1,
        rsu_id=info.rsu_id,
        vue_id="v",
        fields=ALL_FIELDS,
        azimuth_rad=azimuth,
        azimuth_var=0.01,
        elevation_rad=elevation,
        elevation_var=0.02,
        toa_s=(r + clock_m) / speed_of_light,
        toa_var=1e-18,
        range_m=r,
        range_var=0.25,
        position=target,
        position_cov=np.array([[2.0, 0.7, 0.1], [0.7, 1.0, 0.2], [0.1, 0.2, 3.0]]),
    )


@pytest.mark.parametrize("convention", list(AngleConvention))
@pytest.mark.parametrize("seed", range(10))
def test_noise_free_measurement_has_no_innovation(convention: AngleConvention, seed: int) -> None:
    rng = np.random.default_rng(seed)
    info, x = random_info(rng, convention), random_state(rng, 6)
    m = full_measurement(info, np.array([x[X.PX], x[X.PY], 1.5]), x[X.CLOCK])
    rows = rsu_rows(m, info, rsu_axes(info), 3)
    innovation, _ = linearise(rows, x, 1.5)
    np.testing.assert_allclose(innovation, 0.0, atol=2e-6)
    assert rows.shape == (6, ROW_WIDTH)
    assert set(rows[:, GROUP]) == {3.0}
    assert set(rows[:, BIAS]) == set(rows[:, COMMON]) == set(rows[:, HEADING]) == {-1.0}
    np.testing.assert_array_equal(rows[:, LEVER:], 0.0)


def test_spherical_rows_keep_values_and_variances() -> None:
    info = random_info(np.random.default_rng(1), AngleConvention.SPHERICAL)
    m = full_measurement(info, np.array([30.0, 20.0, 1.0]), 7.0)
    c = speed_of_light
    rows = rsu_rows(m, info, rsu_axes(info), 0)[:4]
    assert rows[:, [KIND, VALUE, VARIANCE]].tolist() == [
        [Kind.AZIMUTH, m.azimuth_rad, 0.01],
        [Kind.ELEVATION, m.elevation_rad, 0.02],
        [Kind.TOA, pytest.approx(c * m.toa_s), pytest.approx(c**2 * 1e-18)],
        [Kind.RANGE, m.range_m, 0.25],
    ]
    np.testing.assert_array_equal(rows[:, GATE_VARIANCE], rows[:, VARIANCE])


@pytest.mark.parametrize("convention", list(AngleConvention))
def test_kinds_are_those_of_the_rows(convention: AngleConvention) -> None:
    """Of every combination of scalar fields, with and without a position."""
    info = random_info(np.random.default_rng(4), convention)
    full = full_measurement(info, np.array([30.0, 20.0, 1.0]), 7.0)
    for fields in range(1, 64):
        m = RsuMeasurement(
            **{n: getattr(full, n) for n in full.__slots__} | {"fields": Field(fields)}
        )
        rows = rsu_rows(m, info, rsu_axes(info), 0)
        kinds = [Kind(int(kind)) for kind in rows[:, KIND]]
        position = [Kind.LINEAR] * 2 if fields & Field.POSITION else []
        assert kinds == [*scalar_kinds(fields, convention), *position]


def test_rows_are_put_where_they_belong() -> None:
    """Behind what is there, with every column set, and none beyond."""
    info = random_info(np.random.default_rng(5), AngleConvention.SPHERICAL)
    m = full_measurement(info, np.array([30.0, 20.0, 1.0]), 7.0)
    m.lever_arm = (0.1, -0.2, 0.3)
    rows = np.full((12, ROW_WIDTH), np.nan)
    axes = rsu_axes(info)
    end = put_measurement(rows, 3, m, (False, rsu_place(info, axes), None), 2, 6)
    assert end == 9
    assert np.isnan(rows[:3]).all()
    assert np.isnan(rows[end:]).all()
    np.testing.assert_array_equal(rows[3:end], rsu_rows(m, info, axes, 2, heading=6))
    assert np.isfinite(rows[3:end]).all()
    np.testing.assert_array_equal(rows[3:end, LEVER : LEVER + 3], [m.lever_arm] * 6)
    np.testing.assert_array_equal(rows[3:end, HEADING], 6)
    np.testing.assert_array_equal(rows[3:7, ORIGIN:AXES], [info.position] * 4)
    np.testing.assert_array_equal(rows[3:7, AXES:HEADING], [axes] * 4)


def test_cone_variance_is_that_of_the_sine() -> None:
    """sd of sin(a) by sampling; at end-fire the second-order term remains."""
    rng = np.random.default_rng(2)
    info = random_info(rng, AngleConvention.CONE)
    for angle in (0.0, 0.6, -1.2, math.pi / 2):
        m = RsuMeasurement(
            stamp_ns=1,
            rsu_id="r",
            vue_id="v",
            fields=Field.AZIMUTH | Field.ELEVATION,
            azimuth_rad=angle,
            azimuth_var=4e-4,
            elevation_rad=-angle,
            elevation_var=1e-4,
        )
        rows = rsu_rows(m, info, rsu_axes(info), 0)
        (kind_y, y, var_y), (kind_z, z, var_z) = rows[:, [KIND, VALUE, VARIANCE]].tolist()
        assert (kind_y, kind_z) == (Kind.COSINE_Y, Kind.COSINE_Z)
        assert (y, z) == (pytest.approx(math.sin(angle)), pytest.approx(-math.sin(angle)))
        sampled = np.sin(angle + 0.02 * rng.normal(size=400_000)).var()
        assert var_y == pytest.approx(sampled, rel=0.01)
        assert var_z == pytest.approx(
            np.sin(angle + 0.01 * rng.normal(size=400_000)).var(), rel=0.01
        )


@pytest.mark.parametrize(
    ("flag", "kind"),
    [
        (Field.AZIMUTH, Kind.AZIMUTH),
        (Field.ELEVATION, Kind.ELEVATION),
        (Field.TOA, Kind.TOA),
        (Field.RANGE, Kind.RANGE),
        (Field.POSITION, Kind.LINEAR),
    ],
)
def test_only_named_fields_become_rows(flag: Field, kind: Kind) -> None:
    info = random_info(np.random.default_rng(1), AngleConvention.SPHERICAL)
    full = full_measurement(info, np.array([30.0, 20.0, 1.0]), 7.0)
    m = RsuMeasurement(**{n: getattr(full, n) for n in full.__slots__} | {"fields": flag})
    rows = rsu_rows(m, info, rsu_axes(info), 0)
    assert set(rows[:, KIND]) == {float(kind)}
    assert len(rows) == (2 if kind is Kind.LINEAR else 1)


def test_errors_enter_their_rows_only() -> None:
    info = random_info(np.random.default_rng(1), AngleConvention.SPHERICAL)
    m = full_measurement(info, np.array([30.0, 20.0, 1.0]), 7.0)
    azimuth, distance = RowErrors(bias=6, inflation=3.0), RowErrors(common=7, inflation=5.0)
    rows = rsu_rows(m, info, rsu_axes(info), 0, [azimuth, WHITE, WHITE, distance])
    np.testing.assert_array_equal(rows[:, BIAS], [6, -1, -1, -1, -1, -1])
    np.testing.assert_array_equal(rows[:, COMMON], [-1, -1, -1, 7, -1, -1])
    np.testing.assert_allclose(
        rows[:4, GATE_VARIANCE], [0.01, 0.02, speed_of_light**2 * 1e-18, 0.25]
    )
    np.testing.assert_allclose(rows[:4, VARIANCE], [0.03, 0.02, speed_of_light**2 * 1e-18, 1.25])


def test_what_a_distance_is_too_long_by_is_taken_out() -> None:
    info = random_info(np.random.default_rng(1), AngleConvention.SPHERICAL)
    m = full_measurement(info, np.array([30.0, 20.0, 1.0]), 7.0)
    plain = rsu_rows(m, info, rsu_axes(info), 0, [WHITE] * 4)
    found = rsu_rows(m, info, rsu_axes(info), 0, [WHITE, WHITE, WHITE, RowErrors(stretch=0.07)])
    assert found[3, VALUE] == pytest.approx(plain[3, VALUE] / 1.07)
    np.testing.assert_array_equal(np.delete(found, 3, axis=0), np.delete(plain, 3, axis=0))


@pytest.mark.parametrize("seed", range(5))
def test_linear_rows_equal_the_update_with_the_full_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(6, 6))
    R, P = A @ A.T + 0.1 * np.eye(3), B @ B.T + 0.1 * np.eye(6)
    H, z, x = rng.normal(size=(3, 6)), rng.normal(size=3), rng.normal(size=6)
    rows = linear_rows(z, R, H, 4)
    no_gate = np.full(5, np.inf)
    rows[:, GROUP] = 0
    mean, cov, accepted = x.copy(), P.copy(), np.full(1, 9.0)
    nis, used = ekf.update(mean, cov, rows, 0.0, no_gate, 1, accepted, ekf.workspace(6, 3))
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(mean, x + K @ (z - H @ x), rtol=1e-9)
    np.testing.assert_allclose(cov, P - K @ S @ K.T, rtol=1e-8, atol=1e-10)
    assert nis == pytest.approx((z - H @ x) @ np.linalg.solve(S, z - H @ x), rel=1e-9)
    assert used == 3
    assert accepted.tolist() == [1.0]


def test_linear_rows_fill_the_whole_row() -> None:
    rows = linear_rows(np.array([1.0, 2.0]), np.diag([4.0, 9.0]), np.eye(2, 6, k=2), 5)
    np.testing.assert_array_equal(rows[:, GROUP], 5)
    np.testing.assert_array_equal(rows[:, KIND], Kind.LINEAR)
    np.testing.assert_array_equal(rows[:, [VARIANCE, GATE_VARIANCE]], 1.0)
    np.testing.assert_array_equal(rows[:, [BIAS, COMMON, HEADING]], -1.0)
    np.testing.assert_allclose(rows[:, VALUE], [0.5, 2 / 3])
    np.testing.assert_allclose(
        rows[:, ORIGIN : ORIGIN + 6], [[0, 0, 1 / 2, 0, 0, 0], [0, 0, 0, 1 / 3, 0, 0]]
    )


def test_linear_rows_refuse_a_covariance_that_is_none() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        linear_rows(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]), np.eye(2, 6), 0)


def test_speed_row() -> None:
    (row,) = speed_row(3.0, 0.04, 2)
    assert row.tolist() == [Kind.SPEED, 3.0, 0.04, 0.04, -1, -1, 2, *([0.0] * 12), -1, *([0] * 8)]
