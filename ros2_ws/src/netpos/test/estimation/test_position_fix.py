"""Least-squares fixes in space against SciPy and Monte Carlo, and what they refuse."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.fixes.position_fix import FixStatus, _invert, fix_position, start_of
from netpos.estimation.measurement import GROUP, KIND, ROW_WIDTH, VALUE, VARIANCE, Kind
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.spatial.space import place_rows, value_at
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

SD = {"azimuth": math.radians(8.5), "elevation": math.radians(2.5), "range": 1.0}


def rows_at(
    place: Array,
    stations: Array,
    fields: Field,
    rng: np.random.Generator | None,
    turn: Rotation | None = None,
) -> Array:
    """Rows of stations (m, 3) with the noise of deng2022, none without ``rng``."""
    blocks = []
    quaternion = (turn or Rotation.identity()).as_quat()
    for i, station in enumerate(stations):
        info = RsuInfo(rsu_id=f"s{i}", position=station, quaternion=quaternion)
        d = Rotation.from_quat(quaternion).inv().apply(place - station)
        noise = np.zeros(3) if rng is None else rng.normal(size=3)
        m = RsuMeasurement(
            stamp_ns=1,
            rsu_id=info.rsu_id,
            vue_id="v",
            fields=fields,
            azimuth_rad=math.remainder(
                math.atan2(d[1], d[0]) + SD["azimuth"] * noise[0], math.tau
            ),
            azimuth_var=SD["azimuth"] ** 2,
            elevation_rad=math.atan2(d[2], math.hypot(d[0], d[1])) + SD["elevation"] * noise[1],
            elevation_var=SD["elevation"] ** 2,
            range_m=float(np.linalg.norm(d)) + noise[2],
            range_var=1.0,
            toa_s=(float(np.linalg.norm(d)) + noise[2] + CLOCK_M) / SPEED_OF_LIGHT_MPS,
            toa_var=SPEED_OF_LIGHT_MPS**-2,
        )
        blocks.append(rsu_rows(m, info, rsu_axes(info), i))
    return np.vstack(blocks)


CLOCK_M = 20_000.0
"""Offset of the device's clock, which nobody knows."""
ALL = Field.AZIMUTH | Field.ELEVATION | Field.RANGE
TIMES = Field.AZIMUTH | Field.ELEVATION | Field.TOA
CORNERS = np.array([[0.0, 0, 8], [100, 0, 12], [0, 100, 6], [100, 100, 14], [200, 0, 9]])
PLACE = np.array([35.0, 60.0, 1.5])


@pytest.mark.parametrize(("fields", "n"), [(Field.RANGE, 4), (ALL, 4), (ALL, 2), (ALL, 1)])
def test_without_noise_the_fix_is_the_place(fields: Field, n: int) -> None:
    rows = rows_at(PLACE, CORNERS[:n], fields, None, Rotation.from_euler("ZYX", [2.0, 0.1, 0.2]))
    fix = fix_position(rows, start_of(rows, 0.0))
    assert fix.status == FixStatus.CONVERGED
    np.testing.assert_allclose(fix.position, PLACE, atol=1e-4)


