"""UWB anchors on a car body range to a tag carried outdoors, with RTK truth.

A folder (LOS or NLOS) holds one file per anchor, ``A3.csv`` and so on (``%time, field.stamp`` ns,
id, anchor x y z m, distance m, RSSI dBm, first-path RSSI dBm), and ``trajectory.csv`` (time ns,
x y z m, heading deg, 8 Hz). The heading is counter-clockwise from x: it agrees with the course
within 3 deg in the median while the tag moves.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import yaml

from netpos.bags.errors import BagError
from netpos.bags.importers.common import RangeErrors, read_rows, truth_of_poses, write_recording
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
}


# Found without the truth: range sd and its correlation time from the difference of the two
# anchors above each other, the anchors' own biases from its mean. What all anchors share (the
# tag's antenna delay, received power) does not show in differences: 0.15 m is a prior.
ERRORS = RangeErrors(
    range_sd_m=0.04,
    noise_correlation_time_s=1.0,
    range_bias_sd_m=0.02,
    bias_correlation_time_s=60.0,
    common_range_bias_sd_m=0.15,
    common_bias_correlation_time_s=20.0,
)


def import_uwb_anchors(
    path: Path, bag: Path, *, vue_id: str = "vue_1", errors: RangeErrors = ERRORS
) -> dict[str, int]:
    """Write one recording as a bag: /rsu/info, /rsu/measurements, /VUE/ground_truth (8 Hz).

    Returns
    -------
    messages per topic

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
    for file in files:
        info, ranges = _anchor(file, vue_id, errors)
        infos.append(info)
        measurements += ranges
    truth = _truth(path / "trajectory.csv", vue_id)
    source = f"uwb-anchors {path.absolute().name}"
    metadata = {"source": source, "tracker": yaml.safe_dump(TRACKER)}
    return write_recording(bag, infos, measurements, truth, metadata)


def _anchor(file: Path, vue_id: str, errors: RangeErrors) -> tuple[RsuInfo, list[RsuMeasurement]]:
    position: tuple[float, ...] = ()
    ranges: list[RsuMeasurement] = []
    for row in read_rows(file, 9, header=True):
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
                rssi_dbm=row.number(7, "RSSI"),
                range_m=row.positive(6, "distance"),
                range_var=errors.range_sd_m**2,
            )
        )
    return errors.declared(file.stem, position), ranges


def _truth(file: Path, vue_id: str) -> list[Odometry]:
    stamps: list[int] = []
    track: list[list[float]] = []
    for row in read_rows(file, 5, header=True):
        stamp_ns = int(row.number(0, "time"))  # written as a float, exact to 256 ns
        if stamp_ns < 0 or (stamps and stamp_ns <= stamps[-1]):
            raise row.error("time does not increase")
        stamps.append(stamp_ns)
        track.append([row.number(column, name) for column, name in enumerate("xyz", start=1)])
        track[-1][2] += TAG_HEIGHT_M
        track[-1].append(math.radians(row.number(4, "heading")))
    if len(stamps) < 2:
        raise BagError(f"{file} holds one pose; velocities need two")
    return truth_of_poses(stamps, np.array(track), vue_id)
