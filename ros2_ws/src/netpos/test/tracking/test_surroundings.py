"""Where a device can be among the RSUs that hear it."""

from __future__ import annotations

import numpy as np
import pytest
from first_fix import at, measure, rsu
from netpos.estimation.measurement import BIAS
from netpos.messages.values import AngleConvention, Field
from netpos.tracking.first_fix.surroundings import NEAREST_M, Surroundings
from netpos.tracking.rsus.rsu import Rsu


def among(
    stations: list[Rsu], fields: Field, height_m: float = 0.0, heights: int = 0
) -> Surroundings:
    """Surroundings by a measurement of each of the stations."""
    rows = np.vstack([measure(s, at(20.0, 15.0), fields) for s in stations])
    return Surroundings(rows, stations, height_m, heights)


@pytest.mark.parametrize("fields", [Field.AZIMUTH, Field.TOA, Field.AZIMUTH | Field.TOA])
def test_nobody_is_on_top_of_an_rsu_that_measures_no_distance(fields: Field) -> None:
    """The time that a single RSU measures has the clock in it."""
    around = among([rsu(3, 4)], fields)
    for off, there in ((0.9 * NEAREST_M, True), (1.1 * NEAREST_M, False)):
        assert around.is_on_rsu(at(3.0, 4.0 + off)) is there
        assert around.is_possible(at(3.0 - off, 4.0)) is not there


@pytest.mark.parametrize("fields", [Field.RANGE, Field.AZIMUTH | Field.RANGE])
def test_a_range_may_be_short(fields: Field) -> None:
    around = among([rsu(3, 4)], fields)
    assert not around.is_on_rsu(at(3.0, 4.2))
    assert around.is_possible(at(3.0, 4.2))


def test_times_of_two_rsus_tell_distances() -> None:
    around = among([rsu(3, 4), rsu(30, 4)], Field.TOA)
    assert around.is_possible(at(3.0, 4.2))


def test_an_rsu_above_is_as_far_as_it_is_high() -> None:
    """The height of the device, and what the fit adds to it, count."""
    above = rsu(3, 4, position=np.array([3.0, 4.0, 2.5]))
    assert not among([above], Field.AZIMUTH, 1.0).is_on_rsu(at(3.0, 4.0))
    assert among([above], Field.AZIMUTH, 2.0).is_on_rsu(at(3.0, 4.0))
    around = among([above], Field.AZIMUTH, 1.0, heights=1)
    assert around.is_on_rsu(np.append(at(3.0, 4.0), 1.2))
    assert not around.is_on_rsu(np.append(at(3.0, 4.0), 0.1))


def test_arrays_without_a_back_are_faced() -> None:
    cone = rsu(0, 0, 90.0, angle_convention=AngleConvention.CONE)
    antennas = rsu(0, 0, 90.0, baseline_m=0.1, wavelength_m=0.125)
    for station in (cone, antennas):
        around = among([station], Field.AZIMUTH)
        assert around.is_possible(at(5.0, 3.0))
        assert not around.is_possible(at(5.0, -3.0))
    assert among([rsu(0, 0, 90.0)], Field.AZIMUTH).is_possible(at(5.0, -3.0))


def test_the_way_from_the_nearest_rsu() -> None:
    around = among([rsu(0, 0), rsu(40, 0)], Field.AZIMUTH)
    np.testing.assert_allclose(around.from_nearest(np.array([30.0, 5.0])), [-10.0, 5.0])
    np.testing.assert_allclose(around.from_nearest(np.array([10.0, 5.0])), [10.0, 5.0])


def test_a_fix_without_rsus_may_be_anywhere() -> None:
    rows = measure(rsu(0, 0), at(20.0, 15.0), Field.POSITION)
    rows[:, BIAS] = -1
    around = Surroundings(rows, [], 0.0, 0)
    assert around.is_possible(at(0.0, 0.0))
