"""Levenberg-Marquardt against SciPy's, closed forms and where Gauss-Newton runs away."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from netpos.common.least_squares import Array, minimiser
from netpos.estimation.factor import solve
from numba import njit
from scipy.optimize import approx_fprime, least_squares

Residuals = Callable[[Array], Array]
Equations = Callable[[Array], tuple[float, Array, Array]]


def equations(residuals: Residuals, seen: list[Array]) -> Equations:
    def at(x: Array) -> tuple[float, Array, Array]:
        seen.append(x)
        r, J = residuals(x), -approx_fprime(x, residuals, 1e-7).reshape(-1, x.size)
        return float(r @ r), J.T @ r, J.T @ J

    return at


def minimise(equations: Equations, start: Array) -> tuple[float, Array, Array]:
    return minimiser(lambda x, _: equations(x), np.linalg.solve)(start, None)


def ranges(x: Array) -> Array:
    """To four stations; no place fits all."""
    stations = np.array([[0.0, 0.0], [50.0, 0.0], [50.0, 40.0], [0.0, 40.0]])
    measured: Array = np.array([22.0, 42.0, 44.0, 30.0])
    return measured - np.linalg.norm(x - stations, axis=1)


def rosenbrock(x: Array) -> Array:
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


@pytest.mark.parametrize(
    ("residuals", "start"),
    [(ranges, [1.0, 39.0]), (ranges, [300.0, -200.0]), (rosenbrock, [0.5, 0.5])],
)
def test_the_end_is_scipys(residuals: Residuals, start: list[float]) -> None:
    seen: list[Array] = []
    cost, x, normal = minimise(equations(residuals, seen), np.array(start))
    expected = least_squares(residuals, start, method="lm", xtol=1e-12, ftol=1e-12)
    assert cost == pytest.approx(2.0 * expected.cost, abs=1e-5)
    np.testing.assert_allclose(x, expected.x, atol=1e-2)
    np.testing.assert_allclose(normal, equations(residuals, [])(x)[2])
    assert len(seen) <= 31  # thirty steps from the start


def test_a_line_is_found_at_once() -> None:
    """Linear, the damping aside: the second step changes the cost by less than is worth it."""
    A = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    z, seen = np.array([1.0, 2.5, 4.2]), list[Array]()
    cost, x, normal = minimise(equations(lambda x: z - A @ x, seen), np.array([100.0, -50.0]))
    expected, (rest,), *_ = np.linalg.lstsq(A, z)
    np.testing.assert_allclose(x, expected, atol=1e-3)
    assert cost == pytest.approx(rest, rel=1e-3)
    np.testing.assert_allclose(normal, A.T @ A, rtol=1e-6)
    assert len(seen) == 4


def test_a_step_too_far_is_damped() -> None:
    """From 3 undamped steps to the zero of atan grow without end."""
    seen: list[Array] = []
    cost, x, _ = minimise(equations(np.arctan, seen), np.array([3.0]))
    assert abs(x[0]) < 1e-2
    assert cost < 1e-4
    assert max(abs(tried[0]) for tried in seen[-3:]) < 0.1


def test_where_nothing_falls_the_start_remains() -> None:
    """A gradient of the wrong sign: damped a thousandfold each ... 1e8, and given up."""
    seen: list[Array] = []

    def uphill(x: Array) -> tuple[float, Array, Array]:
        cost, b, A = equations(lambda x: x, seen)(x)
        return cost, -b, A

    cost, x, normal = minimise(uphill, np.array([2.0]))
    assert (cost, x.tolist()) == (4.0, [2.0])
    assert normal[0, 0] == pytest.approx(1.0)
    assert len(seen) == 1 + round(math.log10(1e8 / 1e-3)) + 1


def test_an_unsolvable_system_raises() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        minimise(lambda x: (1.0, x, np.zeros((2, 2))), np.ones(2))


def _to_stations(x: Array, measured: Array) -> tuple[float, Array, Array]:
    """Of distances to four stations, one measured from each."""
    cost, b, A = 0.0, np.zeros(2), np.zeros((2, 2))
    for i in range(4):
        dx, dy = x[0] - 50.0 * (i % 2), x[1] - 40.0 * (i // 2)
        distance = math.sqrt(dx * dx + dy * dy)
        h, r = np.array([dx / distance, dy / distance]), measured[i] - distance
        cost += r * r
        b += r * h
        A += np.outer(h, h)
    return cost, b, A


def test_what_is_compiled_with_its_equations_does_the_same() -> None:
    measured, start = np.array([22.0, 42.0, 30.0, 44.0]), np.array([300.0, -200.0])
    in_python = minimiser(_to_stations, np.linalg.solve)(start, measured)
    compiled = njit(minimiser(njit(_to_stations), solve))(start, measured)
    for found, expected in zip(compiled, in_python, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9)
