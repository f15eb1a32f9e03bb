"""What a bag holds as GeoJSON (RFC 7946): RSUs as points, tracks and ground truth as lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netpos.bags.errors import BagError
from netpos.bags.recording import RecordedValues
from netpos.common.yaml_text import load_yaml
from netpos.messages.values import Array, Odometry
from netpos.world.geodesy import Datum, datum_of_text

_DIGITS = 8  # of a degree: 1 mm


def geojson_of(recording: RecordedValues, datum: str = "") -> dict[str, Any]:
    """A FeatureCollection; coordinates are longitude, latitude [deg], height [m].

    datum : latitude, longitude and height of the map's origin; empty: the one of the tracker.

    Raises
    ------
    BagError  neither says where on earth the map is
    ValueError  ``datum`` is no place
    """
    said = datum or _datum_of(recording)
    if not said:
        raise BagError(
            "the bag does not say where on earth it is; give the datum of its map, such as"
            " --datum '55.75, 37.62, 150'"
        )
    at = Datum(*datum_of_text(said))
    features = [
        _feature("Point", _places(at, info.position[None])[0], kind="rsu", name=info.rsu_id)
        for info in {info.rsu_id: info for info in recording.rsus}.values()
    ]
    for kind, tracks in (("track", recording.odometry), ("ground truth", recording.truth)):
        for name, poses in tracks.items():
            if len(poses) > 1:
                features.append(_track(at, kind, name, poses))
    return {"type": "FeatureCollection", "features": features}


def _datum_of(recording: RecordedValues) -> str:
    for text in recording.facts.get("tracker", ()):
        parameters = load_yaml(text)
        if isinstance(parameters, dict) and parameters.get("datum"):
            return str(parameters["datum"])
    return ""


def _track(at: Datum, kind: str, name: str, poses: Sequence[Odometry]) -> dict[str, Any]:
    places = _places(at, np.array([pose.position for pose in poses]))
    first, last = poses[0].stamp_ns, poses[-1].stamp_ns
    return _feature(
        "LineString", places, kind=kind, name=name, start_s=first * 1e-9, end_s=last * 1e-9
    )


def _places(at: Datum, positions: Array) -> list[list[float]]:
    return [
        [round(longitude, _DIGITS), round(latitude, _DIGITS), round(height, 3)]
        for latitude, longitude, height in at.to_geodetic(positions).tolist()
    ]


def _feature(shape: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": {"type": shape, "coordinates": coordinates},
        "properties": properties,
    }
