"""Where on earth: against closed forms that share no code with the library under it."""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from netpos.messages.values import Array
from netpos.world.geodesy import Datum
from pyproj import Geod
from scipy.spatial.transform import Rotation

A_M, F = 6378137.0, 1.0 / 298.257223563  # WGS 84
E2 = F * (2.0 - F)


def ecef(geodetic: Array) -> Array:
    """Earth-centred metres of latitude, longitude [deg], height [m]: the textbook formula."""
    lat, lon = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    n = A_M / np.sqrt(1.0 - E2 * np.sin(lat) ** 2)
    r = (n + geodetic[:, 2]) * np.cos(lat)
    z = (n * (1.0 - E2) + geodetic[:, 2]) * np.sin(lat)
    return np.column_stack([r * np.cos(lon), r * np.sin(lon), z])


def axes(latitude_deg: float, longitude_deg: float) -> Array:
    """East, north, up as rows, by rotating about z, then y."""
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    c, s = math.cos(lon), math.sin(lon)
    about_z = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    c, s = math.cos(lat), math.sin(lat)
    about_y = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    up_east_north: Array = about_y @ about_z
    return up_east_north[[1, 2, 0]]


def around(datum: Datum, reach_deg: float, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    offsets_deg = rng.uniform(-reach_deg, reach_deg, (200, 2))
    centre = [datum.latitude_deg, datum.longitude_deg]
    return np.column_stack([centre + offsets_deg, rng.uniform(-100.0, 3000.0, 200)])


DATUMS = [Datum(55.75, 37.62, 150.0), Datum(-33.9, 151.2, 5.0), Datum(0.0, 0.0), Datum(79, -12.0)]


@pytest.mark.parametrize("datum", DATUMS)
def test_map_is_the_tangent_plane_over_500_km(datum: Datum) -> None:
    """4.5 degrees of latitude are 500 km. An earth-centred coordinate, 6.4e6 m, is rounded six
    times by 1.1e-16; two differ, and three are rotated: 4 * 6 * 1.1e-16 * 6.4e6 m, twice."""
    places = around(datum, 4.5, 1)
    origin = ecef(np.array([[datum.latitude_deg, datum.longitude_deg, datum.height_m]]))
    expected = (ecef(places) - origin) @ axes(datum.latitude_deg, datum.longitude_deg).T
    bound_m = 2 * 4 * 6 * 2.0**-53 * A_M
    np.testing.assert_allclose(datum.to_map(places), expected, rtol=0, atol=bound_m)
    assert bound_m < 1e-6
    assert np.linalg.norm(expected, axis=1).max() > 4e5


@pytest.mark.parametrize("datum", DATUMS)
def test_there_and_back(datum: Datum) -> None:
    places = around(datum, 4.5, 2)
    again = datum.to_geodetic(datum.to_map(places))
    np.testing.assert_allclose(again[:, :2], places[:, :2], rtol=0, atol=8e-12)  # 1 um
    np.testing.assert_allclose(again[:, 2], places[:, 2], rtol=0, atol=1e-6)


def test_local_axes_far_from_the_datum() -> None:
    """Small steps east, north and up of a place 400 km away are what its axes say."""
    datum, lat, lon, height = DATUMS[0], 58.0, 42.0, 200.0
    turn = datum.enu_axes(lat, lon)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    step = 1e-5
    places = np.array(
        [
            *([lat, lon - step, height], [lat, lon + step, height], [lat - step, lon, height]),
            *([lat + step, lon, height], [lat, lon, height - 1.0], [lat, lon, height + 1.0]),
        ]
    )
    local = datum.to_map(places)
    for column, (before, after) in enumerate([(0, 1), (2, 3), (4, 5)]):
        direction = local[after] - local[before]
        np.testing.assert_allclose(
            turn[:, column], direction / np.linalg.norm(direction), atol=1e-6
        )
    assert math.degrees(math.acos(turn[2, 2])) > 3.0


@pytest.mark.parametrize(
    ("values", "name"),
    [
        *(((90.1, 0, 0), "latitude"), ((0, -180.1, 0), "longitude")),
        *(((0, 0, 2e6), "height"), ((math.nan, 0, 0), "latitude")),
    ],
)
def test_no_place_on_earth(values: tuple[float, float, float], name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be in"):
        Datum(*values)


def up_bound(way_m: float) -> float:
    """How far the normal turns on a way [rad]: at most with the largest curvature of the
    ellipsoid, that of the meridian at the equator."""
    return way_m / (A_M * (1.0 - E2))


def north_bound(way_m: float, latitude_deg: float) -> float:
    """How far north turns about it [rad]: by sin(azimuth) tan(latitude) / N a metre, N >= a."""
    highest = math.radians(abs(latitude_deg)) + up_bound(way_m)
    return way_m / A_M * math.tan(highest)


@pytest.mark.parametrize("datum", DATUMS)
@pytest.mark.parametrize("way_m", [5e3, 5e4, 5e5])
def test_directions_far_away_turn_less_than_their_bounds(datum: Datum, way_m: float) -> None:
    """Places by geodesics (Karney), axes against those of the test, tilt and turn apart."""
    centre = axes(datum.latitude_deg, datum.longitude_deg)
    tilts, turns = [], []
    for azimuth in np.arange(0.0, 360.0, 15.0):
        start = datum.longitude_deg, datum.latitude_deg
        longitude, latitude, _ = Geod(ellps="WGS84").fwd(*start, azimuth, way_m)
        there = datum.enu_axes(latitude, longitude)
        np.testing.assert_allclose(there, centre @ axes(latitude, longitude).T, atol=4e-15)
        up = there[:, 2]
        across = np.cross([0.0, 0.0, 1.0], up)
        tilts.append(math.atan2(np.linalg.norm(across), up[2]))
        back = Rotation.from_rotvec(-tilts[-1] * across / np.linalg.norm(across)).as_matrix()
        turned = back @ there
        turns.append(abs(math.atan2(turned[1, 0], turned[0, 0])))
    assert 0.98 * up_bound(way_m) < max(tilts) <= up_bound(way_m)
    bound = north_bound(way_m, datum.latitude_deg)
    assert (0.2 if datum.latitude_deg == 0.0 else 0.5) * bound < max(turns) <= bound


def test_the_bounds_are_those_of_the_page() -> None:
    text = (Path(__file__).resolve().parents[5] / "docs/running_the_tracker.md").read_text("utf-8")
    for row, bound, digits in (
        ("up", up_bound, [2, 1, 1]),
        ("north", partial(north_bound, latitude_deg=55.75), [2, 1, 1]),
    ):
        (line,) = (line for line in text.splitlines() if line.startswith(f"| {row} |"))
        shown = re.findall(r"([\d.]+)° \|", line)
        ways = (5e3, 5e4, 5e5)
        assert shown == [
            f"{math.degrees(bound(w)):.{n}f}" for w, n in zip(ways, digits, strict=True)
        ]
