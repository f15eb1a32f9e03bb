"""Who hears a beacon: against a plain search over all RSUs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.radio.arrays import AntennaArray, direction_bound
from netpos.radio.measure import (
    ALWAYS_VISIBLE,
    AZIMUTH,
    ELEVATION,
    Errors,
    Sight,
    Sites,
    observe,
)
from netpos.radio.noise import stream_key
from netpos.world.buildings import line_of_sight

HOUSES = np.array(
    [[10.0, 10.0, 40.0, 30.0], [55.0, -20.0, 70.0, 25.0], [-30.0, -40.0, 5.0, -10.0]]
)
FIXED = Errors(
    fixed=np.array([1e-3, 0.0, 1e-16, 0.0, 0.0]),
    with_elevation=False,
    snr_at_0_db_loss=0.0,
    path_loss=np.zeros(5),
    second_moment=np.zeros((3, 3)),
    rms_bandwidth_hz=0.0,
    half_view_rad=math.pi,
    tx_power_dbm=0.0,
)


def _sites(places: np.ndarray) -> Sites:
    keys = np.array([stream_key(1, str(i)) for i in range(len(places))])
    return Sites(
        position=np.column_stack([places, np.zeros(len(places))]),
        rotation=np.tile(np.eye(3), (len(places), 1, 1)),
        noise_key=keys,
        sight_key=keys,
        clock_tones=np.zeros((len(places), 0, 3)),
        baseline_m=np.zeros(len(places)),
        wavelength_m=np.zeros(len(places)),
        range_scale=np.zeros(len(places)),
        range_offset_m=np.zeros(len(places)),
    )


def _plain(position: np.ndarray, places: np.ndarray, nearest: int, reach: float) -> list[int]:
    away = np.sqrt(((position - places) ** 2).sum(axis=1))
    ranked = np.argsort(away, kind="stable")
    visible = [
        int(k)
        for k in ranked
        if away[k] <= reach and line_of_sight(position, places[k], HOUSES)[0]
    ]
    return visible[:nearest]


@pytest.mark.parametrize("nearest", [1, 2, 5])
@pytest.mark.parametrize("reach", [math.inf, 35.0])
def test_the_nearest_in_sight_hear_the_beacon(nearest: int, reach: float) -> None:
    """Places that jump about, RSUs at equal distances (a mirrored pair of each)."""
    rng = np.random.default_rng(11)
    half = rng.uniform(-60.0, 80.0, (20, 2))
    places = np.vstack([half, half * [1.0, -1.0]])
    positions = rng.uniform(-60.0, 80.0, (300, 2)) * [1.0, 0.0]
    positions[::3, 1] = rng.uniform(-60.0, 80.0, 100)
    sight = Sight(nearest, reach, HOUSES, ALWAYS_VISIBLE, 50.0, 1.5)
    seen = observe(
        np.arange(1, 301),
        np.column_stack([positions, np.zeros(300)]),
        np.zeros(300),
        _sites(places),
        sight,
        FIXED,
    )
    counts = set()
    for i, position in enumerate(positions):
        expected = _plain(position, places, nearest, reach)
        assert seen.rsu[i, : seen.heard_by[i]].tolist() == expected
        assert (seen.rsu[i, seen.heard_by[i] :] == -1).all()
        counts.add(len(expected))
    assert len(counts) > 1 or math.isinf(reach)


def test_an_rsu_at_the_antenna_itself_measures_nothing() -> None:
    sight = Sight(2, math.inf, np.zeros((0, 4)), ALWAYS_VISIBLE, 50.0, 1.5)
    sites = _sites(np.array([[3.0, 4.0], [10.0, 0.0]]))
    seen = observe(np.array([1]), np.array([[3.0, 4.0, 0.0]]), np.zeros(1), sites, sight, FIXED)
    assert seen.rsu.tolist() == [[1, -1]]


def test_an_array_serves_its_field_of_view_only() -> None:
    """Boresight east, 120 degrees: at 60 degrees just heard, beyond not; the next one is."""
    sight = Sight(1, math.inf, np.zeros((0, 4)), ALWAYS_VISIBLE, 50.0, 1.5)
    sites = _sites(np.array([[0.0, 0.0], [-50.0, 0.0]]))
    errors = FIXED._replace(half_view_rad=math.radians(60.0))
    places = [[math.cos(a), math.sin(a), 0.0] for a in np.radians([59.99, 60.01, 180.0])]
    seen = observe(np.array([1, 2, 3]), np.array(places), np.zeros(3), sites, sight, errors)
    assert seen.rsu[:, 0].tolist() == [0, 1, 1]


def test_a_number_of_rsus_is_drawn_for_each_beacon() -> None:
    """Evenly from fewest to nearest, always the nearest ones, and the same for the same stamp."""
    places = np.array([[10.0 * i, 0.0] for i in range(1, 9)])
    nearest = Sight(8, math.inf, np.zeros((0, 4)), ALWAYS_VISIBLE, 50.0, 1.5, 4)
    n = 5000
    stamps = np.arange(1, n + 1)
    sites = _sites(places)
    seen = observe(stamps, np.zeros((n, 3)), np.zeros(n), sites, nearest, FIXED)
    counts = np.bincount(seen.heard_by, minlength=9)
    assert counts[:4].sum() == 0
    np.testing.assert_allclose(counts[4:] / n, 0.2, atol=4 * math.sqrt(0.16 / n))
    for i in range(50):
        assert seen.rsu[i].tolist() == [*range(seen.heard_by[i])] + [-1] * (8 - seen.heard_by[i])
    again = observe(stamps[7:], np.zeros((n - 7, 3)), np.zeros(n - 7), sites, nearest, FIXED)
    np.testing.assert_array_equal(again.heard_by, seen.heard_by[7:])


@pytest.mark.parametrize(("rows", "columns"), [(4, 16), (16, 4)])
def test_azimuth_and_elevation_have_each_its_own_bound(rows: int, columns: int) -> None:
    """Variances and scatter of both, against the bound of the array; a planar array of 4 rows and
    16 columns tells the azimuth better than the elevation, the other one worse."""
    array = AntennaArray(kind="planar", rows=rows, columns=columns)
    errors = FIXED._replace(
        with_elevation=True,
        snr_at_0_db_loss=1e10,
        path_loss=np.array([20.0, 30.0, math.inf, 0.0, 0.0]),
        second_moment=array.second_moment(),
        rms_bandwidth_hz=1e6,
    )
    azimuth, elevation, away, n = 0.5, 0.3, 40.0, 4000
    flat = away * math.cos(elevation)
    position = [
        flat * math.cos(azimuth),
        flat * math.sin(azimuth),
        away * math.sin(elevation),
    ]
    sight = Sight(1, math.inf, np.zeros((0, 4)), ALWAYS_VISIBLE, 50.0, 1.5)
    sites = _sites(np.zeros((1, 2)))
    seen = observe(
        np.arange(1, n + 1), np.tile(position, (n, 1)), np.zeros(n), sites, sight, errors
    )
    snr = 1e10 * 10.0 ** (-(20.0 + 30.0 * math.log10(away)) / 10.0)
    bound = np.diag(direction_bound(array, snr, azimuth, elevation))
    better, worse = sorted(bound)
    assert better < 0.5 * worse
    assert (better == bound[0]) == (columns > rows)
    both = [AZIMUTH, ELEVATION]
    np.testing.assert_allclose(seen.variances[0, 0, both], bound, rtol=1e-9)
    scatter = seen.values[:, 0, both] - [azimuth, elevation]
    four_sd = 4.0 * math.sqrt(2.0 / n)
    np.testing.assert_allclose((scatter**2).mean(axis=0), bound, rtol=four_sd)
