"""Curvature of the measurement models: what the tangent leaves out under a prior."""

from __future__ import annotations

import numpy as np
import pytest
from measurement_rows import closed_form, random_row, random_state
from netpos.estimation.measurement import (
    AXES,
    BLOCKED,
    HEADING,
    KIND,
    LEVER,
    ORIGIN,
    Kind,
    curvature_mean,
    curvature_variance,
    innovation_row,
    innovation_variance,
)
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array
from scipy.spatial.transform import Rotation


def hessian(row: Array, x: Array, height_m: float) -> Array:
    """Second derivatives by position (2, 2), numerically."""
    eps, e = 1e-3, np.eye(9)

    def f(p: Array) -> float:
        return closed_form(row, x + p, height_m)

    return np.array(
        [
            [
                f(eps * (e[i] + e[j]))
                - f(eps * (e[i] - e[j]))
                - f(eps * (e[j] - e[i]))
                + f(-eps * (e[i] + e[j]))
                for j in range(2)
            ]
            for i in range(2)
        ]
    ) / (4 * eps**2)


def half_trace(row: Array, x: Array, cov: Array, height_m: float) -> float:
    """Variance of the second-order term of a Gaussian prior."""
    product = hessian(row, x, height_m) @ cov[POSITION, POSITION]
    return 0.5 * float(np.trace(product @ product))


def half_trace_of_mean(row: Array, x: Array, cov: Array, height_m: float) -> float:
    """By how much a Gaussian prior makes the mean value larger."""
    return 0.5 * float(np.trace(hessian(row, x, height_m) @ cov[POSITION, POSITION]))


def level_row(kind: Kind, origin: Array) -> Array:
    row = random_row(np.random.default_rng(0), kind)
    row[ORIGIN:AXES], row[AXES:HEADING] = origin, np.eye(3).reshape(-1)
    row[LEVER:BLOCKED] = 0.0
    return row


def test_an_antenna_above_the_device_is_a_higher_device() -> None:
    row, x = level_row(Kind.RANGE, np.array([1.0, 1.0, 4.0])), np.full(9, 2.0)
    plain = curvature_variance(row, x, np.eye(9), 1.5)
    row[LEVER + 2] = 1.5
    assert curvature_variance(row, x, np.eye(9), 0.0) == pytest.approx(plain, rel=1e-12)


@pytest.mark.parametrize("kind", [Kind.RANGE, Kind.AZIMUTH])
@pytest.mark.parametrize("seed", range(5))
def test_a_lever_arm_bends_as_a_device_where_its_antenna_is(kind: Kind, seed: int) -> None:
    rng = np.random.default_rng(seed)
    row, x, A = level_row(kind, np.zeros(3)), random_state(rng), rng.normal(size=(9, 9))
    at_antenna, lever_arm = x.copy(), rng.uniform(-9, 9, 3)
    at_antenna[:2] += Rotation.from_euler("z", x[7]).apply(lever_arm)[:2]
    plain = curvature_variance(row, at_antenna, A @ A.T, 2.0 + lever_arm[2])
    row[HEADING], row[LEVER:BLOCKED] = 7, lever_arm
    assert curvature_variance(row, x, A @ A.T, 2.0) == pytest.approx(plain, rel=1e-9)


@pytest.mark.parametrize("kind", [Kind.PHASE, Kind.UNWRAPPED_PHASE])
def test_a_phase_bends_with_the_radians_of_its_array(kind: Kind) -> None:
    """A direction cosine times what the tilted row of the axes is long."""
    row, x = level_row(Kind.COSINE_Y, np.zeros(3)), random_state(np.random.default_rng(3))
    cosine = curvature_variance(row, x, np.eye(9), 2.0)
    row[KIND], row[AXES : AXES + 3] = kind, (2.0, -3.0, 6.0)
    assert curvature_variance(row, x, np.eye(9), 2.0) == pytest.approx(7.0**2 * cosine, rel=1e-12)


