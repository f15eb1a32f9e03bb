"""The height of the device as a state: values, gradients and second-order terms by height."""

from __future__ import annotations

import math

import numpy as np
import pytest
from filter_rows import random_spd
from measurement_rows import PLANAR, closed_form, random_row, random_state
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    HEIGHT,
    LEVER,
    ORIGIN,
    VALUE,
    Kind,
    curvature_mean,
    curvature_variance,
    predict_row,
    second_order_variance,
)
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.state import N_CORE, HeightState
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement

PLACED = [kind for kind in PLANAR if kind not in (Kind.LINEAR, Kind.SPEED, Kind.STEP_VELOCITY)]
UP = 9  # index of the height; before it are the core, two motion states and a bias


def with_height(rng: np.random.Generator, kind: Kind, heading: int = -1) -> tuple[Array, Array]:
    row, x = random_row(rng, kind, heading), random_state(rng, 10)
    row[HEIGHT] = UP
    return row, x


def by_hand(row: Array, x: Array, nominal_m: float) -> float:
    return closed_form(row, x, nominal_m + x[UP])


@pytest.mark.parametrize("heading", [-1, 7])
@pytest.mark.parametrize("kind", PLACED)
@pytest.mark.parametrize("seed", range(10))
def test_value_and_gradient_by_height(kind: Kind, seed: int, heading: int) -> None:
    row, x = with_height(np.random.default_rng(seed), kind, heading)
    h, eps = np.full(10, 99.0), 1e-5
    value = predict_row(row, x, 1.3, h)
    assert value == pytest.approx(by_hand(row, x, 1.3), rel=1e-12, abs=1e-11)
    change = by_hand(row, x, 1.3 + eps) - by_hand(row, x, 1.3 - eps)
    if kind in (Kind.AZIMUTH, Kind.ELEVATION):
        change = math.remainder(change, 2.0 * math.pi)
    assert h[UP] == pytest.approx(change / (2.0 * eps), rel=1e-6, abs=2e-8)


@pytest.mark.parametrize("kind", PLACED)
def test_a_known_height_has_no_gradient(kind: Kind) -> None:
    """And the entry that would be the height is not read."""
    row, x = with_height(np.random.default_rng(3), kind)
    row[HEIGHT], h = 0.0, np.full(10, 99.0)
    assert predict_row(row, x, 1.3, h) == pytest.approx(closed_form(row, x, 1.3), rel=1e-12)
    assert h[UP] == 0.0


def hessian(row: Array, x: Array) -> Array:
    """Second derivatives by x, y and height (3, 3), numerically."""
    eps, e = 1e-3, np.eye(10)[[0, 1, UP]]

    def f(p: Array) -> float:
        return by_hand(row, x + p, 1.3)

    def mixed(a: Array, b: Array) -> float:
        return f(eps * (a + b)) - f(eps * (a - b)) - f(eps * (b - a)) + f(-eps * (a + b))

    return np.array([[mixed(a, b) for b in e] for a in e]) / (4.0 * eps**2)


def half_trace(row: Array, x: Array, cov: Array) -> float:
    position = np.ix_([0, 1, UP], [0, 1, UP])
    product = hessian(row, x) @ cov[position]
    return 0.5 * float(np.trace(product @ product))


@pytest.mark.parametrize("kind", [Kind.RANGE, Kind.TOA, Kind.TDOA])
@pytest.mark.parametrize("seed", range(8))
def test_second_order_term_of_ranges_is_exact(kind: Kind, seed: int) -> None:
    rng = np.random.default_rng(50 + seed)
    row, x = with_height(rng, kind)
    cov = random_spd(rng, 10)
    expected = half_trace(row, x, cov)
    assert curvature_variance(row, x, cov, 1.3) == pytest.approx(expected, rel=2e-3)
    assert second_order_variance(row, x, cov, 1.3) == pytest.approx(expected, rel=2e-3)
    position = np.ix_([0, 1, UP], [0, 1, UP])
    longer = 0.5 * float(np.trace(hessian(row, x) @ cov[position]))
    assert curvature_mean(row, x, cov, 1.3) == pytest.approx(longer, rel=2e-3, abs=1e-6)


@pytest.mark.parametrize("kind", [Kind.COSINE_Y, Kind.COSINE_Z, Kind.PHASE])
@pytest.mark.parametrize("seed", range(8))
def test_second_order_term_of_directions_grows_with_the_height(kind: Kind, seed: int) -> None:
    """A bound: the curvature 1 / r^2 in every direction, by the trace of P^2 of x, y and z."""
    rng = np.random.default_rng(80 + seed)
    row, x = with_height(rng, kind)
    cov = random_spd(rng, 10)
    P = cov[np.ix_([0, 1, UP], [0, 1, UP])]
    d = np.array([x[0], x[1], 1.3 + x[UP] + row[LEVER + 2]]) - row[ORIGIN:AXES]
    expected = 0.5 * float(np.trace(P @ P)) / float(d @ d) ** 2
    assert curvature_variance(row, x, cov, 1.3) == pytest.approx(expected, rel=1e-9)
    row[HEIGHT] = 0.0
    assert curvature_variance(row, x, cov, 1.3 + x[UP]) < expected


def fix(position: Array, cov: Array, lever_up: float = 0.0) -> Array:
    m = RsuMeasurement(
        stamp_ns=1,
        rsu_id="r",
        vue_id="v",
        fields=Field.POSITION,
        position=position,
        position_cov=cov,
        lever_arm=(0.0, 0.0, lever_up),
    )
    info = RsuInfo(rsu_id="r", position=np.zeros(3))
    return rsu_rows(m, info, rsu_axes(info), 0, height=HeightState(7, 1.3))


def test_a_position_fix_measures_the_height() -> None:
    """Rows, whitened: their normal equations are those of the fix itself."""
    rng = np.random.default_rng(4)
    position, cov = np.array([3.0, -2.0, 5.0]), random_spd(rng, 3)
    rows = fix(position, cov, lever_up=0.4)
    assert rows.shape[0] == 3
    x, H = random_state(rng, 8), np.empty((3, 8))
    left = np.array(
        [row[VALUE] - predict_row(row, x, 99.0, h) for row, h in zip(rows, H, strict=True)]
    )
    antenna = np.array([x[0], x[1], 1.3 + x[7] + 0.4])
    expected = float((position - antenna) @ np.linalg.solve(cov, position - antenna))
    assert float(left @ left) == pytest.approx(expected, rel=1e-10)
    information = np.zeros((8, 8))
    information[np.ix_([0, 1, 7], [0, 1, 7])] = np.linalg.inv(cov)
    np.testing.assert_allclose(H.T @ H, information, rtol=1e-9, atol=1e-12)
    assert (rows[:, BIAS] == -1.0).all()
    assert (rows[:, COMMON] == -1.0).all()


@pytest.mark.parametrize("var", [0.0, -1.0, math.inf, math.nan, 1e13])
def test_a_fix_without_a_height_is_one_of_x_and_y(var: float) -> None:
    rows = fix(np.array([3.0, -2.0, 5.0]), np.diag([1.0, 4.0, var]))
    assert rows.shape[0] == 2
    assert not rows[:, ORIGIN + N_CORE].any()
