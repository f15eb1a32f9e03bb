"""Positions behind range and phase: against the rows' own model, and by simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.fixes.phase_fix import (
    admissible,
    init_hypothesis,
    nearest_turns,
    phase_scale,
    place,
    to_fix,
)
from netpos.estimation.measurement import (
    BIAS,
    COMMON,
    GATE_VARIANCE,
    HEADING,
    KIND,
    LEVER,
    VALUE,
    VARIANCE,
    Kind,
    predict_row,
)
from netpos.estimation.measurement import HEIGHT as ROW_HEIGHT
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.state import POSITION, VELOCITY
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from scipy.spatial.transform import Rotation

HEIGHT = 1.2
WAVELENGTH = 0.05


def anchor(turn_deg: float = 35.0, wavelengths: float = 4.0) -> RsuInfo:
    return RsuInfo(
        rsu_id="a",
        position=np.array([1.0, -2.0, 2.5]),
        quaternion=Rotation.from_euler("z", turn_deg, degrees=True).as_quat(),
        baseline_m=wavelengths * WAVELENGTH,
        wavelength_m=WAVELENGTH,
    )


def rows_of(info: RsuInfo, xy: Array, lever_m: float = 0.0) -> Array:
    """Noise-free range and phase of a device whose antenna is ``lever_m`` above its origin."""
    measured = RsuMeasurement(
        stamp_ns=1,
        rsu_id="a",
        vue_id="v",
        fields=Field.RANGE | Field.PHASE,
        range_var=0.03**2,
        phase_difference_var=0.1**2,
    )
    rows = rsu_rows(measured, info, rsu_axes(info), 0)
    state = np.array([*xy, 0.0, 0.0, 0.0, 0.0])
    rows[:, LEVER + 2] = lever_m
    for row in rows:
        row[VALUE] = predict_row(row, state, HEIGHT, np.empty(6))
    return rows


def in_front(info: RsuInfo, ahead: float, right: float) -> Array:
    """Position so far ahead of the anchor and to the right of its boresight."""
    x, y, _ = Rotation.from_quat(info.quaternion).apply([ahead, -right, 0.0])
    return info.position[:2] + np.array([x, y])


def wrapped(rows: Array) -> tuple[Array, int]:
    """Rows with the phase in [-pi, pi), and the turns taken off."""
    turns = math.floor((rows[1, VALUE] + math.pi) / (2 * math.pi))
    rows[1, VALUE] -= 2 * math.pi * turns
    return rows, turns


@pytest.mark.parametrize("ahead", [1.0, 4.0, 9.0])
@pytest.mark.parametrize("right", [-4.0, -0.3, 0.0, 2.0])
def test_the_place_is_the_one_measured_from(ahead: float, right: float) -> None:
    info = anchor()
    xy = in_front(info, ahead, right)
    rows, turns = wrapped(rows_of(info, xy))
    point, cov = np.empty(2), np.empty((2, 2))
    assert place(rows[0], rows[1], turns, HEIGHT, point, cov)
    np.testing.assert_allclose(point, xy, atol=1e-9)


@pytest.mark.parametrize("turns", range(-5, 6))
def test_every_sector_explains_range_and_phase(turns: int) -> None:
    """K = 2 floor(L / lambda) + 1 sectors of petukhov:eq.11 for a phase around 0."""
    info = anchor()
    rows, _ = wrapped(rows_of(info, in_front(info, 5.0, 0.01)))
    point, cov = np.empty(2), np.empty((2, 2))
    found = place(rows[0], rows[1], turns, 2.5, point, cov)
    assert found == (abs(turns) <= 4)
    if found and abs(turns) < 4:  # beyond, the noise hides the angle
        again = rows_of(info, point)
        state = np.array([*point, 0.0, 0.0, 0.0, 0.0])
        assert predict_row(rows[0], state, 2.5, np.empty(6)) == pytest.approx(rows[0, VALUE])
        phase = predict_row(rows[1], state, 2.5, np.empty(6))
        assert phase == pytest.approx(rows[1, VALUE] + 2 * math.pi * turns)
        assert len(again) == 2
        ahead = Rotation.from_quat(info.quaternion).inv().apply([*(point - info.position[:2]), 0])
        assert ahead[0] > 0.0


def test_the_covariance_is_that_of_noisy_measurements() -> None:
    info, rng = anchor(), np.random.default_rng(3)
    xy = in_front(info, 4.0, 2.0)
    rows, turns = wrapped(rows_of(info, xy))
    stated, points, spare = np.empty((2, 2)), np.empty((20000, 2)), np.empty((2, 2))
    assert place(rows[0], rows[1], turns, HEIGHT, points[0], stated)
    for point in points:
        noisy = rows.copy()
        noisy[:, VALUE] += rng.normal(size=2) * [0.03, 0.1]
        assert place(noisy[0], noisy[1], turns, HEIGHT, point, spare)
    np.testing.assert_allclose(np.cov(points.T), stated, rtol=0.05, atol=1e-6)
    assert np.hypot(*(points.mean(axis=0) - xy)) < 3e-3


@pytest.mark.parametrize(("ahead", "right"), [(4.0, 2.0), (3.0, -2.5), (6.0, 0.5)])
def test_the_covariance_is_that_of_small_errors(ahead: float, right: float) -> None:
    """By central differences, of an antenna above the device's origin."""
    info = anchor()
    rows, turns = wrapped(rows_of(info, in_front(info, ahead, right), lever_m=0.4))
    point, stated, spare = np.empty(2), np.empty((2, 2)), np.empty((2, 2))
    assert place(rows[0], rows[1], turns, HEIGHT, point, stated)
    np.testing.assert_allclose(point, in_front(info, ahead, right), atol=1e-9)
    slopes = np.empty((2, 2))
    for i in range(2):
        ends = np.empty((2, 2))
        for end, step in zip(ends, (1e-5, -1e-5), strict=True):
            near = rows.copy()
            near[i, VALUE] += step
            assert place(near[0], near[1], turns, HEIGHT, end, spare)
        slopes[:, i] = (ends[0] - ends[1]) / 2e-5
    expected = slopes @ np.diag(rows[:, VARIANCE]) @ slopes.T
    np.testing.assert_allclose(stated, expected, rtol=2e-3, atol=1e-7)


