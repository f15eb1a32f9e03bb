"""Rows and covariances for the tests of the filters."""

from __future__ import annotations

import numpy as np
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

NO_GATE = np.full(13, np.inf)


def random_spd(rng: np.random.Generator, n: int) -> Array:
    """Random positive definite (n, n)."""
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


def row(kind: Kind, value: float, variance: float, group: int, origin: Array) -> Array:
    """One row of an upright RSU at ``origin`` without biases."""
    out = np.zeros(ROW_WIDTH)
    out[[KIND, VALUE, VARIANCE, GATE_VARIANCE]] = kind, value, variance, variance
    out[[BIAS, COMMON, GROUP, HEADING]] = -1, -1, group, -1
    out[ORIGIN:AXES] = origin
    out[AXES:HEADING] = np.eye(3).reshape(-1)
    return out


def linear_row(h: Array, value: float, variance: float, group: int) -> Array:
    """One row of value ``h`` (6,) times the state."""
    out = row(Kind.LINEAR, value, variance, group, np.zeros(3))
    out[ORIGIN:HEADING] = 0.0
    out[ORIGIN : ORIGIN + 6] = h
    return out
