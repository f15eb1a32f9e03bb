"""Fixes of whole drives at once, against closed forms and SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.engine import Epochs
from netpos.estimation.fixes.position_fix import FixStatus
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.reproduction.deng2022.drives import fix_each
from scipy.optimize import least_squares

RANGE_SD_M = 0.5
RING = np.array([[0.0, 0.0], [80.0, 10.0], [70.0, 90.0], [-10.0, 60.0]])


def ranged(stations: Array, ranges: Array) -> Epochs:
    """One epoch of ranges (m,) to stations (m, 3)."""
    blocks = []
    for i, (station, range_m) in enumerate(zip(stations, ranges, strict=True)):
        info = RsuInfo(rsu_id=f"s{i}", position=station)
        measurement = RsuMeasurement(
            stamp_ns=1,
            rsu_id=info.rsu_id,
            vue_id="v",
            fields=Field.RANGE,
            range_m=float(range_m),
            range_var=RANGE_SD_M**2,
        )
        blocks.append(rsu_rows(measurement, info, rsu_axes(info), i))
    rows = np.vstack(blocks)
    return Epochs(np.array([1]), np.array([0, len(rows)]), rows)


@pytest.mark.parametrize("height_sd_m", [0.1, 0.5, 3.0])
def test_stations_level_with_the_device_leave_the_height_as_known(height_sd_m: float) -> None:
    """Level ranges tell nothing of the height: its variance is the square of the sd given."""
    stations = np.column_stack([RING, np.full(4, 1.5)])
    place = np.array([30.0, 40.0, 1.5])
    fixes = fix_each(ranged(stations, np.linalg.norm(stations - place, axis=1)), 1.5, height_sd_m)
    assert fixes.status[0] == FixStatus.CONVERGED
    np.testing.assert_allclose(fixes.position[0], place, atol=1e-6)
    assert fixes.cov[0, 2, 2] == pytest.approx(height_sd_m**2, rel=1e-6)


@pytest.mark.parametrize("height_sd_m", [0.2, 2.0])
def test_a_known_height_weighs_as_its_variance(height_sd_m: float) -> None:
    """Stations above the device, ranges with errors and a height 1 m off: SciPy's least squares
    with the height over its sd as one more residual."""
    rng = np.random.default_rng(17)
    stations = np.column_stack([RING, [8.0, 14.0, 6.0, 11.0]])
    place = np.array([30.0, 40.0, 1.5])
    ranges = np.linalg.norm(stations - place, axis=1) + rng.normal(scale=RANGE_SD_M, size=4)

    def residuals(p: Array) -> Array:
        off = (np.linalg.norm(stations - p, axis=1) - ranges) / RANGE_SD_M
        return np.append(off, (p[2] - 2.5) / height_sd_m)

    best = least_squares(residuals, place, xtol=1e-12, ftol=1e-12)
    fixes = fix_each(ranged(stations, ranges), 2.5, height_sd_m)
    assert fixes.status[0] == FixStatus.CONVERGED
    np.testing.assert_allclose(fixes.position[0], best.x, atol=0.02 * height_sd_m)
    cov = np.linalg.inv(best.jac.T @ best.jac)
    assert math.sqrt(fixes.cov[0, 2, 2]) == pytest.approx(math.sqrt(cov[2, 2]), rel=0.02)
