"""Rows re-weighted in space: as in the plane where all is in one, and seen from all states."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.measurement import (
    AXES,
    BLOCKED,
    GROUP,
    HEADING,
    KIND,
    ROW_WIDTH,
    VALUE,
    Kind,
)
from netpos.estimation.spatial.space import reweight_3d
from netpos.estimation.state import ERR_BIASES, Err, Nav, X
from netpos.estimation.update.conditioning import Robust, RobustOptions, reweight
from netpos.estimation.update.predicted import predicted_rows
from netpos.inertial.strapdown import NAV
from netpos.messages.values import Array

LATE = (0.2, 20.0)


def rows_of(values: list[tuple[Kind, float]], clock_m: float) -> Array:
    """One group a row; RSUs on a circle of 30 m."""
    rows = np.zeros((len(values), ROW_WIDTH))
    rows[:, 4:6] = rows[:, HEADING] = -1
    for i, (kind, error) in enumerate(values):
        angle = 1.0 + 2.0 * i
        rows[i, 7:9] = 30.0 * np.cos(angle), 30.0 * np.sin(angle)
        rows[i, AXES:HEADING] = np.eye(3).ravel()
        rows[i, 2:4] = 0.5 if kind is not Kind.AZIMUTH else 1e-3
        rows[i, [KIND, GROUP]] = kind, i
        exact = np.arctan2(*(-rows[i, 8:6:-1])) if kind is Kind.AZIMUTH else 30.0
        rows[i, VALUE] = exact + error + (clock_m if kind is Kind.TOA else 0.0)
    return rows


@pytest.mark.parametrize("weights", [Robust.NONE, Robust.HUBER, Robust.STUDENT_T])
@pytest.mark.parametrize("late", [(0.0, 1.0), LATE])
def test_in_the_plane_it_is_the_planar_one(weights: Robust, late: tuple[float, float]) -> None:
    rng = np.random.default_rng(1)
    A = 0.3 * rng.normal(size=(4, 4))
    P = A @ A.T + 0.2 * np.eye(4)  # place, offset, drift
    mean, cov = np.zeros(6), np.eye(6)
    mean[X.CLOCK] = 55.0
    place = np.ix_(*[[X.PX, X.PY, X.CLOCK, X.DRIFT]] * 2)
    cov[place] = P
    nav, wide = np.zeros(NAV + 2), np.zeros((ERR_BIASES, ERR_BIASES))
    nav[Nav.QW], nav[Nav.CLOCK] = 1.0, 55.0
    there = np.ix_(*[[Err.PX, Err.PY, Err.CLOCK, Err.DRIFT]] * 2)
    wide[there] = P
    rows = rows_of(
        [(Kind.RANGE, 0.1), (Kind.TOA, 9.0), (Kind.RANGE, 4.0), (Kind.AZIMUTH, 0.2)], 55.0
    )
    planar, spatial = rows.copy(), rows.copy()
    options = RobustOptions(int(weights), 2.0, *late)
    reweight(cov, planar, predicted_rows(mean, cov, planar, 0.0), options)
    reweight_3d(nav, wide, spatial, options)
    np.testing.assert_allclose(spatial, planar, rtol=1e-9)
    changed = not np.array_equal(planar, rows)
    assert changed is (weights is not Robust.NONE or late == LATE)
    if late == LATE:
        assert spatial[1, BLOCKED] > 0.99
        assert spatial[0, BLOCKED] < 0.2
