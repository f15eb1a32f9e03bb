"""Rows in space against SciPy geometry and central differences of the error state."""

from __future__ import annotations

import math

import filter_rows
import numpy as np
import pytest
from error_states import moving
from measurement_rows import SPATIAL
from netpos.estimation.measurement import (
    BIAS,
    COMMON,
    KIND,
    LEVER,
    ORIGIN,
    REFERENCE,
    VALUE,
    Kind,
)
from netpos.estimation.rows import rsu_axes, rsu_place, rsu_rows
from netpos.estimation.spatial.space import (
    bend_mean,
    bend_variance,
    direction_rows,
    innovation_at,
    linearise_in_space,
    place_rows,
    value_at,
)
from netpos.estimation.state import ERR_BIASES, NAV_POSITION, NAV_QUATERNION, NAV_VELOCITY, Nav
from netpos.inertial.strapdown import ERR, GYRO_BIAS, NAV, inject, rotation_of
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement
from scipy.spatial.transform import Rotation

LEVER_ARM = (0.4, -0.3, 1.2)
QUANTITIES = Field.AZIMUTH | Field.ELEVATION | Field.TOA | Field.RANGE | Field.PHASE | Field.TDOA
OTHER = RsuInfo(rsu_id="b", position=np.array([-10.0, 25.0, 3.0]))
OTHER_PLACE = rsu_place(OTHER, rsu_axes(OTHER))


def state(rng: np.random.Generator) -> Array:
    nav = np.zeros(NAV)
    nav[:6] = 10.0 * rng.normal(size=6)
    nav[NAV_QUATERNION] = Rotation.random(rng=rng).as_quat()
    nav[10:] = 0.1 * rng.normal(size=6)
    return nav


def all_rows(rng: np.random.Generator) -> Array:
    """Rows of every kind: both angle conventions of a tilted RSU, ranges, places, constraints."""
    blocks = []
    for convention in AngleConvention:
        info = RsuInfo(
            rsu_id="a",
            position=np.array([30.0, -20.0, 8.0]),
            quaternion=Rotation.random(rng=rng).as_quat(),
            angle_convention=convention,
            baseline_m=0.3,
            wavelength_m=0.1,
        )
        m = RsuMeasurement(
            stamp_ns=1,
            rsu_id="a",
            vue_id="v",
            fields=QUANTITIES,
            azimuth_rad=3.0,
            azimuth_var=0.01,
            elevation_rad=0.3,
            elevation_var=0.01,
            toa_s=1e-7,
            toa_var=1e-18,
            range_m=30.0,
            range_var=1.0,
            phase_difference_var=1.0,
            tdoa_var=1e-18,
            lever_arm=LEVER_ARM,
        )
        blocks.append(rsu_rows(m, info, rsu_axes(info), 0, reference=OTHER_PLACE))
    unwrapped = blocks[0][blocks[0][:, KIND] == Kind.PHASE].copy()
    unwrapped[:, KIND] = Kind.UNWRAPPED_PHASE
    blocks.append(unwrapped)
    A = rng.normal(size=(3, 3))
    blocks.append(place_rows(np.array([1.0, 2.0, 3.0]), A @ A.T + np.eye(3), LEVER_ARM))
    blocks += [
        direction_rows(kind, rng.normal(size=(2, 3)), np.zeros(2), np.ones(2), 0)
        for kind in (Kind.BODY_VELOCITY, Kind.BODY_RATE)
    ]
    return np.vstack(blocks)


def innovation(row: Array, nav: Array) -> tuple[float, Array]:
    C, h = np.empty((3, 3)), np.empty(nav.size - 1)
    rotation_of(nav[NAV_QUATERNION], C)
    return innovation_at(row, nav, C, h), h


def slopes(row: Array, nav: Array, n: int) -> list[float]:
    """Derivatives of what a row measures by ``n`` errors, as central differences."""
    found = []
    for step in 1e-5 * np.eye(n):
        ends = []
        for sign in (1.0, -1.0):
            moved = nav.copy()
            inject(moved, sign * step)
            ends.append(innovation(row, moved)[0])
        found.append(-math.remainder(ends[0] - ends[1], math.tau) / 2e-5)
    return found


def test_jacobians_are_central_differences() -> None:
    rng = np.random.default_rng(2)
    kinds = set()
    for _ in range(5):
        nav = state(rng)
        for row in all_rows(rng):
            _, h = innovation(row, nav)
            np.testing.assert_allclose(
                h, slopes(row, nav, ERR), rtol=0, atol=2e-6, err_msg=str(row[KIND])
            )
            kinds.add(int(row[KIND]))
    assert kinds == set(map(int, SPATIAL))


def test_clock_and_biases_are_states_of_their_own() -> None:
    """A TOA counts the clock's offset, every row of an RSU the biases it names; Jacobians are
    central differences in all states. Core states are no biases."""
    rng = np.random.default_rng(4)
    # offset, drift; biases: its own, the network's, that of the RSU a difference counts from
    slow = np.array([250.0, 3.0, 0.3, -0.2, 0.5])
    nav = np.append(state(rng), slow)
    n = nav.size - 1
    for row in all_rows(rng):
        row[[BIAS, COMMON, REFERENCE]] = 0, 1, 1
        plain = innovation(row, nav[:NAV])[0]
        row[[BIAS, COMMON, REFERENCE]] = ERR_BIASES + np.arange(3)
        value, h = innovation(row, nav)
        from_rsu = int(row[KIND]) not in (Kind.BODY_VELOCITY, Kind.BODY_RATE)
        clock = slow[0] if row[KIND] == Kind.TOA else 0.0
        expected = clock + (slow[2] + slow[3] - slow[4] if from_rsu else 0.0)
        assert math.remainder(plain - value - expected, math.tau) == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(
            h, slopes(row, nav, n), rtol=0, atol=2e-6, err_msg=str(row[KIND])
        )


