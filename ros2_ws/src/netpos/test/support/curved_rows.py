"""Rows that bend over the width of their prior, for the tests of iterated updates."""

from __future__ import annotations

import numpy as np
from filter_rows import row
from netpos.estimation.measurement import (
    ORIGIN,
    SAME_BEND,
    VARIANCE,
    Kind,
    curvature_mean,
    curvature_variance,
    linearise,
)
from netpos.estimation.state import POSITION, VELOCITY, X
from netpos.messages.values import Array


def log_posterior_cost(rows: Array, mean: Array, cov: Array, height: float, x: Array) -> float:
    """Twice the negative log posterior, plainly."""
    innovation, _ = linearise(rows, x, height)
    return float(
        (x - mean) @ np.linalg.inv(cov) @ (x - mean) + np.sum(innovation**2 / rows[:, VARIANCE])
    )


def range_problem(seed: int) -> tuple[Array, Array, Array]:
    """A wide prior, two precise ranges and a bearing: strongly curved."""
    rng = np.random.default_rng(seed)
    mean = np.array([10.0, 8.0, 1.0, 0.0, 0.0, 0.0]) + rng.normal(size=6) * 0.5
    cov = np.diag([30.0, 20.0, 1.0, 1.0, 1.0, 1.0])
    cov[X.PX, X.VX] = cov[X.VX, X.PX] = 2.0
    rows = np.array(
        [
            row(Kind.RANGE, 10.0, 0.01, 0, np.array([0.0, 0.0, 0.0])),
            row(Kind.RANGE, 9.0, 0.01, 1, np.array([12.0, 0.0, 0.0])),
            row(Kind.AZIMUTH, 0.9, 0.01, 2, np.array([0.0, 0.0, 0.0])),
        ]
    )
    return mean, cov, rows


def bends(mean: Array, cov: Array, rows: Array, height_m: float = 0.0) -> Array:
    """How far the mean of each row is above its value at the mean."""
    return np.array([curvature_mean(r, mean, cov, height_m) for r in rows])


def two_variances(mean: Array, cov: Array, rows: Array) -> Array:
    """Variances of an update: the rows' and the curvature's."""
    extra = [curvature_variance(r, mean, cov, 0.0) for r in rows]
    return np.asarray(rows[:, VARIANCE] + extra)


def values_of_a_bend(mean: Array, rows: Array) -> Array:
    """How many values have the bend of each row: those of a second, or of a twentieth of the
    distance."""
    distance = np.linalg.norm(mean[POSITION] - rows[:, ORIGIN : ORIGIN + 2], axis=1)
    speed = max(float(np.linalg.norm(mean[VELOCITY])), 1e-9)
    values: Array = 1.0 + rows[:, SAME_BEND]
    return np.maximum(values * np.minimum(distance / 20.0 / speed, 1.0), 1.0)
