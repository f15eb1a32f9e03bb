"""Where the RSUs are: a small YAML or CSV file."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from netpos.bags.errors import BagError
from netpos.bags.importers.common import yaw_quaternion
from netpos.bags.importers.own.records import label, lines, number, problem
from netpos.common.parameters import nearest
from netpos.common.yaml_text import YamlError, load_yaml
from netpos.messages.values import AngleConvention, RsuInfo
from netpos.world.geodesy import Datum, check_geodetic, datum_of_text

_FIELDS = [f.name for f in dataclasses.fields(RsuInfo) if f.name not in ("rsu_id", "stamp_ns")]
_GEODETIC = ("latitude", "longitude", "height")
_KEYS = [*_FIELDS, "yaw_deg", *_GEODETIC]


def read_rsus(file: Path, datum: str = "") -> list[RsuInfo]:
    """RSUs of a file.

    YAML: ``rsus: {a0: [x, y, z]}``, or ``a0: {position: [x, y, z], yaw_deg: 90, ...}`` with any
    field of RsuInfo. CSV: a header ``rsu,x,y,z`` and, where wanted, ``yaw_deg``.

    In place of metres both take ``latitude``, ``longitude`` [deg] and ``height`` [m] on WGS 84,
    ``yaw_deg`` then counts from the local east. They are converted into the map at ``datum:``
    of the YAML file, or ``datum``, a text with the same three numbers.

    Raises
    ------
    BagError  no such file, or an entry that cannot be understood
    """
    if not file.is_file():
        raise BagError(f"{file} does not exist; give a YAML or CSV file with the RSUs' positions")
    if file.suffix in {".yaml", ".yml"}:
        try:
            return rsus_of_text(file.read_text(encoding="utf-8"), str(file), datum)
        except UnicodeDecodeError as error:
            raise BagError(f"{file}: {error}") from error
    found = _from_csv(file, datum)
    names = [info.rsu_id for info in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BagError(f"{file} names {', '.join(twice)} twice")
    return found


def _from_csv(file: Path, datum: str) -> list[RsuInfo]:
    with file.open(encoding="utf-8", errors="replace") as text:
        geodetic = "latitude" in text.readline()
    if geodetic:
        return _from_geodetic_csv(file, _datum(str(file), datum))
    found = []
    for line, _ in lines(file, ["rsu", "x", "y"], None):
        place = [0.0, 0.0, 0.0]
        for axis, name in enumerate("xyz"):
            if name in line.header:
                value = number(line, name, name)
                if value is None:
                    raise problem(line, f"{name} is empty")
                place[axis] = value
        yaw = number(line, "yaw_deg", "yaw_deg") if "yaw_deg" in line.header else 0.0
        found.append(_info(label(line, "rsu"), place, yaw or 0.0))
    return found


def _from_geodetic_csv(file: Path, datum: Datum) -> list[RsuInfo]:
    found = []
    for line, _ in lines(file, ["rsu", "latitude", "longitude"], None):
        given = {n: number(line, n, n) for n in (*_GEODETIC, "yaw_deg") if n in line.header}
        values = {name: value for name, value in given.items() if value is not None}
        found.append(_of_geodetic(str(file), label(line, "rsu"), values, datum))
    return found


def _datum(file: str, datum: Any) -> Datum:
    """The datum of a file. Raises ``BagError`` where none is given."""
    if not datum:
        raise BagError(
            f"{file} gives latitudes and longitudes; give the datum of map too, in the file as"
            " datum: [latitude, longitude, height] or with the parameter datum"
        )
    text = datum if isinstance(datum, str) else " ".join(map(str, datum))
    try:
        return Datum(*datum_of_text(text))
    except ValueError as error:
        raise BagError(f"{file}: {error}") from None


def _of_geodetic(file: str, name: str, values: dict[str, Any], datum: Datum) -> RsuInfo:
    """An RSU whose place is given on the earth; its yaw counts from the local east."""
    # Not at the top: few lists need it, and every tracker would load it.
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    try:
        latitude, longitude = float(values["latitude"]), float(values["longitude"])
        height, yaw = float(values.get("height", 0.0)), float(values.get("yaw_deg", 0.0))
        check_geodetic(latitude, longitude, height)
    except (KeyError, TypeError, ValueError) as error:
        raise BagError(
            f"{file}, {name}: give latitude, longitude [deg] and height [m] ({error})"
        ) from None
    place = datum.to_map(np.array([[latitude, longitude, height]]))[0]
    axes = datum.enu_axes(latitude, longitude)
    turn = Rotation.from_matrix(axes) * Rotation.from_quat(yaw_quaternion(math.radians(yaw)))
    return RsuInfo(rsu_id=name, position=place, quaternion=turn.as_quat())


def rsus_of_text(text: str, file: str, datum: str = "") -> list[RsuInfo]:
    """RSUs of the text of a YAML file named ``file``. Raises ``BagError`` as ``read_rsus``."""
    try:
        content = load_yaml(text)
    except YamlError as error:
        raise BagError(f"{file}: {error}") from error
    entries = content.get("rsus", content) if isinstance(content, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise BagError(f"{file} names no RSU; write it as rsus: {{a0: [x, y, z]}}")
    said = content.get("datum", datum) if "rsus" in content else datum
    return [_of_entry(file, str(name), entry, said) for name, entry in entries.items()]


def _of_entry(file: str, name: str, entry: Any, datum: Any) -> RsuInfo:
    values = {"position": entry} if isinstance(entry, list) else entry
    if not isinstance(values, dict):
        raise BagError(f"{file}, {name}: give [x, y, z] or fields of RsuInfo, got {entry!r}")
    for key in values:
        if key not in _KEYS:
            raise BagError(f"{file}, {name}: no field {key!r}{nearest(str(key), _KEYS)}")
    placed = ("position", "yaw_deg", "quaternion", *_GEODETIC)
    rest = {k: v for k, v in values.items() if k not in placed}
    geodetic = "latitude" in values or "longitude" in values
    if geodetic and "position" in values:
        raise BagError(f"{file}, {name}: give position or latitude and longitude, not both")
    if "angle_convention" in rest:
        rest["angle_convention"] = _convention(file, name, rest["angle_convention"])
    try:
        if geodetic:
            placed_info = _of_geodetic(file, name, values, _datum(file, datum))
        else:
            place = [float(value) for value in values["position"]]
            placed_info = _info(name, place, float(values.get("yaw_deg", 0.0)))
        info = dataclasses.replace(placed_info, **rest)
        if "quaternion" in values:
            info = dataclasses.replace(
                info, quaternion=np.array([float(value) for value in values["quaternion"]])
            )
    except (KeyError, TypeError, ValueError) as error:
        raise BagError(f"{file}, {name}: position must be [x, y, z] in metres ({error})") from None
    return info


def _convention(file: str, name: str, said: Any) -> AngleConvention:
    for convention in AngleConvention:
        if said in (convention.name, convention.value):
            return convention
    names = " or ".join(convention.name for convention in AngleConvention)
    raise BagError(f"{file}, {name}: angle_convention must be {names}, got {said!r}")


def _info(rsu_id: str, place: list[float], yaw_deg: float) -> RsuInfo:
    if len(place) == 2:
        place = [*place, 0.0]
    if len(place) != 3 or not all(math.isfinite(value) for value in place):
        raise BagError(f"RSU {rsu_id}: position must be three finite numbers, got {place}")
    return RsuInfo(
        rsu_id=rsu_id,
        position=np.array(place),
        quaternion=yaw_quaternion(math.radians(yaw_deg)),
    )
