"""What dead reckoning reports of a person with a length factor and a heading offset of their own.

Values and gradients at all states are in ``test_measurement``, against SciPy's rotations.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from netpos.estimation.engine import scratch
from netpos.estimation.factor import factor
from netpos.estimation.forms import ekf, srukf
from netpos.estimation.measurement import BIAS, COMMON, KIND, Kind, curvature_variance
from netpos.estimation.measurement import predict_row as predict
from netpos.estimation.rows import linear_rows
from netpos.messages.values import Array

NO_GATE = np.array([0.0, np.inf])


def step_rows(u: Array, sd: float, length: int = 6, heading: int = 7) -> Array:
    rows = linear_rows(u, sd**2 * np.eye(2), np.eye(2, 6, k=2), 0)
    rows[:, KIND], rows[:, BIAS], rows[:, COMMON] = Kind.STEP_VELOCITY, length, heading
    return rows


def spread(rng: np.random.Generator) -> Array:
    A = rng.normal(size=(8, 8)) * np.array([1, 1, 0.5, 0.5, 1, 1, 0.1, 0.1])[:, None]
    return np.asarray(A @ A.T)


def test_longer_steps_to_the_left() -> None:
    """Steps 10 % longer than reported and a true heading 0.1 rad to the left of the reported one:
    who goes north at 1.1 m/s is reported at 1 m/s, 0.1 rad to the right of north."""
    row, h = step_rows(np.zeros(2), 1.0), np.empty(8)
    x = np.array([5.0, 6.0, 0.0, 1.1, 0.0, 0.0, math.log(1.1), 0.1])
    east, north = (predict(one, x, 0.0, h) for one in row)
    assert (east, north) == pytest.approx((math.sin(0.1), math.cos(0.1)), rel=1e-14)


@pytest.mark.parametrize(("length", "heading"), [(-1, 7), (6, -1), (-1, -1)])
def test_what_is_not_estimated_is_none(length: int, heading: int) -> None:
    rng = np.random.default_rng(3)
    x, full, h = rng.normal(size=8), np.empty(8), np.empty(8)
    one = step_rows(np.zeros(2), 0.3, length, heading)[0]
    zeroed = x.copy()
    for index, missing in ((6, length), (7, heading)):
        if missing < 0:
            zeroed[index] = 0.0
    value = predict(one, x, 0.0, h)
    assert value == predict(step_rows(np.zeros(2), 0.3)[0], zeroed, 0.0, full)
    np.testing.assert_array_equal(h[:6], full[:6])
    assert [h[6] == 0.0, h[7] == 0.0] == [length < 0, heading < 0]


def second_derivatives(one: Array, x: Array) -> Array:
    """Central differences of the gradient."""
    eps, n = 1e-5, x.size
    result, up, down = np.empty((n, n)), np.empty(n), np.empty(n)
    for i, unit in enumerate(np.eye(n)):
        predict(one, x + eps * unit, 0.0, up)
        predict(one, x - eps * unit, 0.0, down)
        result[i] = (up - down) / (2 * eps)
    return result


@pytest.mark.parametrize(("length", "heading"), [(6, 7), (7, 6), (-1, 7), (6, -1), (-1, -1)])
@pytest.mark.parametrize("seed", range(5))
def test_curvature_is_that_of_all_second_derivatives(seed: int, length: int, heading: int) -> None:
    """Bar-Shalom, Li and Kirubarajan 2001, eq. 10.3.3-12."""
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=8), spread(rng)
    one = step_rows(np.zeros(2), 0.3, length, heading)[1]
    B = second_derivatives(one, x) @ P
    expected = 0.5 * float(np.trace(B @ B))
    assert curvature_variance(one, x, P, 0.0) == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_both_filters_find_the_factor_and_the_offset(row: Any) -> None:
    """A person known to walk at (0.9, -0.4) m/s, steps reported 15 % short and 0.1 rad off: the
    factor is known as well as the speeds reported, one in 100 of them, allow."""
    true, k, a = np.array([0.9, -0.4]), math.log(1.15), 0.1
    c, s = math.cos(a), math.sin(a)
    u = np.array([[c, s], [-s, c]]) @ true / 1.15
    mean = np.array([0.0, 0.0, *true, 0.0, 0.0, 0.0, 0.0])
    cov = np.diag([1.0, 1.0, 1e-10, 1e-10, 1.0, 1.0, 0.01, 0.01])
    sd = 0.05
    rows, accepted = step_rows(u, sd), np.zeros(1)
    L, around = factor(cov), mean.copy()
    work = scratch(8, 2)[0]
    for _ in range(100):
        ekf.update(mean, cov, rows, 0.0, NO_GATE, 8, accepted, work)
        srukf.update(around, L, rows, 0.0, NO_GATE, accepted)
    limit = sd / 10 / math.hypot(*u)
    for x, P in ((mean, cov), (around, L @ L.T)):
        np.testing.assert_allclose(x[6:], [k, a], atol=1e-3)
        expected = 1 / math.sqrt(1 / limit**2 + 100)
        np.testing.assert_allclose(np.sqrt(np.diag(P)[6:]), expected, rtol=0.02)
