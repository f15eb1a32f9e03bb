"""Three UWB tags on a trolley range to eight anchors around a room, with motion-capture truth.

A folder holds ``UWB_*.csv`` (local date and time, then the 24 distances a0-t0, a0-t1, a0-t2,
a1-t0 ... a7-t2 [m], 100 Hz, empty where a link is missing) and ``motion_capture_*.csv`` (a header,
then date and time, x y z m and a quaternion, 120 Hz). The trolley stays level, and of the
quaternion's columns the second and third are w and z. The time zone is unknown: taken as UTC.
"""

from __future__ import annotations

import math
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from netpos.bags.errors import BagError
from netpos.bags.importers.common import (
    UWB_DATA_SHEET,
    RangeErrors,
    Row,
    read_rows,
    truth_of_poses,
)
from netpos.bags.recording import write_values
from netpos.messages.values import Field, Odometry, RsuInfo, RsuMeasurement

ANCHORS_M = (
    (-3.4203, 3.0053, 1.0442),
    (0.0016, 3.0110, 1.0446),
    (3.6056, 2.9795, 1.0463),
    (3.6011, -0.0008, 1.0422),
    (3.5674, -3.0087, 1.0443),
    (-0.0072, -2.9652, 1.0444),
    (-3.4673, -2.9587, 1.0445),
    (-3.4858, -0.0098, 1.0457),
)
TAGS_M = (
    (-0.0689, -0.1423, 0.0011),
    (-0.0750, 0.1402, 0.0016),
    (0.2034, 0.1451, -0.0008),
)
# The anchors are all but level with the tags, so that ranges do not tell the height: a constant of
# the rig (flat floor), the mean z of the motion capture.
TRACKER = {
    "motion_model": "rigid_body",
    "device_height_m": 0.97,
    # A pushed trolley in a small room: velocity turns by 1 m/s in 2 s, yaw rate by 1 rad/s in 1 s.
    "accel_density_mps2_sqrthz": 0.7,
    "turn_rate_density": 1.0,
    "initial_speed_sd_mps": 1.0,
    "coverage_radius_m": 10.0,
    "learn_errors": True,
}
_TRUTH_INTERVAL_NS = 50_000_000  # stamps jitter by milliseconds: no velocity from shorter ones
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def import_uwb_trolley(
    path: Path, bag: Path, *, vue_id: str = "vue_1", errors: RangeErrors = UWB_DATA_SHEET
) -> dict[str, int]:
    """Write the recording as a bag: /rsu/info, /rsu/measurements, /VUE/ground_truth (20 Hz).

    Every link is an RSU of its own, ``a0_t0`` at the place of anchor 0 with the place of tag 0 as
    lever arm. The links of one anchor are its ``network``: they share its bias.

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
        raise BagError(f"{path} is not a folder; give the folder with UWB_*.csv")
    skipped: Counter[str] = Counter()
    measurements = _ranges(_only(path, "UWB_*.csv"), vue_id, errors, skipped)
    truth = _truth(_only(path, "motion_capture_*.csv"), vue_id, skipped)
    counts = write_values(
        bag,
        rsus=_links(errors),
        measurements=measurements,
        truth=truth,
        tracker=TRACKER,
        metadata={"source": "uwb-trolley"},
    )
    return {**counts, **skipped}


def _only(folder: Path, pattern: str) -> Path:
    files = sorted(folder.glob(pattern))
    if len(files) != 1:
        raise BagError(
            f"{folder} holds {len(files)} files {pattern}; give a folder with exactly one"
        )
    return files[0]


def _stamp_ns(row: Row) -> int:
    text = row.values[0]
    try:
        when = datetime.strptime(text, "%Y-%m-%d %H:%M:%S.%f").replace(tzinfo=UTC)
    except ValueError:
        raise row.error(f"time {text!r} is not like 2022-08-15 9:42:24.766") from None
    return (when - _EPOCH) // timedelta(microseconds=1) * 1000


def _links(errors: RangeErrors) -> list[RsuInfo]:
    return [
        errors.declared(f"a{anchor}_t{tag}", position, network=f"a{anchor}")
        for anchor, position in enumerate(ANCHORS_M)
        for tag in range(len(TAGS_M))
    ]


def _ranges(
    file: Path, vue_id: str, errors: RangeErrors, skipped: Counter[str]
) -> list[RsuMeasurement]:
    measurements: list[RsuMeasurement] = []
    last_ns = -1
    for row in read_rows(file, 1 + len(ANCHORS_M) * len(TAGS_M), skipped, header=False):
        with row:
            stamp_ns = _stamp_ns(row)
            if stamp_ns <= last_ns:
                raise row.error("time does not increase")
            measurements += _links_of(row, stamp_ns, vue_id, errors)
            last_ns = stamp_ns
    return measurements


def _links_of(row: Row, stamp_ns: int, vue_id: str, errors: RangeErrors) -> list[RsuMeasurement]:
    """The ranges of one line; an empty field is a link that was not measured."""
    links = [divmod(link, len(TAGS_M)) for link in range(len(row.values) - 1)]
    return [
        RsuMeasurement(
            stamp_ns=stamp_ns,
            rsu_id=f"a{anchor}_t{tag}",
            vue_id=vue_id,
            fields=Field.RANGE,
            range_m=row.positive(column, f"distance a{anchor}-t{tag}"),
            range_var=errors.range_sd_m**2,
            lever_arm=TAGS_M[tag],
        )
        for column, (anchor, tag) in enumerate(links, start=1)
        if row.values[column].strip()
    ]


def _truth(file: Path, vue_id: str, skipped: Counter[str]) -> list[Odometry]:
    stamps: list[int] = []
    poses: list[list[float]] = []
    last_ns = -1
    for row in read_rows(file, 8, skipped, header=True):
        with row:
            stamp_ns = _stamp_ns(row)
            if stamp_ns < last_ns:  # equal ones occur
                raise row.error("time decreases")
            if stamps and stamp_ns - stamps[-1] < _TRUTH_INTERVAL_NS:
                last_ns = stamp_ns
                continue
            w, z = row.number(5, "quaternion w"), row.number(6, "quaternion z")
            place = [row.number(column, name) for column, name in enumerate("xyz", start=1)]
            poses.append([*place, 2.0 * math.atan2(z, w)])
            stamps.append(stamp_ns)
            last_ns = stamp_ns
    if len(stamps) < 2:
        raise BagError(f"{file} is shorter than 0.1 s; velocities need two poses")
    return truth_of_poses(stamps, np.array(poses), vue_id)
