"""Line of sight against a brute-force sampling of the segment, and at the walls."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.world.buildings import line_of_sight, segment_blocked
from netpos.world.maps import METIS_MADRID

HOUSE = np.array([[0.0, 0.0, 10.0, 10.0]])


def test_agrees_with_sampled_segments_on_the_metis_map() -> None:
    """4 001 points along a segment: the share inside a building decides."""
    rng = np.random.default_rng(5)
    houses = METIS_MADRID.buildings
    share = np.linspace(0, 1, 4001)[:, None]
    blocked = 0
    for a, b in rng.uniform(0, METIS_MADRID.side_m, size=(300, 2, 2)):
        path = a + share * (b - a)
        inside = (path[:, None] > houses[:, :2]).all(2) & (path[:, None] < houses[:, 2:]).all(2)
        expected = bool(inside.any())
        grazing = 0 < inside.sum() < 3  # too short a stretch for the sampling to judge
        if not grazing:
            assert segment_blocked(*a, *b, houses) == expected
        blocked += expected
    assert 100 < blocked < 300


@pytest.mark.parametrize(
    ("a", "b", "clear"),
    [
        ((-5.0, 5.0), (15.0, 5.0), False),  # through
        ((-5.0, 0.0), (15.0, 0.0), True),  # along the wall
        ((0.0, -5.0), (0.0, 15.0), True),  # along the other wall
        ((-5.0, 5.0), (5.0, -5.0), True),  # through a corner point
        ((-5.0, 5.0), (5.0, -4.999), False),  # just inside it
        ((-5.0, 5.0), (0.0, 5.0), True),  # up to the wall
        ((-5.0, 5.0), (0.001, 5.0), False),
        ((5.0, 5.0), (6.0, 6.0), False),  # both ends inside
        ((20.0, 5.0), (15.0, 5.0), True),  # beside it, pointing at it
    ],
)
def test_walls_do_not_block(a: tuple[float, float], b: tuple[float, float], clear: bool) -> None:
    assert line_of_sight([a], b, HOUSE)[0] == clear
    assert line_of_sight([b], a, HOUSE)[0] == clear


def test_no_building_never_blocks() -> None:
    assert line_of_sight([[0, 0], [1, 1]], [5, 5], np.zeros((0, 4))).all()
