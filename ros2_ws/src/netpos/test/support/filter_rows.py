"""Rows and covariances for the tests of the filters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from netpos.estimation.measurement import (
    AXES,
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    KIND,
    LEVER,
    ORIGIN,
    ROW_WIDTH,
    VALUE,
    VARIANCE,
    Kind,
)
from netpos.messages.values import Array

NO_GATE = np.full(13, np.inf)


def random_spd(rng: np.random.Generator, n: int) -> Array:
    """Random positive definite (n, n)."""
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


def make_cov(rng: np.random.Generator, n: int, scale: float = 1.0) -> Array:
    """Random positive definite (n, n) of condition below about 1e3."""
    A = rng.normal(size=(n, n))
    return scale * (A @ A.T / n + 0.3 * np.eye(n))


def row(
    kind: Kind,
    value: float,
    variance: float,
    group: int = 0,
    origin: Sequence[float] | Array = (0.0, 0.0, 0.0),
    *,
    axes: Sequence[float] | Array = (1, 0, 0, 0, 1, 0, 0, 0, 1),
    gate_variance: float | None = None,
    bias: int = -1,
    lever_arm: Sequence[float] | Array = (0.0, 0.0, 0.0),
    h: Sequence[float] | Array | None = None,
) -> Array:
    """One row; ``h`` (6,) for LINEAR, which has no origin and axes."""
    out = np.zeros(ROW_WIDTH)
    out[KIND], out[VALUE], out[VARIANCE], out[GROUP] = kind, value, variance, group
    out[GATE_VARIANCE] = variance if gate_variance is None else gate_variance
    out[BIAS], out[COMMON], out[HEADING] = bias, -1, -1
    if h is not None:
        out[ORIGIN : ORIGIN + 6] = h
    else:
        out[ORIGIN:AXES], out[AXES:HEADING] = origin, axes
    out[LEVER : LEVER + 3] = lever_arm
    return out


def linear_row(h: Array, value: float, variance: float, group: int) -> Array:
    """One row of value ``h`` (6,) times the state."""
    return row(Kind.LINEAR, value, variance, group, h=h)
