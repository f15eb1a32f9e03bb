"""Every sensor of the table: gradients and second-order terms against finite differences."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from measurement_rows import PLANAR, random_row, random_state
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    BLOCKED,
    COMMON,
    HEADING,
    LEVER,
    ORIGIN,
    VALUE,
    Kind,
    curvature_variance,
    innovation_row,
    predict_row,
    second_order_variance,
)
from netpos.estimation.sensors.model import Sensor, Wraps
from netpos.estimation.sensors.row import ROW_WIDTH
from netpos.estimation.sensors.table import BY_KIND, SENSORS
from netpos.estimation.spatial.space import bend_variance, innovation_at, value_at
from netpos.estimation.state import ERR_POSITION, NAV_POSITION, POSITION, Nav, X
from netpos.inertial.navigation_state import ERR, NAV
from netpos.messages.values import Array

OF_OFFSET = [sensor for sensor in SENSORS if sensor.of_offset]
OF_ANTENNA = [sensor for sensor in SENSORS if sensor.of_antenna]
WITH_SECOND_ORDER = [Kind(s.kind) for s in SENSORS if s.second_order]
# The largest curvature of a direction cosine or a phase is 2 / sqrt(3) over r^2, not 1 over r^2.
BOUND_SHORT_OF = 4.0 / 3.0
SEEDS = range(10)


def ids(sensor: Sensor) -> str:
    return sensor.name


def changes(f: Callable[[Array], float], n: int, eps: float, turn: float) -> Array:
    """Central differences of ``f`` by its (n,) argument; ``turn``: what its values wrap at."""
    ends = [(f(eps * e), f(-eps * e)) for e in np.eye(n)]
    return np.array([math.remainder(up - down, turn) for up, down in ends]) / (2 * eps)


def hessian(gradient: Callable[[Array], Array], n: int) -> Array:
    """Central differences of a gradient (n,) by its (n,) argument, (n, n)."""
    eps = 1e-5
    return np.array([(gradient(eps * e) - gradient(-eps * e)) / (2 * eps) for e in np.eye(n)])


def half_trace(second: Array, cov: Array) -> float:
    """Bar-Shalom, Li and Kirubarajan 2001, eq. 10.3.3-12."""
    product = second @ cov
    return 0.5 * float(np.trace(product @ product))


def turn_of(sensor: Sensor) -> float:
    return math.tau if sensor.wraps == Wraps.ALWAYS else math.inf


def spd(rng: np.random.Generator, n: int) -> Array:
    A = rng.normal(size=(n, n))
    return 0.01 * A @ A.T


def upright(yaw: float) -> Array:
    """Axes (9,) of an RSU that is turned about the vertical only."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0])


def seen(rng: np.random.Generator, sensor: Sensor) -> tuple[Array, Array]:
    """A row of an upright RSU without lever arm, and an offset d (3,) of the device. Up to 80 deg
    above or below the RSU; 40 deg where there is a bound, which holds for no steeper direction."""
    row = random_row(rng, Kind(sensor.kind))
    row[AXES:HEADING] = upright(rng.uniform(-3, 3))
    row[LEVER:BLOCKED] = 0.0
    azimuth, steepest = rng.uniform(-3, 3), math.radians(40.0 if sensor.is_bound else 80.0)
    elevation, r = rng.uniform(-steepest, steepest), rng.uniform(5, 40)
    level = r * math.cos(elevation)
    d = (level * math.cos(azimuth), level * math.sin(azimuth), r * math.sin(elevation))
    return row, np.array(d)


def within(found: float, expected: float, sensor: Sensor) -> None:
    """``found`` is the second-order term, or for a sensor with a bound no less."""
    if sensor.is_bound:
        assert found >= expected / BOUND_SHORT_OF
    else:
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-12)


def test_every_sensor_has_one_model_in_each_filter_that_takes_it() -> None:
    for s in SENSORS:
        planar = [m for m in (s.of_offset, s.of_state) if m]
        spatial = [m for m in (s.of_offset, s.of_antenna, s.of_navigation) if m]
        assert len(planar) <= 1
        assert len(spatial) <= 1
        assert planar or spatial
        assert BY_KIND[s.kind] is s
        assert Kind[s.name] == s.kind


@pytest.mark.parametrize("sensor", [*OF_OFFSET, *OF_ANTENNA], ids=ids)
@pytest.mark.parametrize("seed", SEEDS)
def test_gradients_in_three_dimensions(sensor: Sensor, seed: int) -> None:
    rng = np.random.default_rng(seed)
    row, at = random_row(rng, Kind(sensor.kind)), rng.uniform(-20, 20, 3)
    value, *gradient = value_at(row, *at)
    expected = changes(lambda d: value_at(row, *(at + d))[0], 3, 1e-5, turn_of(sensor))
    assert math.isfinite(value)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=2e-8)


@pytest.mark.parametrize("heading", [-1, 7])
@pytest.mark.parametrize("kind", PLANAR)
@pytest.mark.parametrize("seed", SEEDS)
def test_gradients_of_planar_states(kind: Kind, seed: int, heading: int) -> None:
    """By every state: position, velocity, clock, heading, biases."""
    rng = np.random.default_rng(100 + seed)
    row, x, height = random_row(rng, kind, heading), random_state(rng), rng.uniform(-3, 3)
    h, unused = np.full(9, 99.0), np.empty(9)
    predict_row(row, x, height, h)
    expected = changes(
        lambda d: predict_row(row, x + d, height, unused), 9, 1e-5, turn_of(BY_KIND[kind])
    )
    np.testing.assert_allclose(h, expected, rtol=1e-6, atol=2e-8)


