"""What a shift of the position leaves of residuals, against places that are known."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.measurement import ROW_WIDTH, VALUE, linearise
from netpos.estimation.rows import put_measurement
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking.rsus.rsu import Rsu
from netpos.tracking.rsus.shift import unshifted

PLACE = np.array([2.4, 3.6, 0.0, 0.0, 0.0, 0.0])
WALLS = [(0.0, 3.0, 0.0), (6.0, 0.0, 90.0), (12.0, 3.0, 180.0), (6.0, 6.0, -90.0)]
SD = np.full(8, 0.1)


def rows_of(biases: Array) -> Array:
    """(8, ROW_WIDTH): what four arrays on the walls of a room measure at ``PLACE``, with errors
    (8,) of their direction cosines."""
    rows = np.zeros((8, ROW_WIDTH))
    for i, (x, y, facing) in enumerate(WALLS):
        half = np.radians(facing) / 2.0
        rsu = Rsu.of(
            RsuInfo(
                rsu_id=f"a{i}",
                position=np.array([x, y, 2.3]),
                quaternion=np.array([0.0, 0.0, np.sin(half), np.cos(half)]),
                angle_convention=AngleConvention.CONE,
            )
        )
        m = RsuMeasurement(
            stamp_ns=1,
            rsu_id=f"a{i}",
            vue_id="vue_1",
            fields=Field.AZIMUTH | Field.ELEVATION,
            azimuth_var=0.01,
            elevation_var=0.01,
        )
        put_measurement(rows, 2 * i, m, (rsu.cone, rsu.place, None), i, -1)
    at_place, _ = linearise(rows, PLACE, 1.1)
    rows[:, VALUE] += biases - at_place
    return rows


def left_of(biases: Array, believed: Array) -> tuple[Array, Array]:
    """``unshifted`` seen from a believed place (6,)."""
    rows = rows_of(biases)
    residuals, _ = linearise(rows, believed, 1.1)
    left, checked, _ = unshifted(rows, residuals, SD, believed, 1.1, np.zeros(8))
    return left, checked


@pytest.mark.parametrize("wrong", [(0.0, 0.0), (2.0, -1.5), (-1.5, 1.5), (5.0, -2.0)])
def test_a_track_that_is_wrong_is_no_error_of_the_rsus(wrong: tuple[float, float]) -> None:
    believed = PLACE.copy()
    believed[:2] += wrong
    left, checked = left_of(np.zeros(8), believed)
    assert np.abs(left).max() < 1e-3
    assert checked.sum() == pytest.approx(6.0)  # eight values, two unknowns


def test_an_error_looks_the_same_from_wherever_the_track_is() -> None:
    biases = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    here, _ = left_of(biases, PLACE)
    believed = PLACE.copy()
    believed[:2] += (1.5, -1.0)
    there, _ = left_of(biases, believed)
    assert np.abs(here - there).max() < 5e-3
    assert here[3] > 0.2
    assert np.abs(here).argmax() == 3


def test_two_ranges_leave_nothing() -> None:
    """As many unknowns as values: any residual is a shift."""
    rows = rows_of(np.zeros(8))[:2]
    left, checked, beside = unshifted(
        rows, np.array([0.05, -0.03]), SD[:2], PLACE, 1.1, np.array([3.0, 4.0])
    )
    assert np.abs(left).max() < 1e-9
    assert np.abs(checked).max() < 1e-9
    assert np.abs(beside).max() < 1e-9


def test_other_residuals_are_freed_of_the_same_shifts() -> None:
    """As least squares with the weights of the residuals leaves them."""
    rows, sd = rows_of(np.zeros(8)), np.linspace(0.05, 0.2, 8)
    other = np.arange(8.0)
    left, _, beside = unshifted(rows, np.zeros(8), sd, PLACE, 1.1, other)
    _, H = linearise(rows, PLACE, 1.1)
    A = H[:, :2] / sd[:, None]
    shift, *_ = np.linalg.lstsq(A, other / sd)
    np.testing.assert_allclose(beside, other - H[:, :2] @ shift, atol=1e-9)
    np.testing.assert_array_equal(left, 0.0)
