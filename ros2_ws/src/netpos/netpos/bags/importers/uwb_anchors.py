"""UWB anchors on a car body range to a tag carried outdoors, with RTK truth.

A folder (LOS or NLOS) holds one file per anchor, ``A3.csv`` and so on (``%time, field.stamp`` ns,
id, anchor x y z m, distance m, RSSI dBm, first-path RSSI dBm), and ``trajectory.csv`` (time ns,
x y z m, heading deg, 8 Hz). The heading is counter-clockwise from x: it agrees with the course
within 3 deg in the median while the tag moves.
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np

from netpos.bags.errors import BagError
from netpos.bags.importers.common import (
    UWB_DATA_SHEET,
    RangeErrors,
    read_rows,
    truth_of_poses,
)
from netpos.bags.recording import write_values
from netpos.messages.values import Field, Odometry, RsuInfo, RsuMeasurement

# The two anchors above each other (1.97 m and 0.5 m) tell the tag's height from the ranges alone;
# the track's own z counts from the tag's start.
TAG_HEIGHT_M = 1.1
# A walking person: (1.2 m/s)^2 / 7 s = 0.2 m^2/s^3.
TRACKER = {
    "device_height_m": TAG_HEIGHT_M,
    "accel_density_mps2_sqrthz": 0.45,
    "initial_speed_sd_mps": 1.0,
    "coverage_radius_m": 60.0,
    "learn_errors": True,
}


def import_uwb_anchors(
    path: Path, bag: Path, *, vue_id: str = "vue_1", errors: RangeErrors = UWB_DATA_SHEET
) -> dict[str, int]:
    """Write one recording as a bag: /rsu/info, /rsu/measurements, /VUE/ground_truth (8 Hz).

    Returns
    -------
    messages per topic, and how many values were skipped

    Raises
    ------
    BagError  missing folder or file, or a line that cannot be understood
    FileExistsError  ``bag`` exists
    """
    path = Path(path)
    if not path.is_dir():
        raise BagError(f"{path} is not a folder; give the LOS or NLOS folder of the recording")
    files = sorted(path.glob("A*.csv"), key=lambda file: (len(file.stem), file.stem))
    if not files:
        raise BagError(f"{path} holds no anchor file such as A3.csv; give the LOS or NLOS folder")
    infos: list[RsuInfo] = []
    measurements: list[RsuMeasurement] = []
    skipped: Counter[str] = Counter()
    for file in files:
        info, ranges = _anchor(file, vue_id, errors, skipped)
        infos.append(info)
        measurements += ranges
    truth = _truth(path / "trajectory.csv", vue_id, skipped)
    counts = write_values(
        bag,
        rsus=infos,
        measurements=measurements,
        truth=truth,
        tracker=TRACKER,
        metadata={"source": f"uwb-anchors {path.absolute().name}"},
    )
    return {**counts, **skipped}


def _anchor(
    file: Path, vue_id: str, errors: RangeErrors, skipped: Counter[str]
) -> tuple[RsuInfo, list[RsuMeasurement]]:
    position: tuple[float, ...] = ()
    ranges: list[RsuMeasurement] = []
    for row in read_rows(file, 9, skipped, header=True):
        with row:
            here = tuple(row.number(3 + axis, f"anchor {name}") for axis, name in enumerate("xyz"))
            position = position or here
            if here != position:
                raise row.error(f"anchor moved from {position} to {here}")
            ranges.append(
                RsuMeasurement(
                    stamp_ns=row.integer(1, "stamp"),
                    rsu_id=file.stem,
                    vue_id=vue_id,
                    fields=Field.RANGE,
                    rssi_dbm=row.rssi_dbm(7),
                    range_m=row.positive(6, "distance"),
                    range_var=errors.range_sd_m**2,
                )
            )
    return errors.declared(file.stem, position), ranges


def _truth(file: Path, vue_id: str, skipped: Counter[str]) -> list[Odometry]:
    stamps: list[int] = []
    track: list[list[float]] = []
    for row in read_rows(file, 5, skipped, header=True):
        with row:
            stamp_ns = int(row.number(0, "time"))  # written as a float, exact to 256 ns
            if stamp_ns < 0 or (stamps and stamp_ns <= stamps[-1]):
                raise row.error("time does not increase")
            x, y, z = (row.number(column, name) for column, name in enumerate("xyz", start=1))
            track.append([x, y, z + TAG_HEIGHT_M, math.radians(row.number(4, "heading"))])
            stamps.append(stamp_ns)
    if len(stamps) < 2:
        raise BagError(f"{file} holds one pose; velocities need two")
    return truth_of_poses(stamps, np.array(track), vue_id)