@pytest.mark.parametrize("kind", WITH_SECOND_ORDER)
@pytest.mark.parametrize("seed", SEEDS)
def test_second_order_terms_of_planar_filters(kind: Kind, seed: int) -> None:
    """By differences of the gradient, tested above. Of the states that enter alone: a sensor of
    the offset counts the position only."""
    rng = np.random.default_rng(200 + seed)
    sensor, x, P = BY_KIND[kind], random_state(rng), spd(rng, 9)
    row, offset = seen(rng, sensor)
    n = 2 if sensor.of_offset else 9
    if sensor.of_offset:
        x[POSITION] = row[ORIGIN : ORIGIN + 2] + offset[:2]
    height = float(row[ORIGIN + 2] + offset[2])

    def gradient(d: Array) -> Array:
        h = np.empty(9)
        predict_row(row, x + np.append(d, np.zeros(9 - n)), height, h)
        return h[:n]

    expected = half_trace(hessian(gradient, n), P[:n, :n])
    within(curvature_variance(row, x, P, height), expected, BY_KIND[kind])


@pytest.mark.parametrize("kind", [k for k in WITH_SECOND_ORDER if BY_KIND[k].of_offset])
@pytest.mark.parametrize("seed", SEEDS)
def test_second_order_terms_of_spatial_filters(kind: Kind, seed: int) -> None:
    rng = np.random.default_rng(300 + seed)
    row, offset = seen(rng, BY_KIND[kind])
    nav, P = np.zeros(NAV), spd(rng, ERR)
    nav[NAV_POSITION], nav[Nav.QW] = row[ORIGIN:AXES] + offset, 1.0
    second = hessian(lambda d: np.array(value_at(row, *(nav[NAV_POSITION] + d))[1:]), 3)
    within(
        bend_variance(row, nav, P),
        half_trace(second, P[ERR_POSITION, ERR_POSITION]),
        BY_KIND[kind],
    )


@pytest.mark.parametrize("sensor", [s for s in SENSORS if not s.second_order], ids=ids)
def test_what_has_no_second_order_term_adds_no_variance(sensor: Sensor) -> None:
    """They are linear; of the speed the term is left out."""
    rng = np.random.default_rng(1)
    row, nav = random_row(rng, Kind(sensor.kind)), np.append(np.zeros(9), np.ones(7))
    assert bend_variance(row, nav, spd(rng, ERR)) == 0.0
    if sensor.of_state:
        assert curvature_variance(row, random_state(rng), spd(rng, 9), 1.0) == 0.0


@pytest.mark.parametrize("kind", [Kind(s.kind) for s in SENSORS if s.exact_second_order])
@pytest.mark.parametrize("seed", SEEDS)
def test_exact_second_order_terms(kind: Kind, seed: int) -> None:
    """Of upright axes; in tilted ones the bound stays."""
    rng = np.random.default_rng(400 + seed)
    tilted, x = random_row(rng, kind), random_state(rng)
    P = spd(rng, 9)
    bound = curvature_variance(tilted, x, P, 1.0)
    assert second_order_variance(tilted, x, P, 1.0) == pytest.approx(bound, rel=1e-14)
    row = tilted.copy()
    row[AXES:HEADING] = upright(0.3 * seed)

    def gradient(d: Array) -> Array:
        h = np.empty(9)
        predict_row(row, x + np.append(d, np.zeros(7)), 1.0, h)
        return h[POSITION]

    expected = half_trace(hessian(gradient, 2), P[POSITION, POSITION])
    assert second_order_variance(row, x, P, 1.0) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("kind", [Kind(s.kind) for s in OF_OFFSET])
def test_innovations_wrap_alike_in_the_plane_and_in_space(kind: Kind) -> None:
    """Two turns more are nothing to an angle or a phase, and two turns to all others."""
    rng = np.random.default_rng(5)
    row, x, h = random_row(rng, kind), random_state(rng), np.empty(9)
    row[LEVER : LEVER + 3] = 0.0
    row[[BIAS, COMMON]] = -1.0
    nav, C, error = np.zeros(NAV), np.eye(3), np.empty(ERR)
    nav[NAV_POSITION], nav[Nav.QW] = (x[X.PX], x[X.PY], 1.0), 1.0
    x[X.CLOCK] = 0.0
    row[VALUE] = predict_row(row, x, 1.0, h) + 0.25 + 2 * math.tau
    expected = 0.25 if BY_KIND[kind].wraps != Wraps.NEVER else 0.25 + 2 * math.tau
    assert innovation_row(row, x, 1.0, h) == pytest.approx(expected, abs=1e-9)
    assert innovation_at(row, nav, C, error) == pytest.approx(expected, abs=1e-9)
    np.testing.assert_allclose(error[POSITION], h[POSITION], rtol=1e-12)


def test_no_sensor_writes_beyond_its_row() -> None:
    for sensor in OF_OFFSET:
        row = random_row(np.random.default_rng(2), Kind(sensor.kind))
        before = row.copy()
        value_at(row, 1.0, 2.0, 3.0)
        np.testing.assert_array_equal(row, before)
        assert row.shape == (ROW_WIDTH,)