def test_biases_and_a_heading_among_the_states_do_not_move_the_place() -> None:
    info = anchor()
    rows, turns = wrapped(rows_of(info, in_front(info, 4.0, 2.0)))
    points, covs = np.empty((2, 2)), np.empty((2, 2, 2))
    for point, cov in zip(points, covs, strict=True):
        assert place(rows[0], rows[1], turns, HEIGHT, point, cov)
        rows[:, [BIAS, COMMON, HEADING]] = 6, 7, 8
    np.testing.assert_array_equal(points[0], points[1])
    np.testing.assert_array_equal(covs[0], covs[1])


def test_the_scale_is_the_baseline_in_radians_however_it_hangs() -> None:
    info = anchor()
    for angles in ((35.0, 0.0, 0.0), (35.0, 20.0, -50.0)):
        info.quaternion[:] = Rotation.from_euler("zyx", angles, degrees=True).as_quat()
        assert phase_scale(rows_of(info, np.array([4.0, 4.0]))[1]) == pytest.approx(8.0 * math.pi)


def test_no_place_inside_the_array_or_above_it() -> None:
    info = anchor()
    rows = rows_of(info, in_front(info, 4.0, 0.0))
    point, cov = np.empty(2), np.empty((2, 2))
    rows[0, VALUE] = 0.05
    assert not place(rows[0], rows[1], 0, HEIGHT, point, cov)
    rows[0, VALUE] = 1.29  # the height difference is 1.3 m
    assert not place(rows[0], rows[1], 0, HEIGHT, point, cov)


def test_turns_end_three_sd_beyond_end_fire() -> None:
    phase = rows_of(anchor(), np.array([4.0, 4.0]))[1]
    edge = 8 * math.pi + 0.3
    for value, turns, expected in (
        (edge - 8 * math.pi - 1e-9, 4, True),
        (edge - 8 * math.pi + 1e-9, 4, False),
        (-edge + 8 * math.pi + 1e-9, -4, True),
        (-edge + 8 * math.pi - 1e-9, -4, False),
    ):
        phase[VALUE] = value
        assert admissible(phase, turns) is expected


def test_the_nearest_turns_stay_admissible() -> None:
    phase = rows_of(anchor(), np.array([4.0, 4.0]))[1]
    phase[VALUE] = 1.0
    assert [nearest_turns(phase, 2 * math.pi * x) for x in (-2.6, -0.4, 0.4, 1.6)] == [-3, 0, 0, 2]
    assert nearest_turns(phase, 100.0) == 3  # 1 + 8 pi lies beyond
    assert nearest_turns(phase, -100.0) == -4


def test_spawn_opens_the_velocity_and_keeps_the_rest() -> None:
    info = anchor()
    xy = in_front(info, 4.0, 2.0)
    rows, turns = wrapped(rows_of(info, xy))
    mean, rng = np.arange(8.0), np.random.default_rng(1)
    A = rng.normal(size=(8, 8))
    cov = A @ A.T
    rest = cov[4:, 4:].copy()
    area = init_hypothesis(mean, cov, rows[0], rows[1], turns, 1.5, HEIGHT)
    np.testing.assert_allclose(mean, [*xy, 0.0, 0.0, 4.0, 5.0, 6.0, 7.0], atol=1e-9)
    np.testing.assert_array_equal(cov[4:, 4:], rest)
    np.testing.assert_array_equal(cov[:4, 4:], 0.0)
    np.testing.assert_array_equal(cov[VELOCITY, VELOCITY], 2.25 * np.eye(2))
    assert area == pytest.approx(0.5 * math.log(np.linalg.det(cov[POSITION, POSITION])))
    before = mean.copy()
    assert init_hypothesis(mean, cov, rows[0], rows[1], 9, 1.5, HEIGHT) == -math.inf
    np.testing.assert_array_equal(mean, before)


