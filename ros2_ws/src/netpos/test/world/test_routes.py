"""Random routes obey the rules of fokin2020 section 2.4."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from netpos.world.maps import METIS_MADRID
from netpos.world.routes import random_route, rectangle

PERIOD_M = 132.0


@given(st.integers(0, 2**32 - 1))
def test_rules_of_a_random_route(seed: int) -> None:
    route = random_route(METIS_MADRID, np.random.default_rng(seed))
    legs = np.diff(route, axis=0)
    lengths = np.abs(legs).sum(axis=1)
    assert ((legs == 0).sum(axis=1) == 1).all()  # along the streets
    assert ((route >= 0) & (route <= METIS_MADRID.side_m)).all()
    assert np.isin(route[0], METIS_MADRID.centres_m).all()
    back = (legs[1:] * legs[:-1]).sum(axis=1) < 0
    assert not back.any()
    np.testing.assert_allclose(lengths[:-1], PERIOD_M)
    crossings = int((lengths == PERIOD_M).sum())
    at_edge = bool((np.isclose(route[-1], 0) | np.isclose(route[-1], METIS_MADRID.side_m)).any())
    assert at_edge == (lengths[-1] < PERIOD_M)
    assert crossings == 6 or at_edge
    assert 1 <= crossings <= 6


def test_every_turn_is_equally_likely() -> None:
    """Chi-square of left, straight, right at first crossings inside the map."""
    rng = np.random.default_rng(3)
    counts = np.zeros(3)
    for _ in range(3000):
        legs = np.diff(random_route(METIS_MADRID, rng), axis=0)
        if len(legs) < 2:
            continue
        a, b = legs[0], legs[1]
        counts[int(np.sign(a[0] * b[1] - a[1] * b[0])) + 1] += 1
    expected = counts.sum() / 3
    assert ((counts - expected) ** 2 / expected).sum() < 13.8  # chi-square(2), 0.999


def test_same_generator_same_route() -> None:
    a, b = (random_route(METIS_MADRID, np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_rectangle_closes_and_refuses_nonsense() -> None:
    way = rectangle((1, 2), 5.7, 4.5, laps=2)
    np.testing.assert_allclose(way[0], way[-1])
    assert np.hypot(*np.diff(way, axis=0).T).sum() == pytest.approx(2 * 20.4)
    with pytest.raises(ValueError, match="width, height > 0"):
        rectangle((0, 0), 0, 1)
