"""Recordings without an importer of their own: read by their columns, or written as a bag from
Python, as docs/own_recording.md says."""

from __future__ import annotations

import csv
import gzip
import json
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from netpos import write_bag
from netpos.bags.importers.own.columns import SPEED_OF_LIGHT_MPS, Columns
from netpos.bags.importers.own.recording import Truth, import_csv, import_ros
from netpos.bags.importers.own.truth import Poses, TruthColumns
from netpos.messages.values import Array, Field, Odometry, RsuInfo, RsuMeasurement
from netpos.world.geodesy import Datum

TDOA_ANCHORS_M = np.array(
    [
        (-2.4175, -4.0208, 0.1818),
        (-2.8205, 3.5250, 2.5874),
        (3.4819, 3.3050, 0.1545),
        (3.4507, -3.7181, 2.6693),
        (-3.2776, -3.8690, 2.6739),
        (3.2655, -3.6511, 0.1752),
        (3.8321, 3.6521, 2.6249),
        (-2.7228, 3.2191, 0.1583),
    ]
)
TDOA_HEIGHT_M, TDOA_HEIGHT_SD_M, TDOA_ARM_M = 1.5, 1.0, 0.0908
UWB_SD_M = 0.2
SHEET_SD_M = 0.1
BEACON_SD_M = 0.5
IASL_CORNERS_M = ((0.0, 0.0), (0.0, 8.0), (8.86, 8.0), (8.86, 0.0))
IASL_HEIGHT_M = 1.4  # at which it flies most of the time
AIRCRAFT = {
    "learn_errors": True,
    "device_height_m": 8000.0,
    "device_height_sd_m": 3000.0,
    "initial_speed_sd_mps": 200.0,
    "initial_position_sd_max_m": 2000.0,
}
"""Between the ground and 13 km, up to 250 m/s; where receivers are 100 km apart, a fix to a
kilometre or two is one."""
ADSB_SETS, ADSB_APART_NS = (1, 2, 5, 6), 7_200_000_000_000
ARRIVAL_SD_M = 30.0  # a sample of 10 MHz
FLAT_M = 4e5  # the map is a plane: 12 km above the ground at this distance
# The set names none: about what it shows itself where paths are direct.
STATION_SD_M, AZIMUTH_SD_RAD = 1.0, math.radians(2.0)


def import_uwb_tdoa(folder: Path, bag: Path) -> object:
    """Time differences of eight anchors to a drone, one pair after the other. Its height is
    unknown but for that of a room; its antenna is above the tracked body, as the authors say."""
    file = folder / "const1_trial1_tdoa2.csv.gz"
    return import_csv(
        file,
        bag,
        Columns.parse(
            "time=t_tdoa,rsu=idB,reference=idA,tdoa=tdoa_meas",
            "tdoa=m",
            f"tdoa={SHEET_SD_M}",
            lever_arm_m=(0.0, 0.0, TDOA_ARM_M),
        ),
        [
            RsuInfo(rsu_id=str(name), position=position)
            for name, position in enumerate(TDOA_ANCHORS_M)
        ],
        truth=Truth(
            source=file,
            columns=TruthColumns.parse("time=t_pose,x=pose_x,y=pose_y,z=pose_z"),
        ),
        tracker={"device_height_m": TDOA_HEIGHT_M, "device_height_sd_m": TDOA_HEIGHT_SD_M},
    )


def import_four_anchors(folder: Path, bag: Path) -> object:
    """Ranges of four anchors to a walking person (a ROS 1 bag)."""
    position_columns = ",".join(f"rsu_{axis}=responder_location.{axis}" for axis in "xyz")
    return import_ros(
        folder / "data_example.bag",
        bag,
        Columns.parse(
            f"time=header.stamp,rsu=responder_id,range=distance,{position_columns}",
            sd=f"range={SHEET_SD_M}",
        ),
        "/uwb_endorange_info",
        [],
        truth=Truth(
            source="/vicon_xb/viconPoseTopic",
            columns=TruthColumns.parse(
                "time=header.stamp,x=pose.position.x,y=pose.position.y,z=pose.position.z"
            ),
        ),
        tracker={"device_height_m": 1.18},
    )


