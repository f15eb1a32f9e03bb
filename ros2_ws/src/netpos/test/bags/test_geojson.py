"""A bag as GeoJSON: shapes as RFC 7946 wants them, places against geodesics."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.bags.errors import BagError
from netpos.bags.geojson import geojson_of
from netpos.bags.recording import RecordedValues, write_values
from netpos.messages.values import Field, Odometry, RsuInfo, RsuMeasurement
from pyproj import Geod

LATITUDE, LONGITUDE = 48.1, 11.6
DATUM = f"{LATITUDE}, {LONGITUDE}, 0"
GEOD = Geod(ellps="WGS84")


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """An RSU 1 km east, a device that goes north for 500 m."""
    measured = RsuMeasurement(
        stamp_ns=1, rsu_id="a", vue_id="v", fields=Field.RANGE, range_m=1e3, range_var=1.0
    )
    truth = [
        Odometry(
            stamp_ns=1 + k * 10**9,
            vue_id="v",
            position=np.array([0.0, 100.0 * k, 0.0]),
            quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
            linear_velocity=np.zeros(3),
            angular_velocity=np.zeros(3),
            pose_cov=np.eye(6),
            twist_cov=np.eye(6),
        )
        for k in range(6)
    ]
    rsus = [RsuInfo(rsu_id="a", position=np.array([1000.0, 0.0, 7.5]))]
    write_values(tmp_path / "bag", rsus=rsus, measurements=[measured], truth=truth)
    return tmp_path / "bag"


def test_places_are_where_geodesics_lead(bag: Path) -> None:
    content = json.loads(json.dumps(geojson_of(RecordedValues(bag), DATUM)))
    rsu, line = content["features"]
    assert content["type"] == "FeatureCollection"
    assert rsu["properties"] == {"kind": "rsu", "name": "a"}
    assert (rsu["geometry"]["type"], line["geometry"]["type"]) == ("Point", "LineString")
    longitude, latitude, height = rsu["geometry"]["coordinates"]
    azimuth, _, metres = GEOD.inv(LONGITUDE, LATITUDE, longitude, latitude)
    assert (azimuth, metres) == (pytest.approx(90.0, abs=1e-2), pytest.approx(1000.0, abs=0.01))
    assert height == pytest.approx(7.5 + 1e6 / 2 / 6.39e6, abs=2e-3)  # the ground falls away
    assert line["properties"]["kind"] == "ground truth"
    north = [GEOD.inv(LONGITUDE, LATITUDE, p[0], p[1]) for p in line["geometry"]["coordinates"]]
    assert [round(metres, 2) for *_, metres in north] == [100.0 * k for k in range(6)]
    assert all(abs(azimuth) < 1e-3 for azimuth, _, metres in north if metres > 1.0)


def test_without_a_datum_it_says_what_to_give(bag: Path) -> None:
    with pytest.raises(BagError, match="--datum"):
        geojson_of(RecordedValues(bag))
    with pytest.raises(ValueError, match="latitude must be in"):
        geojson_of(RecordedValues(bag), "95, 0")


@pytest.mark.parametrize("azimuth_deg", [0.0, 77.0, 180.0, 260.0])
@pytest.mark.parametrize("metres", [1e3, 1e5, 5e5])
def test_geodesics_of_500_km(azimuth_deg: float, metres: float) -> None:
    """A place on the ellipsoid at the end of a geodesic is as far away, in a straight line, as the
    closed form of the chord says, and in the direction of the geodesic: to 1 cm."""
    from netpos.world.geodesy import Datum  # noqa: PLC0415

    longitude, latitude, _ = GEOD.fwd(LONGITUDE, LATITUDE, azimuth_deg, metres)
    datum = Datum(LATITUDE, LONGITUDE)
    east, north, up = datum.to_map(np.array([[latitude, longitude, 0.0]]))[0]
    steps: Any = GEOD.npts(LONGITUDE, LATITUDE, longitude, latitude, 2000)
    line = datum.to_map(np.array([[LATITUDE, LONGITUDE, 0.0], *((y, x, 0.0) for x, y in steps),
                                  [latitude, longitude, 0.0]]))  # fmt: skip
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    assert length == pytest.approx(metres, abs=0.01)  # many short chords are the arc
    direction = math.degrees(math.atan2(east, north)) % 360.0
    turned = (direction - azimuth_deg + 180.0) % 360.0 - 180.0
    assert abs(math.radians(turned)) * metres < 150.0  # a geodesic is no normal section
    assert up == pytest.approx(-(metres**2) / 2 / 6.38e6, rel=0.01)
