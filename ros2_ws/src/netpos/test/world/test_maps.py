"""The METIS grid has the dimensions of fokin2020 section 2.4."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.world.maps import (
    METIS_KERB_OFFSET_M,
    METIS_MADRID,
    METIS_RSU_SPACING_M,
    StreetGrid,
)


def test_blocks_streets_and_crossings() -> None:
    houses = METIS_MADRID.buildings
    assert houses.shape == (16, 4)
    assert METIS_MADRID.side_m == 4 * 120 + 5 * 12
    np.testing.assert_allclose(houses[:, 2:] - houses[:, :2], 120.0)
    np.testing.assert_allclose(np.diff(np.unique(houses[:, 0])), 132.0)
    np.testing.assert_allclose(METIS_MADRID.centres_m, [6, 138, 270, 402, 534])


def test_rsus_stand_every_60_m_in_the_streets_and_off_every_centre_line() -> None:
    places = METIS_MADRID.lamp_posts(METIS_RSU_SPACING_M, METIS_KERB_OFFSET_M)
    assert len(places) == 10 * 10
    assert len(np.unique(places, axis=0)) == 100
    street = places[:10]  # the southernmost, west to east
    np.testing.assert_allclose(np.diff(street[:, 0]), 60.0)
    houses = METIS_MADRID.buildings
    inside = (places[:, None] > houses[:, :2]).all(2) & (places[:, None] < houses[:, 2:]).all(2)
    assert not inside.any()
    off_centre = np.abs(places[:, :, None] - METIS_MADRID.centres_m).min(axis=(1, 2))
    assert off_centre.min() >= METIS_KERB_OFFSET_M - 1e-9


@pytest.mark.parametrize("offset", [0.0, 6.1, float("nan")])
def test_a_post_on_the_centre_line_or_in_a_house_is_refused(offset: float) -> None:
    with pytest.raises(ValueError, match="kerb_offset_m"):
        METIS_MADRID.lamp_posts(60.0, offset)


def test_an_empty_grid_is_refused() -> None:
    with pytest.raises(ValueError, match=r"grid\.blocks must be > 0, got 0"):
        StreetGrid(blocks=0, block_m=120.0, street_m=12.0)