def import_iasl(folder: Path, bag: Path) -> object:
    """Ranges of eight anchors; the truth has axes and a clock of its own. Of its rows one has
    zeros for a rotation: there the cameras have not seen the body."""
    places = [(x, y, z) for z in (0.0, 2.2) for x, y in IASL_CORNERS_M]
    names = range(1, len(places) + 1)
    ranges = ",".join(f"range:{name}=Distance {name}" for name in names)
    seen = [
        line
        for line in (folder / "gt.csv").read_text(encoding="utf-8").splitlines(keepends=True)
        if set(line.split()[1:]) != {"0"}
    ]
    with tempfile.NamedTemporaryFile("w", suffix=".csv") as truth:
        truth.writelines(seen)
        truth.flush()
        return import_csv(
            folder / "uwb.csv",
            bag,
            Columns.parse(f"time=Local Time,{ranges}", "time=ms", f"range={SHEET_SD_M}"),
            [
                RsuInfo(rsu_id=str(name), position=np.array(xyz))
                for name, xyz in zip(names, places, strict=True)
            ],
            truth=Truth(
                source=Path(truth.name),
                columns=TruthColumns.parse("time=Time,x=Position X,y=Position Y,z=Position Z"),
                offset_s=None,
                align="rigid",
                height_m=IASL_HEIGHT_M,
            ),
            tracker={"device_height_m": IASL_HEIGHT_M},
        )


def import_plaza(folder: Path, bag: Path) -> object:
    """Ranges of four radio beacons, taken as known, to a lawn mower (Plaza1)."""
    data = scipy.io.loadmat(folder / "Plaza1_.mat")
    with tempfile.NamedTemporaryFile("w", suffix=".csv") as truth:
        np.savetxt(truth, data["GT"], delimiter=",")
        truth.flush()
        return import_csv(
            folder / "Plaza1_TD.txt",
            bag,
            Columns.parse("time=1,rsu=3,range=4", sd=f"range={BEACON_SD_M}"),
            [
                RsuInfo(rsu_id=str(int(row[0])), position=np.array([row[1], row[2], 0.0]))
                for row in data["TL"]
            ],
            truth=Truth(
                source=Path(truth.name), columns=TruthColumns.parse("time=1,x=2,y=3,yaw=4")
            ),
            skip_bad_lines=True,
            any_order=True,
        )


def import_adsb(folder: Path, bag: Path) -> object:
    """Arrivals of messages of aircraft at five receivers each, as differences from the one listed
    first: when a message was sent nobody knows. Every aircraft is a device; the four hours follow
    one another. Receivers far from the middle of the network, and what they heard, are left
    out."""
    on_earth = {
        row["serial"]: [float(row[name]) for name in ("latitude", "longitude", "height")]
        for row in table_of(folder / "sensors.csv")
        if row["height"] not in ("", "NA")
    }
    messages = [
        (number, row, {str(n): ns for n, ns, _ in json.loads(row["measurements"])})
        for number in ADSB_SETS
        for row in table_of(folder / f"set_{number}.csv")
    ]
    heard = [on_earth[name] for *_, found in messages for name in found if name in on_earth]
    latitude, longitude, _ = np.median(heard, axis=0).tolist()
    datum = Datum(latitude, longitude, 0.0)
    places = dict(zip(on_earth, datum.to_map(np.array(list(on_earth.values()))), strict=True))
    near = {name for name, place in places.items() if np.linalg.norm(place[:2]) < FLAT_M}
    measured: list[RsuMeasurement] = []
    reports: dict[str, dict[int, Array]] = {}
    for number, row, found in messages:
        stamp_ns = min(found.values()) + number * ADSB_APART_NS
        vue = f"set_{number}_aircraft_{row['aircraft']}"
        if not near.issuperset(found) or stamp_ns in reports.get(vue, {}):
            continue
        first, *others = found
        for name in others:
            late = difference(first, 1e-9 * (found[name] - found[first]), ARRIVAL_SD_M)
            measured.append(RsuMeasurement(stamp_ns=stamp_ns, rsu_id=name, vue_id=vue, **late))
        report = [float(row[name]) for name in ("latitude", "longitude", "geoAltitude")]
        reports.setdefault(vue, {})[stamp_ns] = datum.to_map(np.array([report]))[0]
    truth = [pose for vue, places in reports.items() for pose in way(vue, places)]
    return write_bag(
        bag,
        rsus=rsus_at({name: places[name] for name in near}, measured),
        measurements=measured,
        truth=truth,
        tracker=AIRCRAFT,
        metadata={
            "source": "LocaRDS",
            "left_out": f"{len(messages) - len(truth)} of {len(messages)} messages",
        },
    )


