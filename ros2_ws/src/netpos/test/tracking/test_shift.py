"""What a shift of the position leaves of residuals, against places that are known."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.measurement import ROW_WIDTH, VALUE, linearise
from netpos.estimation.rows import put_measurement
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking.rsus.rsu import Rsu
from netpos.tracking.rsus.shift import DeviceState, Way, unshifted
from numpy.typing import NDArray

PLACE = np.array([2.4, 3.6, 0.0, 0.0, 0.0, 0.0])
WALLS = [(0.0, 3.0, 0.0), (6.0, 0.0, 90.0), (12.0, 3.0, 180.0), (6.0, 6.0, -90.0)]
SD = np.full(8, 0.1)


def rows_of(biases: Array) -> Array:
    """(8, ROW_WIDTH): what four arrays on the walls of a room measure at ``PLACE``, with errors
    (8,) of their direction cosines."""
    rows = np.zeros((8, ROW_WIDTH))
    for i, (x, y, facing) in enumerate(WALLS):
        half = np.radians(facing) / 2.0
        rsu = Rsu.of(
            RsuInfo(
                rsu_id=f"a{i}",
                position=np.array([x, y, 2.3]),
                quaternion=np.array([0.0, 0.0, np.sin(half), np.cos(half)]),
                angle_convention=AngleConvention.CONE,
            )
        )
        m = RsuMeasurement(
            stamp_ns=1,
            rsu_id=f"a{i}",
            vue_id="vue_1",
            fields=Field.AZIMUTH | Field.ELEVATION,
            azimuth_var=0.01,
            elevation_var=0.01,
        )
        put_measurement(rows, 2 * i, m, (rsu.cone, rsu.place, None), i, -1)
    at_place, _ = linearise(rows, PLACE, 1.1)
    rows[:, VALUE] += biases - at_place
    return rows


def at(place: Array, stamp_ns: int = 0, velocity_sd: float = 0.0) -> DeviceState:
    """Of a device at ``place`` (6,), with 0.5 m/s^2/sqrt(Hz)."""
    cov = np.diag([0.0, 0.0, velocity_sd**2, velocity_sd**2, 0.0, 0.0])
    return DeviceState(stamp_ns, place, cov, 1.1, 0.5)


def one_instant(rows: Array, believed: Array) -> Way:
    """Of a device whose values (m, ROW_WIDTH) were all heard at one instant."""
    there = at(believed)
    return Way.of(rows, alone(len(rows)), [(0, len(rows))], np.zeros((1, 3)), (there, there))


def alone(n: int) -> tuple[NDArray[np.int64], Array]:
    """Means of one value each."""
    return np.arange(n), np.ones(n)


def one_each(stamps_ns: Array) -> list[tuple[int, int]]:
    """Instants with one row."""
    return [(int(stamp_ns), 1) for stamp_ns in stamps_ns]


def left_of(biases: Array, believed: Array) -> tuple[Array, Array]:
    """What ``unshifted`` leaves (8,) of one instant seen from a believed place (6,), and one less
    the leverage (8,)."""
    way = one_instant(rows_of(biases), believed)
    left = unshifted(way, np.zeros(8), SD, np.zeros(8))
    return left.residual * np.sqrt(left.checked), left.checked


@pytest.mark.parametrize("wrong", [(0.0, 0.0), (2.0, -1.5), (-1.5, 1.5), (5.0, -2.0)])
def test_a_track_that_is_wrong_is_no_error_of_the_rsus(wrong: tuple[float, float]) -> None:
    believed = PLACE.copy()
    believed[:2] += wrong
    left, checked = left_of(np.zeros(8), believed)
    assert np.abs(left).max() < 1e-3
    assert checked.sum() == pytest.approx(6.0)  # eight values, two unknowns


def test_an_error_looks_the_same_from_wherever_the_track_is() -> None:
    biases = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    here, _ = left_of(biases, PLACE)
    believed = PLACE.copy()
    believed[:2] += (1.5, -1.0)
    there, _ = left_of(biases, believed)
    assert np.abs(here - there).max() < 5e-3
    assert here[3] > 0.2
    assert np.abs(here).argmax() == 3


def test_two_ranges_leave_nothing() -> None:
    """As many unknowns as values: any residual is a shift."""
    way = one_instant(rows_of(np.zeros(8))[:2], PLACE)
    left = unshifted(way, np.array([0.05, -0.03]), SD[:2], np.array([3.0, 4.0]))
    assert np.abs(left.white).max() < 1e-9
    assert np.abs(left.checked).max() < 1e-9
    assert np.abs(left.beside).max() < 1e-9


def test_other_residuals_are_freed_of_the_same_shifts() -> None:
    """As least squares with the weights of the residuals leaves them."""
    rows, sd = rows_of(np.zeros(8)), np.linspace(0.05, 0.2, 8)
    other = np.arange(8.0)
    left = unshifted(one_instant(rows, PLACE), np.zeros(8), sd, other)
    _, H = linearise(rows, PLACE, 1.1)
    A = H[:, :2] / sd[:, None]
    shift, *_ = np.linalg.lstsq(A, other / sd)
    np.testing.assert_allclose(left.beside * sd, other - H[:, :2] @ shift, atol=1e-9)
    np.testing.assert_allclose(left.residual, 0.0, atol=1e-12)


def test_a_residual_is_what_all_others_do_not_foresee() -> None:
    """Over its sd, by the joint density of values that have noise, the way and any place in
    common: leaving one out (Cook and Weisberg 1982)."""
    rng = np.random.default_rng(2)
    rows, sd = rows_of(np.zeros(8)), np.linspace(0.05, 0.2, 8)
    stamps_ns = np.sort(np.round(1e9 * rng.uniform(0.0, 2.0, 8)).astype(np.int64))
    ends = at(PLACE, velocity_sd=0.3), at(PLACE, 2_000_000_000)
    way = Way.of(rows, alone(8), one_each(stamps_ns), np.zeros((8, 3)), ends)
    residuals = 1e-3 * rng.normal(0.0, sd)  # so small that angles are linear
    left = unshifted(way, residuals, sd, np.zeros(8))
    _, H = linearise(rows, PLACE, 1.1)
    _, jacobian = way.residuals(np.zeros(3))
    V = np.diag(sd**2) + way.covariance(jacobian) + 1e5 * H[:, :2] @ H[:, :2].T
    for i in range(8):
        others = np.arange(8) != i
        gain = np.linalg.solve(V[np.ix_(others, others)], V[others, i])
        variance = V[i, i] - gain @ V[others, i]
        assert left.checked[i] == pytest.approx(sd[i] ** 2 / variance, rel=1e-3)
        z = (residuals[i] - gain @ residuals[others]) / np.sqrt(variance)
        assert left.residual[i] / sd[i] == pytest.approx(z, rel=2e-3, abs=1e-6)


def test_the_way_wanders_as_the_motion_model_says() -> None:
    """The covariance of positions at several instants, by the transition of a constant velocity
    under white acceleration."""
    times, density, velocity_sd = np.array([0.3, 0.5, 1.4]), 0.5, 0.7
    P, t, x = np.diag([0.0, velocity_sd**2]), 0.0, []
    joint = np.zeros((3, 3))
    states: list[Array] = []  # cov of the state at each instant with the position now, by columns
    for k, time in enumerate(times):
        dt = time - t
        F, t = np.array([[1.0, dt], [0.0, 1.0]]), time
        P = F @ P @ F.T + density**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        states = [F @ column for column in states] + [P[:, 0]]
        joint[k, : k + 1] = joint[: k + 1, k] = [column[0] for column in states]
        x.append(P[0, 0])
    ends = at(PLACE, velocity_sd=velocity_sd), at(PLACE, 2_000_000_000)
    stamps_ns = np.round(1e9 * times).astype(np.int64)
    way = Way.of(rows_of(np.zeros(8))[:3], alone(3), one_each(stamps_ns), np.zeros((3, 3)), ends)
    means = np.array([[0.5, 0.5, 0.0], [0.0, 0.2, 0.8]])
    for weights in (np.eye(3), means):
        jacobian = np.zeros((len(weights), 3, 3))
        jacobian[:, :, 0] = weights  # of positions along x, at each instant
        found = way.covariance(jacobian)
        np.testing.assert_allclose(found, weights @ joint @ weights.T, rtol=1e-9)


def test_what_the_way_explains_is_in_no_residual() -> None:
    """Of a device that turns a corner between four arrays: seen from where it ended, and with the
    Jacobian of where each value was measured."""
    rows, to_go, H = [], [], []
    for k, (dx, dy) in enumerate([(2.0, 1.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.5)]):
        place = PLACE.copy()
        place[:2] -= dx, dy
        row = rows_of(np.zeros(8))[2 * k : 2 * k + 1]
        innovation, of_row = linearise(row, place, 1.1)
        row[:, VALUE] -= innovation
        rows.append(row)
        to_go.append([dx, dy, 0.0])
        H.append(of_row[0, [0, 1, 4]])
    ends = at(PLACE), at(PLACE, 1_000_000_000)
    stamps_ns = np.array([1, 2, 3, 4]) * 200_000_000
    means, weights = np.array([0, 0, 1, 1]), np.array([0.3, 0.7, 0.5, 0.5])
    way = Way.of(
        np.concatenate(rows), (means, weights), one_each(stamps_ns), np.array(to_go), ends
    )
    said, jacobian = way.residuals(np.zeros(3))
    assert np.abs(said).max() < 1e-12
    expected = np.zeros((2, 4, 3))
    expected[means, np.arange(4)] = weights[:, None] * np.array(H)
    np.testing.assert_allclose(jacobian, expected)
    step = np.array([1e-4, -2e-4, 0.0])
    shifted, _ = way.residuals(step)
    np.testing.assert_allclose(shifted, -expected.sum(axis=1) @ step, rtol=2e-3)
