"""Bluetooth 5.1 arrays on four walls measure azimuth and elevation of a tag (Zenodo 7759557).

A folder holds runs ``beacons_RUN.csv`` + ``truth_RUN.csv`` such as ``uc1_run1``, or they lie as
published: ``mobility/beacons/use-case 1/beacons_mobility_use-case1_run1.txt`` and
``mobility/gt/use-case 1/gt_mobility_use-case1_run1.txt`` (any of the folders may be given).
Beacon lines: epoch ms, tag, RSSI dBm, azimuth deg, elevation deg, RSSI of the second polarisation
dBm, channel, anchor. Truth lines: epoch ms of arrival, epoch ms of departure, x cm, y cm at the
corners of the walk; where the person does not stop, the departure is ``NaN``.

Signs. The authors count azimuth clockwise seen from above (bearing in the room = facing -
azimuth), an RSU counter-clockwise: the sign turns. Azimuth is the angle to the array's own axis
(a cone angle): its sine is the direction cosine, whatever the tag's height.
Elevation keeps its sign: the tag is below the
arrays, and as written the angles agree with atan2(1.13 m - 2.30 m, distance) within 1 to -8 deg in
the mean; with the sign turned they are 29 to 41 deg off.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from netpos.bags.errors import BagError
from netpos.bags.importers.common import Row, read_rows, yaw_quaternion
from netpos.bags.recording import write_values
from netpos.messages.values import AngleConvention, Array, Field, Odometry, RsuInfo, RsuMeasurement

MS = 1_000_000
TAG_HEIGHT_M = 1.13
ARRAY_HEIGHT_M = 2.30
TRUTH_PERIOD_NS = 100 * MS
# anchor: x m, y m, facing deg counter-clockwise from x
ARRAYS: dict[str, tuple[float, float, float]] = {
    "6501": (0.0, 3.0, 0.0),
    "6502": (6.0, 0.0, 90.0),
    "6503": (12.0, 3.0, 180.0),
    "6504": (6.0, 6.0, -90.0),
}


# Reflections in a room have no gate that fits all: what fits badly gets a larger variance instead.
# A walking person: v^2 / T for 0.5 m/s and turns of some seconds, sqrt(0.05) m/s^2/sqrt(Hz), which
# leaves nothing for manoeuvres.
TRACKER = {
    "manoeuvre_speed_sd_mps": 0.0,
    "device_height_m": TAG_HEIGHT_M,
    "accel_density_mps2_sqrthz": 0.22,
    "initial_speed_sd_mps": 0.5,
    "coverage_radius_m": 6.0,
    "initial_position_sd_max_m": 2.0,
    "gate_probability": 1.0,
    "robust": "student_t",
    "learn_errors": True,
}


# Data sheets of such arrays say 5 deg in front of them: of a linear array, an error of the
# direction cosine that is the same in every direction. What else an array has is learned.
COSINE_SD = math.radians(5.0)


def import_ble_aoa(
    path: Path,
    bag: Path,
    *,
    run: str | None = None,
    vue_id: str = "vue_1",
) -> dict[str, int]:
    """Write one run as a bag: /rsu/info, /rsu/measurements and /VUE/ground_truth (10 Hz).

    Parameters
    ----------
    path : the folder, or one file of beacons
    run : which run of a folder, such as ``uc1_run1``; may be left out where there is only one

    Returns
    -------
    messages per topic, and how many values were skipped

    Raises
    ------
    BagError  missing file, several runs and none chosen, or a line that cannot be understood
    FileExistsError  ``bag`` exists
    """
    beacons = _beacon_file(Path(path), run)
    skipped: Counter[str] = Counter()
    measurements = _measurements(beacons, vue_id, skipped)
    truth = _truth(_truth_file(beacons), vue_id, skipped)
    counts = write_values(
        bag,
        rsus=[_info(rsu_id) for rsu_id in ARRAYS],
        measurements=measurements,
        truth=truth,
        tracker=TRACKER,
        metadata={"source": f"ble-aoa {_run_of(beacons)}"},
    )
    return {**counts, **skipped}


def _run_of(beacons: Path) -> str:
    """``uc1_run1`` of ``beacons_uc1_run1.csv`` and of ``beacons_mobility_use-case1_run1.txt``."""
    name = beacons.stem.removeprefix("beacons_").removeprefix("mobility_")
    return re.sub(r"^use-case\s*", "uc", name)


def _truth_file(beacons: Path) -> Path:
    name = beacons.stem.removeprefix("beacons_")
    published = [
        Path(*("gt" if part == "beacons" else part for part in beacons.parent.parts))
        / f"gt_{name}{beacons.suffix}",
        beacons.with_name(f"gt_{name}{beacons.suffix}"),
    ]
    plain = beacons.with_name(f"truth_{name}.csv")
    return next((file for file in published if file.is_file()), plain)


def _beacon_file(path: Path, run: str | None) -> Path:
    if not path.exists():
        raise BagError(f"{path} does not exist; give the folder of the recording")
    if path.is_file():
        if not path.name.startswith("beacons_"):
            raise BagError(f"{path} is not named beacons_RUN.csv; give the folder or such a file")
        return path
    found = [file for file in path.rglob("beacons_*") if file.suffix in {".csv", ".txt"}]
    files = {_run_of(file): file for file in sorted(found)}
    if not files:
        raise BagError(f"{path} holds no beacons_RUN.csv; give the folder of the recording")
    if run is None and len(files) > 1:
        raise BagError(f"{path} holds the runs {', '.join(files)}; choose one with --run")
    if run is not None and run not in files:
        raise BagError(f"{path} has no run {run!r}; it holds {', '.join(files)}")
    return files[run] if run is not None else next(iter(files.values()))


def _info(rsu_id: str) -> RsuInfo:
    x, y, facing = ARRAYS[rsu_id]
    return RsuInfo(
        rsu_id=rsu_id,
        position=np.array([x, y, ARRAY_HEIGHT_M]),
        quaternion=yaw_quaternion(math.radians(facing)),
        angle_convention=AngleConvention.CONE,
    )


def _measurements(file: Path, vue_id: str, skipped: Counter[str]) -> list[RsuMeasurement]:
    measurements: list[RsuMeasurement] = []
    tag = ""
    for row in read_rows(file, 8, skipped, header=False):
        with row:
            if tag and row.values[1] != tag:
                raise row.error(f"tag {row.values[1]}, but the run is of tag {tag}")
            measurements.append(_measured(row, vue_id))
            tag = row.values[1]
    return measurements


def _measured(row: Row, vue_id: str) -> RsuMeasurement:
    if row.values[7] not in ARRAYS:
        raise row.error(f"anchor {row.values[7]!r} is none of {', '.join(ARRAYS)}")
    azimuth = -_angle(row, 3, "azimuth", 89.0)
    elevation = _angle(row, 4, "elevation", 89.0)
    return RsuMeasurement(
        stamp_ns=row.integer(0, "time") * MS,
        rsu_id=row.values[7],
        vue_id=vue_id,
        fields=Field.AZIMUTH | Field.ELEVATION,
        rssi_dbm=row.rssi_dbm(2),
        azimuth_rad=azimuth,
        azimuth_var=(COSINE_SD / math.cos(azimuth)) ** 2,
        elevation_rad=elevation,
        elevation_var=(COSINE_SD / math.cos(elevation)) ** 2,
    )


def _angle(row: Row, column: int, name: str, limit_deg: float) -> float:
    degrees = row.number(column, name)
    if abs(degrees) > limit_deg:
        raise row.error(f"{name} {degrees} deg is outside +-{limit_deg:g}")
    return math.radians(degrees)


def _truth(file: Path, vue_id: str, skipped: Counter[str]) -> list[Odometry]:
    stamps: list[int] = []
    corners: list[list[float]] = []
    for row in read_rows(file, 4, skipped, header=False):
        with row:
            stamp_ns = row.integer(0, "time") * MS
            if stamps and stamp_ns <= stamps[-1]:
                raise row.error("time does not increase")
            corner = [row.number(2, "x") / 100, row.number(3, "y") / 100]
            here = [stamp_ns]
            if row.values[1].strip().lower() != "nan":
                here.append(row.integer(1, "departure") * MS)
                if here[1] <= stamp_ns:
                    raise row.error("the departure is not after the arrival")
            stamps += here
            corners += [corner] * len(here)
    if len(stamps) < 2:
        raise BagError(f"{file} holds one corner; a walk needs two")
    return walk(np.array(stamps), np.array(corners), vue_id)


def walk(stamps_ns: NDArray[np.int64], corners: Array, vue_id: str) -> list[Odometry]:
    """Constant speed from corner to corner, at 10 Hz; a corner belongs to the leg it begins.

    stamps_ns : (n,) int64, increasing; corners : (n, 2) m. While standing, the heading stays.
    """
    legs = np.diff(corners, axis=0)
    seconds = np.diff(stamps_ns) / 1e9
    speeds = np.hypot(legs[:, 0], legs[:, 1]) / seconds
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    for i in range(1, len(headings)):
        if speeds[i] == 0:
            headings[i] = headings[i - 1]
    odometry = []
    for stamp_ns in range(int(stamps_ns[0]), int(stamps_ns[-1]) + 1, TRUTH_PERIOD_NS):
        leg = min(int(np.searchsorted(stamps_ns, stamp_ns, side="right")) - 1, len(legs) - 1)
        share = (stamp_ns - int(stamps_ns[leg])) / 1e9 / seconds[leg]
        x, y = corners[leg] + share * legs[leg]
        odometry.append(
            Odometry(
                stamp_ns=stamp_ns,
                vue_id=vue_id,
                position=np.array([x, y, TAG_HEIGHT_M]),
                quaternion=yaw_quaternion(float(headings[leg])),
                linear_velocity=np.array([speeds[leg], 0.0, 0.0]),
            )
        )
    return odometry
