"""Position of ``map`` on earth: metres east, north and up of a datum, exact on WGS 84.

``map`` is the tangent plane at the datum: a topocentric frame, no projection. 500 km away the
ground is about 20 km below z = 0, and local east and north are turned against those of ``map``;
``enu_axes`` says how.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from netpos.messages.values import Array

if TYPE_CHECKING:
    from pyproj import Transformer

HEIGHT_MIN_M, HEIGHT_MAX_M = -2e4, 1e6


@dataclass(frozen=True)
class Datum:
    """The origin of ``map``: latitude and longitude [deg, WGS 84], height over the ellipsoid [m].

    Raises ``ValueError`` naming what is out of range.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0

    def __post_init__(self) -> None:
        check_geodetic(self.latitude_deg, self.longitude_deg, self.height_m)

    @cached_property
    def _topocentric(self) -> Transformer:
        from pyproj import Transformer  # noqa: PLC0415 - only who has a datum needs it

        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            "+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
            f"+lat_0={float(self.latitude_deg)!r} +lon_0={float(self.longitude_deg)!r} "
            f"+h_0={float(self.height_m)!r}"
        )

    def to_map(self, geodetic: Array) -> Array:
        """Latitude, longitude [deg], height [m] (k, 3) as metres in ``map`` (k, 3)."""
        latitude, longitude, height = np.asarray(geodetic, float).T
        return np.column_stack(self._topocentric.transform(longitude, latitude, height))

    def to_geodetic(self, places: Array) -> Array:
        """Metres in ``map`` (k, 3) as latitude, longitude [deg], height [m] (k, 3)."""
        x, y, z = np.asarray(places, float).T
        longitude, latitude, height = self._topocentric.transform(x, y, z, direction="INVERSE")
        return np.column_stack([latitude, longitude, height])

    def fix(self, position: Array, cov: Array) -> tuple[Array, Array]:
        """Latitude, longitude [deg], height [m] (3,) of a place (3,) in ``map``, and its
        covariance (3, 3) in local east, north and up there."""
        place = self.to_geodetic(np.asarray(position, float)[None])[0]
        axes = self.enu_axes(place[0], place[1])
        return place, axes.T @ cov @ axes

    def enu_axes(self, latitude_deg: float, longitude_deg: float) -> Array:
        """Local east, north and up at a point, in ``map``: the columns of a rotation (3, 3)."""
        here = _ecef_axes(self.latitude_deg, self.longitude_deg)
        axes: Array = here.T @ _ecef_axes(latitude_deg, longitude_deg)
        return axes


def datum_of_text(text: str) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and height [m] of ``"55.75, 37.62, 150"``.

    Raises ``ValueError`` for anything else, and for what is no place near the earth's surface.
    """
    try:
        values = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) not in (2, 3):
        raise ValueError(
            f"datum must be latitude, longitude [deg] and height [m], got {text!r}; write it as"
            " '55.75, 37.62, 150'"
        )
    latitude, longitude, height = (*values, 0.0)[:3]
    check_geodetic(latitude, longitude, height)
    return latitude, longitude, height


def check_geodetic(latitude_deg: float, longitude_deg: float, height_m: float) -> None:
    """Raises ``ValueError`` for values that are not near the earth's surface."""
    for name, value, low, high in (
        ("latitude", latitude_deg, -90.0, 90.0),
        ("longitude", longitude_deg, -180.0, 180.0),
        ("height", height_m, HEIGHT_MIN_M, HEIGHT_MAX_M),
    ):
        if not low <= value <= high:  # also rejects NaN
            raise ValueError(f"{name} must be in [{low:g}, {high:g}], got {value!r}")


def _ecef_axes(latitude_deg: float, longitude_deg: float) -> Array:
    """East, north and up as columns (3, 3), in earth-centred axes."""
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    sf, cf, sl, cl = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    return np.array([[-sl, -sf * cl, cf * cl], [cl, -sf * sl, cf * sl], [0.0, cf, sf]])