def test_the_clock_of_times_of_arrival_is_a_fourth_unknown() -> None:
    """SciPy's least squares with the clock among its unknowns: place, and covariance of it."""
    rng = np.random.default_rng(9)
    for _ in range(10):
        place = rng.uniform([0, 0, 0], [100, 100, 3])
        rows = rows_at(place, CORNERS[:4], TIMES, rng)

        def residuals(x: Array, rows: Array = rows) -> Array:
            values = []
            for row in rows:
                value = value_at(row, *x[:3])[0] + (x[3] if row[KIND] == Kind.TOA else 0.0)
                difference = row[VALUE] - value
                if row[KIND] != Kind.TOA:
                    difference = math.remainder(difference, math.tau)
                values.append(difference / math.sqrt(row[VARIANCE]))
            return np.array(values)

        found = least_squares(residuals, [*place, CLOCK_M], xtol=1e-15, ftol=1e-15)
        fix = fix_position(rows, start_of(rows, 0.0))
        assert fix.status == FixStatus.CONVERGED
        np.testing.assert_allclose(fix.position, found.x[:3], atol=2e-2)
        expected = np.linalg.inv(found.jac.T @ found.jac)[:3, :3]
        np.testing.assert_allclose(fix.cov, expected, rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize(("fields", "n"), [(TIMES, 4), (TIMES, 2), (Field.TOA, 5)])
def test_without_noise_times_give_the_place(fields: Field, n: int) -> None:
    rows = rows_at(PLACE, CORNERS[:n], fields, None, Rotation.from_euler("ZYX", [2.0, 0.1, 0.2]))
    fix = fix_position(rows, start_of(rows, 0.0))
    assert fix.status == FixStatus.CONVERGED
    np.testing.assert_allclose(fix.position, PLACE, atol=1e-3)


def test_a_clock_far_off_costs_no_digits() -> None:
    """Three seconds, 1e9 m: fixes, steps and covariance as without."""
    rng = np.random.default_rng(11)
    for _ in range(10):
        near = rows_at(rng.uniform([0, 0, 0], [100, 100, 3]), CORNERS[:4], TIMES, rng)
        far = near.copy()
        far[near[:, KIND] == Kind.TOA, VALUE] += 1e9
        fix, other = (fix_position(rows, np.full(3, 50.0)) for rows in (near, far))
        assert (fix.status, fix.iterations) == (FixStatus.CONVERGED, other.iterations)
        np.testing.assert_allclose(fix.position, other.position, atol=1e-5)
        np.testing.assert_allclose(fix.cov, other.cov, rtol=1e-5)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_matrix_without_inverse_is_told_from_one_with(scale: float) -> None:
    """Sums of two and of three squares, their axes of very different size."""
    rng = np.random.default_rng(12)
    for k in range(60):
        H, found = rng.normal(size=(3, 3)), np.empty((3, 3))
        H[:, k % 3] *= scale
        assert not _invert(H[:2].T @ H[:2], found)
        assert _invert(H.T @ H, found)
        size = np.sqrt(np.diag(np.linalg.inv(H.T @ H)))
        outer = np.outer(size, size)
        np.testing.assert_allclose(found / outer, np.linalg.inv(H.T @ H) / outer, atol=1e-6)


def test_the_last_iteration_counts() -> None:
    """From ever further away, 50 m a step: a hundred settle, no more."""
    rows = place_rows(PLACE, np.eye(3), (0.0, 0.0, 0.0))
    for distance, status in ((4940.0, FixStatus.CONVERGED), (4960.0, FixStatus.NOT_CONVERGED)):
        fix = fix_position(rows, PLACE + np.array([distance, 0.0, 0.0]))
        assert (fix.status, fix.iterations) == (status, 100)


def test_one_station_without_a_clock_gives_no_fix() -> None:
    rows = rows_at(PLACE, CORNERS[:1], TIMES, None)
    assert fix_position(rows, start_of(rows, 0.0)).status == FixStatus.TOO_FEW


def test_fix_is_the_weighted_least_squares_of_scipy() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        place = rng.uniform([0, 0, 0], [100, 100, 3])
        rows = rows_at(place, CORNERS[:3], ALL, rng)

        def residuals(p: Array, rows: Array = rows) -> Array:
            values = []
            for row, kind in zip(rows, "aer" * 3, strict=True):
                d = p - row[7:10]
                predicted = {
                    "a": math.atan2(d[1], d[0]),
                    "e": math.atan2(d[2], math.hypot(d[0], d[1])),
                    "r": math.hypot(*d),
                }[kind]
                difference = row[VALUE] - predicted
                wrapped = difference if kind == "r" else math.remainder(difference, math.tau)
                values.append(wrapped / math.sqrt(row[VARIANCE]))
            return np.array(values)

        fix = fix_position(rows, start_of(rows, 0.0))
        best = least_squares(residuals, place, xtol=1e-12, ftol=1e-12)
        assert fix.status == FixStatus.CONVERGED
        np.testing.assert_allclose(fix.position, best.x, atol=5e-3)
        cov = np.linalg.inv(best.jac.T @ best.jac)
        np.testing.assert_allclose(fix.cov, cov, rtol=0.02, atol=0.01)


def test_covariance_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(4)
    errors, normed = [], []
    for _ in range(500):
        rows = rows_at(PLACE, CORNERS[:4], ALL, rng)
        fix = fix_position(rows, start_of(rows, 0.0))
        errors.append(fix.position - PLACE)
        normed.append(errors[-1] @ np.linalg.solve(fix.cov, errors[-1]))
    assert np.mean(normed) == pytest.approx(3.0, abs=4 * math.sqrt(6 / 500))


def test_angles_count_by_their_radians() -> None:
    """One station, 40 m away: across the line of sight the error is the distance times the
    azimuth's."""
    rows = rows_at(np.array([40.0, 0.0, 0.0]), np.zeros((1, 3)), ALL, None)
    fix = fix_position(rows, start_of(rows, 0.0))
    sds = [SD["range"], 40 * SD["azimuth"], 40 * SD["elevation"]]
    np.testing.assert_allclose(np.sqrt(np.diag(fix.cov)), sds, rtol=1e-6)


def test_two_ranges_are_too_few() -> None:
    rows = rows_at(PLACE, CORNERS[:2], Field.RANGE, None)
    assert fix_position(rows, start_of(rows, 0.0)).status == FixStatus.TOO_FEW
    assert fix_position(np.empty((0, ROW_WIDTH)), np.zeros(3)).status == FixStatus.TOO_FEW


def test_stations_in_one_line_leave_the_position_open() -> None:
    line = np.column_stack([[0.0, 50.0, 90.0, 140.0], np.zeros(4), np.full(4, 10.0)])
    rows = rows_at(PLACE, line, Field.RANGE, None)
    fix = fix_position(rows, start_of(rows, 10.0))
    assert fix.status == FixStatus.GEOMETRY
    assert np.isfinite(fix.position).all()


def test_one_height_of_all_stations_leaves_the_height_open() -> None:
    """Started in their plane no range tells up from down."""
    flat = CORNERS.copy()
    flat[:, 2] = 10.0
    rows = rows_at(PLACE, flat, Field.RANGE, None)
    fix = fix_position(rows, np.array([30.0, 50.0, 10.0]))
    assert fix.status == FixStatus.GEOMETRY
    assert np.isfinite(fix.position).all()


def test_a_height_known_to_kilometres_is_no_fix() -> None:
    """A tenth of a millimetre below the plane of the stations: regular, and of no use."""
    flat = CORNERS.copy()
    flat[:, 2] = 10.0
    place = np.array([35.0, 60.0, 9.9999])
    rows = rows_at(place, flat, Field.RANGE, None)
    fix = fix_position(rows, place)
    assert fix.status == FixStatus.GEOMETRY
    assert np.sqrt(fix.cov[2, 2]) > 1e3


def test_a_device_in_the_west_is_not_torn_apart() -> None:
    """Azimuths of two stations on either side of the wrap, each on its own side of the truth."""
    place = np.array([-60.0, 0.0, 1.0])
    stations = np.array([[0.0, 1.0, 9.0], [30.0, -1.0, 8.0]])
    rows = rows_at(place, stations, ALL, None)
    rows[0, VALUE], rows[3, VALUE] = math.pi - 0.05, -math.pi + 0.05
    fix = fix_position(rows, start_of(rows, 0.0))
    assert fix.status == FixStatus.CONVERGED
    assert np.linalg.norm(fix.position - place) < 4.0


@pytest.mark.parametrize("seed", [6, 32, 40, 58])
def test_steps_that_overshoot_are_halved(seed: int) -> None:
    """Noisy ranges with an open height, on which full Gauss-Newton steps run for ever."""
    rows = rows_at(PLACE, CORNERS, Field.RANGE, np.random.default_rng(seed))
    fix = fix_position(rows, start_of(rows, 0.0))
    assert fix.status == FixStatus.CONVERGED

    def residuals(p: Array) -> Array:
        return np.asarray(np.linalg.norm(p - rows[:, 7:10], axis=1) - rows[:, VALUE])

    best = least_squares(
        residuals, fix.position - np.array([0.0, 0.0, 1.0]), xtol=1e-12, ftol=1e-12
    )
    np.testing.assert_allclose(fix.position, best.x, atol=0.05)


def test_a_fix_that_does_not_settle_says_so() -> None:
    """Ranges 30 m too short to three stations: the best point lies in their plane, where the
    height has no gradient, so that no step finds it."""
    rows = rows_at(PLACE, CORNERS[:3], Field.RANGE, None)
    rows[:, VALUE] -= 30.0
    assert fix_position(rows, start_of(rows, 0.0)).status in (
        FixStatus.NOT_CONVERGED,
        FixStatus.GEOMETRY,
    )


def test_a_known_height_closes_the_geometry() -> None:
    flat = CORNERS.copy()
    flat[:, 2] = 10.0
    rows = rows_at(PLACE, flat, Field.RANGE, None)
    known = place_rows(np.array([0.0, 0.0, 1.5]), np.diag([1e8, 1e8, 1.0]), (0.0, 0.0, 0.0))
    fix = fix_position(np.vstack([rows, known]), np.array([30.0, 50.0, 1.5]))
    assert fix.status == FixStatus.CONVERGED
    np.testing.assert_allclose(fix.position, PLACE, atol=0.01)


def test_start_follows_the_nearest_station_with_angles() -> None:
    rows = rows_at(PLACE, CORNERS, ALL, None, Rotation.from_euler("z", 1.0))
    nearest = np.linalg.norm(CORNERS - PLACE, axis=1).argmin()
    rows[(rows[:, KIND] == Kind.AZIMUTH) & (rows[:, GROUP] != nearest), VALUE] += 0.5
    np.testing.assert_allclose(start_of(rows, 0.0), PLACE, atol=1e-9)
    west = rows[[0, 1, 8]]  # angles of one station, the range of another north of it
    np.testing.assert_allclose(start_of(west, 2.0), [*CORNERS[2, :2], 2.0], atol=1e-9)
    ranges = rows_at(PLACE, CORNERS, Field.RANGE, None)
    np.testing.assert_allclose(start_of(ranges, 2.0), [80.0, 40.0, 2.0], atol=1e-9)