def test_values_are_those_of_the_geometry() -> None:
    rng = np.random.default_rng(5)
    nav = state(rng)
    antenna = nav[NAV_POSITION] + Rotation.from_quat(nav[NAV_QUATERNION]).apply(LEVER_ARM)
    for row in all_rows(rng):
        kind, predicted = int(row[KIND]), row[VALUE] - innovation(row, nav)[0]
        u = row[10:19].reshape(3, 3) @ (antenna - row[ORIGIN : ORIGIN + 3])
        d = antenna - row[ORIGIN : ORIGIN + 3]
        r = max(float(np.linalg.norm(d)), 1e-9)  # rows of a direction have no origin
        body = Rotation.from_quat(nav[NAV_QUATERNION]).inv().apply(nav[NAV_VELOCITY])
        expected = {
            Kind.AZIMUTH: math.atan2(u[1], u[0]),
            Kind.ELEVATION: math.asin(u[2] / r),
            Kind.RANGE: r,
            Kind.TOA: r,
            Kind.COSINE_Y: u[1] / r,
            Kind.COSINE_Z: u[2] / r,
            Kind.PHASE: row[10:13] @ d / r,
            Kind.UNWRAPPED_PHASE: row[10:13] @ d / r,
            Kind.TDOA: r - math.dist(d, row[10:13]),
            Kind.PLACE: row[ORIGIN : ORIGIN + 3] @ antenna,
            Kind.BODY_VELOCITY: row[ORIGIN : ORIGIN + 3] @ body,
            Kind.BODY_RATE: row[ORIGIN : ORIGIN + 3] @ nav[GYRO_BIAS:],
        }[kind]
        if kind not in (Kind.AZIMUTH, Kind.ELEVATION, Kind.PHASE):
            assert predicted == pytest.approx(expected, abs=1e-9)
        else:
            assert math.remainder(predicted - expected, math.tau) == pytest.approx(0, abs=1e-9)


def test_an_angle_across_the_back_is_a_small_residual() -> None:
    """Device just south of west, reading just north of west."""
    info = RsuInfo(rsu_id="a", position=np.zeros(3))
    m = RsuMeasurement(
        stamp_ns=1, rsu_id="a", vue_id="v", fields=Field.AZIMUTH, azimuth_rad=math.pi - 0.01,
        azimuth_var=1.0,
    )  # fmt: skip
    nav = np.zeros(NAV)
    nav[:2], nav[Nav.QW] = (-10.0, -0.1), 1.0
    value, _ = innovation(rsu_rows(m, info, rsu_axes(info), 0)[0], nav)
    assert value == pytest.approx(-0.02, abs=1e-4)


def test_place_rows_hold_the_whole_covariance() -> None:
    """The squared norm of their residuals is the Mahalanobis distance of the fix."""
    rng = np.random.default_rng(8)
    A = rng.normal(size=(4, 3, 3))
    cov, fix, at = A @ A.transpose(0, 2, 1), rng.normal(size=(4, 3)), rng.normal(size=3)
    rows = place_rows(fix, cov, (0.0, 0.0, 0.0))
    assert rows.shape[:2] == (4, 3)
    for i in range(4):
        residuals = [row[VALUE] - value_at(row, *at)[0] for row in rows[i]]
        expected = (fix[i] - at) @ np.linalg.solve(cov[i], fix[i] - at)
        assert np.sum(np.square(residuals)) == pytest.approx(expected, rel=1e-9)
        assert rows[i, 0, LEVER : LEVER + 3].tolist() == [0.0, 0.0, 0.0]


def test_a_flat_covariance_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        place_rows(np.zeros(3), np.diag([1.0, 1.0, 0.0]), (0.0, 0.0, 0.0))


def test_all_rows_are_linearised_in_their_order() -> None:
    rng = np.random.default_rng(6)
    nav, rows, A = state(rng), all_rows(rng), rng.normal(size=(ERR, ERR))
    found = linearise_in_space(rows, nav, A @ A.T)
    for row, z, h, bend in zip(rows, *found, strict=True):
        expected, gradient = innovation(row, nav)
        assert z == expected - bend_mean(row, nav, A @ A.T)
        assert bend == bend_variance(row, nav, A @ A.T)
        np.testing.assert_array_equal(h, gradient)


@pytest.mark.parametrize("kind", [Kind.RANGE, Kind.AZIMUTH, Kind.ELEVATION])
def test_bend_variance_covers_what_linearising_leaves_out(kind: Kind) -> None:
    """Monte Carlo: no smaller than the variance of the remainder, and no ten times larger."""
    rng = np.random.default_rng(9)
    row, nav = filter_rows.row(kind, 0.0, 1.0), moving(0.0)
    nav[NAV_POSITION] = 12.0, 9.0, -6.0
    A = rng.normal(size=(3, 3))
    cov = np.zeros((ERR, ERR))
    cov[:3, :3] = 0.3 * (A @ A.T)
    value, *g = value_at(row, *nav[NAV_POSITION])
    offsets = rng.multivariate_normal(np.zeros(3), cov[:3, :3], 20000)
    exact = np.array([value_at(row, *(nav[NAV_POSITION] + d))[0] for d in offsets])
    remainder = exact - value - offsets @ np.array(g)
    claimed = bend_variance(row, nav, cov)
    assert np.mean(remainder**2) < 3.0 * claimed
    assert claimed < 10.0 * np.mean(remainder**2)