def table_of(file: Path) -> list[dict[str, str]]:
    """The rows of a text file with a header, packed or not."""
    opened = gzip.open if file.suffix == ".gz" else open
    with opened(file, "rt", encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def import_raytraced(file: Path, bag: Path) -> object:
    """Time differences of 5G stations, and azimuths where the set has them. Every point is a
    device that stands, its draws are a second apart. Azimuths are those of the stations as the
    device sees them: turned round here."""
    stations: dict[tuple[float, ...], str] = {}
    points: dict[tuple[float, ...], str] = {}
    measured: list[RsuMeasurement] = []
    truth: list[Odometry] = []
    reference = ""
    for row in table_of(file):
        station, point = (
            tuple(float(row[f"{of}_{axis}"]) for axis in "xyz") for of in ("BS", "UE")
        )
        name = stations.setdefault(station, f"station_{len(stations)}")
        vue = points.setdefault(point, f"point_{len(points)}")
        stamp_ns, values = int(row["timestamp"]) * 1_000_000_000, {}
        if row["tdoa"] == "NaN":
            reference = name
            truth.append(pose(stamp_ns, vue, np.array(point)))
        else:
            late_s = float(row["tdoa"]) / SPEED_OF_LIGHT_MPS
            values |= difference(reference, late_s, STATION_SD_M)
        if "aoa_az" in row:
            back = math.remainder(float(row["aoa_az"]) + math.pi, 2.0 * math.pi)
            fields = values.get("fields", Field(0)) | Field.AZIMUTH
            values |= {"fields": fields, "azimuth_rad": back, "azimuth_var": AZIMUTH_SD_RAD**2}
        if values:
            measured.append(RsuMeasurement(stamp_ns=stamp_ns, rsu_id=name, vue_id=vue, **values))
    return write_bag(
        bag,
        rsus=rsus_at({name: np.array(place) for place, name in stations.items()}, measured),
        measurements=measured,
        truth=truth,
        tracker={"learn_errors": True},
        metadata={"source": file.name},
    )


def rsus_at(places: Mapping[str, Array], measured: list[RsuMeasurement]) -> list[RsuInfo]:
    """The RSUs of measurements, at ``places`` (3,) m."""
    names = {name for m in measured for name in (m.rsu_id, m.reference_rsu_id)} - {""}
    return [RsuInfo(rsu_id=name, position=places[name]) for name in sorted(names)]


def difference(reference: str, late_s: float, sd_m: float) -> dict[str, Any]:
    """The fields of a measurement of how much later than at ``reference`` something arrived;
    ``sd_m``: of one arrival."""
    return {
        "fields": Field.TDOA,
        "reference_rsu_id": reference,
        "tdoa_s": late_s,
        "tdoa_var": 2.0 * (sd_m / SPEED_OF_LIGHT_MPS) ** 2,
    }


def way(vue: str, places: Mapping[int, Array]) -> list[Odometry]:
    """Where a device truly was at stamps [ns], (3,) m each; with two places how it moved, too."""
    if len(places) == 1:
        return [pose(stamp_ns, vue, place) for stamp_ns, place in places.items()]
    stamps_ns = np.array(sorted(places), dtype=np.int64)
    values = [[*places[stamp_ns].tolist(), math.nan] for stamp_ns in stamps_ns.tolist()]
    return Poses(stamps_ns, np.array(values)).odometry(vue)


def pose(stamp_ns: int, vue: str, place: Array) -> Odometry:
    """Where a device truly was, (3,) m; how it moved is not known."""
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id=vue,
        position=place,
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.zeros(3),
    )
