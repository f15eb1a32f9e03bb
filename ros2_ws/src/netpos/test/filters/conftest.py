"""Rows and random covariances for the tests of the filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from netpos.filters.measurement import (
    AXES,
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    KIND,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.messages.values import Array


def make_row(
    kind: Kind,
    value: float,
    variance: float,
    group: int = 0,
    *,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    axes: Sequence[float] = (1, 0, 0, 0, 1, 0, 0, 0, 1),
    gate_variance: float | None = None,
    bias: int = -1,
    h: Sequence[float] | None = None,
) -> Array:
    """One row; ``h`` (6,) for LINEAR, which has no origin and axes."""
    row = np.zeros(ROW_WIDTH)
    row[KIND], row[VALUE], row[VARIANCE], row[GROUP] = kind, value, variance, group
    row[GATE_VARIANCE] = variance if gate_variance is None else gate_variance
    row[BIAS], row[COMMON], row[HEADING] = bias, -1, -1
    if h is not None:
        row[ORIGIN : ORIGIN + 6] = h
    else:
        row[ORIGIN : ORIGIN + 3], row[AXES : AXES + 9] = origin, axes
    return row


def make_cov(rng: np.random.Generator, n: int, scale: float = 1.0) -> Array:
    """Random positive definite (n, n) of condition below about 1e3."""
    A = rng.normal(size=(n, n))
    return scale * (A @ A.T / n + 0.3 * np.eye(n))


@pytest.fixture
def row() -> Callable[..., Array]:
    return make_row


@pytest.fixture
def random_cov() -> Callable[..., Array]:
    return make_cov