@pytest.mark.parametrize("kind", [Kind.RANGE, Kind.SPEED])
def test_an_innovation_scatters_by_noise_curvature_and_prior(kind: Kind) -> None:
    rng = np.random.default_rng(4)
    row, x, A = random_row(rng, kind), random_state(rng), rng.normal(size=(9, 9))
    h = np.empty(9)
    innovation_row(row, x, 2.0, h)
    expected = 0.7 + curvature_variance(row, x, A @ A.T, 2.0) + h @ A @ A.T @ h
    found = innovation_variance(row, x, A @ A.T, 2.0, 0.7, h)
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("aside_m", "expected"), [(0.0, 16.0 / 8.5**2), (1.0, None), (8.5, None), (85.0, None)]
)
def test_a_range_from_above_bends_along_the_ground_too(
    aside_m: float, expected: float | None
) -> None:
    """An RSU 8.5 m above. Straight below it h'' is 1/8.5 in both directions."""
    row, x = level_row(Kind.RANGE, np.array([0.0, 0.0, 8.5])), np.zeros(9)
    x[X.PX] = aside_m
    cov = np.diag([4.0, 4.0, *np.ones(7)])
    if expected is None:
        expected = half_trace(row, x, cov, 0.0)
    assert curvature_variance(row, x, cov, 0.0) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("kind", "target"),
    [
        (Kind.AZIMUTH, (3.0, 4.0, 7.0)),
        (Kind.ELEVATION, (3.0, 4.0, 5.0)),
        (Kind.COSINE_Y, (5.0, 0.0, 0.0)),
    ],
)
def test_curvature_of_angles_is_exact_for_an_equal_spread_where_they_bend_most(
    kind: Kind, target: tuple[float, float, float]
) -> None:
    row, x = level_row(kind, np.array([1.0, 1.0, 1.0])), np.zeros(9)
    x[POSITION] = target[0] + 1.0, target[1] + 1.0
    cov, height = 0.3 * np.eye(9), target[2] + 1.0
    assert curvature_variance(row, x, cov, height) == pytest.approx(
        half_trace(row, x, cov, height), rel=1e-4
    )


@pytest.mark.parametrize("seed", range(20))
def test_curvature_of_azimuth_bounds_the_second_order_term(seed: int) -> None:
    rng = np.random.default_rng(seed)
    row, x, A = level_row(Kind.AZIMUTH, np.zeros(3)), random_state(rng), rng.normal(size=(9, 9))
    cov = A @ A.T
    d2 = x[X.PX] ** 2 + x[X.PY] ** 2
    assert curvature_variance(row, x, cov, 2.0) >= half_trace(row, x, cov, 2.0) * (1 - 1e-4)
    frobenius2 = np.linalg.norm(cov[POSITION, POSITION]) ** 2
    assert curvature_variance(row, x, cov, 2.0) == pytest.approx(frobenius2 / 2 / d2**2)
    slant2 = d2 + 4.0
    for kind in (Kind.ELEVATION, Kind.COSINE_Y, Kind.COSINE_Z):
        row[KIND] = kind
        assert curvature_variance(row, x, cov, 2.0) == pytest.approx(frobenius2 / 2 / slant2**2)


@pytest.mark.parametrize("heading", [-1, 7])
@pytest.mark.parametrize("kind", [Kind.RANGE, Kind.TOA, Kind.TDOA])
@pytest.mark.parametrize("seed", range(8))
def test_the_mean_distance_is_longer_than_that_of_the_mean(
    kind: Kind, seed: int, heading: int
) -> None:
    rng = np.random.default_rng(100 + seed)
    row, x, A = random_row(rng, kind, heading), random_state(rng), rng.normal(size=(9, 9))
    cov = A @ A.T
    found = curvature_mean(row, x, cov, 2.0)
    assert found == pytest.approx(half_trace_of_mean(row, x, cov, 2.0), rel=1e-3, abs=1e-8)
    assert kind == Kind.TDOA or found > 0.0


def test_the_mean_of_drawn_distances_is_that_of_the_second_order() -> None:
    rng = np.random.default_rng(7)
    row, x = level_row(Kind.RANGE, np.array([0.0, 0.0, 3.0])), np.zeros(9)
    x[POSITION] = 20.0, 5.0
    cov = np.eye(9)
    cov[POSITION, POSITION] = [[1.0, -1.5], [-1.5, 4.0]]
    drawn = rng.multivariate_normal(x[POSITION], cov[POSITION, POSITION], 400_000)
    distances = np.sqrt((drawn**2).sum(axis=1) + 9.0)
    longer = float(distances.mean() - np.sqrt(x[X.PX] ** 2 + x[X.PY] ** 2 + 9.0))
    assert curvature_mean(row, x, cov, 0.0) == pytest.approx(longer, abs=0.01)


@pytest.mark.parametrize("kind", [Kind.AZIMUTH, Kind.COSINE_Y, Kind.PHASE, Kind.SPEED])
def test_other_values_are_predicted_at_the_mean(kind: Kind) -> None:
    row, x = random_row(np.random.default_rng(1), kind), random_state(np.random.default_rng(2))
    assert curvature_mean(row, x, np.eye(9), 2.0) == 0.0


def test_curvature_at_the_rsu_is_finite_and_linear_rows_have_none() -> None:
    cov, x = np.eye(9), np.zeros(9)
    for kind, floor in ((Kind.AZIMUTH, 1e12), (Kind.COSINE_Y, 1e12), (Kind.ELEVATION, 1e12)):
        assert curvature_variance(level_row(kind, np.zeros(3)), x, cov, 0.0) == pytest.approx(
            floor
        )
    value = curvature_variance(level_row(Kind.RANGE, np.zeros(3)), x, cov, 0.0)
    assert value == pytest.approx(0.5 * 2.0 / 1e-6)
    for kind in (Kind.LINEAR, Kind.SPEED):
        assert curvature_variance(level_row(kind, np.ones(3)), x, cov, 0.0) == 0.0