def test_a_fix_as_linear_rows_has_its_place_and_covariance() -> None:
    info = anchor()
    xy = in_front(info, 4.0, 2.0)
    rows, turns = wrapped(rows_of(info, xy))
    point, cov = np.empty(2), np.empty((2, 2))
    place(rows[0], rows[1], turns, HEIGHT, point, cov)
    rows[1, VALUE] += 2 * math.pi * turns
    others = np.full((2, rows.shape[1]), 7.0)
    rows = np.vstack([others, rows])
    assert to_fix(rows, 3, np.zeros(6), HEIGHT)
    np.testing.assert_array_equal(rows[:2], others)
    rows = rows[2:]
    assert rows[:, KIND].tolist() == [Kind.LINEAR, Kind.LINEAR]
    assert (rows[:, [VARIANCE, GATE_VARIANCE]] == 1.0).all()
    H, h = np.empty((2, 6)), np.empty(6)
    for i in range(2):
        predict_row(rows[i], np.zeros(6), HEIGHT, h)
        H[i] = h
    np.testing.assert_allclose(np.linalg.solve(H[:, :2], rows[:, VALUE]), xy, atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(H[:, :2].T @ H[:, :2]), cov, rtol=1e-9)
    np.testing.assert_array_equal(H[:, 2:], 0.0)


def with_height(info: RsuInfo, xy: Array) -> tuple[Array, int]:
    """``wrapped`` rows of a device whose height over ``HEIGHT`` is the state 6."""
    rows, turns = wrapped(rows_of(info, xy))
    rows[:, ROW_HEIGHT] = 6.0
    return rows, turns


def place_at(rows: Array, turns: int, height_m: float) -> Array:
    point = np.empty(2)
    assert place(rows[0], rows[1], turns, height_m, point, np.empty((2, 2)))
    return point


def by_height(rows: Array, turns: int, above_m: float) -> Array:
    """Derivative of the place by height, by differences."""
    at, eps = HEIGHT + above_m, 1e-5
    change = place_at(rows, turns, at + eps) - place_at(rows, turns, at - eps)
    slope: Array = change / (2.0 * eps)
    return slope


def test_a_hypothesis_moves_with_an_unknown_height() -> None:
    info = anchor()
    rows, turns = with_height(info, in_front(info, 4.0, 1.5))
    mean, cov = np.zeros(7), np.eye(7)
    mean[6], cov[6, 6] = 0.3, 0.25
    area = init_hypothesis(mean, cov, rows[0], rows[1], turns, 1.5, HEIGHT)
    own = np.empty((2, 2))
    place(rows[0], rows[1], turns, HEIGHT + 0.3, np.empty(2), own)
    slope = by_height(rows, turns, 0.3)
    np.testing.assert_allclose(mean[:2], place_at(rows, turns, HEIGHT + 0.3), atol=1e-12)
    assert (mean[6], cov[6, 6]) == (0.3, 0.25)
    np.testing.assert_allclose(cov[:2, 6], 0.25 * slope, rtol=1e-6)
    expected = own + 0.25 * np.outer(slope, slope)
    np.testing.assert_allclose(cov[:2, :2], expected, rtol=1e-6)
    assert area == pytest.approx(0.5 * math.log(np.linalg.det(expected)), rel=1e-6)


def test_a_fix_holds_how_it_moves_with_the_height() -> None:
    """Its rows, at another height: as if the place were found there, to first order."""
    info = anchor()
    rows, turns = with_height(info, in_front(info, 4.0, -1.0))
    rows[1, VALUE] += 2.0 * math.pi * turns
    slope, H = by_height(rows, 0, 0.3), np.empty((2, 7))
    at, cov = place_at(rows, 0, HEIGHT + 0.3), np.empty((2, 2))
    place(rows[0], rows[1], 0, HEIGHT + 0.3, np.empty(2), cov)
    mean = np.array([*at, 0.0, 0.0, 0.0, 0.0, 0.3])
    assert to_fix(rows, 1, mean, HEIGHT)
    for above_m in (0.3, 0.5):
        moved = np.array([*(at + (above_m - 0.3) * slope), 0.0, 0.0, 0.0, 0.0, above_m])
        for row, h in zip(rows, H, strict=True):
            assert row[VALUE] == pytest.approx(predict_row(row, moved, 99.0, h), rel=1e-9)
    information = np.linalg.inv(cov)
    np.testing.assert_allclose(H[:, :2].T @ H[:, :2], information, rtol=1e-9)
    np.testing.assert_allclose(H[:, :2].T @ H[:, 6], -information @ slope, rtol=1e-6)
