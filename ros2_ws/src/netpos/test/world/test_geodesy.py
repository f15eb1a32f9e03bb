"""Where on earth: against closed forms that share no code with the library under it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.messages.values import Array
from netpos.world.geodesy import Datum

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
    """4.5 degrees of latitude are 500 km; to a tenth of a millimetre."""
    places = around(datum, 4.5, 1)
    origin = ecef(np.array([[datum.latitude_deg, datum.longitude_deg, datum.height_m]]))
    expected = (ecef(places) - origin) @ axes(datum.latitude_deg, datum.longitude_deg).T
    np.testing.assert_allclose(datum.to_map(places), expected, atol=1e-4)
    assert np.linalg.norm(expected, axis=1).max() > 4e5


@pytest.mark.parametrize("datum", DATUMS)
def test_there_and_back(datum: Datum) -> None:
    places = around(datum, 4.5, 2)
    again = datum.to_geodetic(datum.to_map(places))
    np.testing.assert_allclose(again[:, :2], places[:, :2], atol=1e-9)  # 0.1 mm
    np.testing.assert_allclose(again[:, 2], places[:, 2], atol=1e-4)


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
