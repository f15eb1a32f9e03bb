"""Recordings without an importer of their own: read by their columns, or, where netpos has no such
measurement, as measurements and truth for the baselines."""

from __future__ import annotations

import csv
import gzip
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from netpos.bags.importers.own import Columns, Truth, import_csv, import_ros
from netpos.bags.importers.own.truth import TruthColumns
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.yardsticks import Observations, ranges
from netpos.messages.values import RsuInfo

NS = 1_000_000_000
Series = tuple[Observations, Trajectory]

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
POINT_SPACING_NS = 10 * NS  # points without time: each is an instant of its own


def path_of(stamp_ns: np.ndarray, position: np.ndarray) -> Trajectory:
    """A true path of stamps (n,) and positions (n, 3) m; of equal stamps the first counts."""
    stamps, first = np.unique(stamp_ns.astype(np.int64), return_index=True)
    n = len(stamps)
    return Trajectory(
        stamp_ns=stamps,
        position=position[first],
        velocity=np.zeros((n, 3)),
        heading=np.zeros(n),
        position_cov=np.zeros((n, 3, 3)),
    )


def in_order(
    stamps: list[int],
    rsus: list[Any],
    values: list[float],
    sd: float,
    others: list[Any] | None = None,
) -> Observations:
    """``ranges`` of rows in any order."""
    order = np.argsort(stamps, kind="stable")
    other = None if others is None else np.array(others)[order]
    return ranges(
        np.array(stamps)[order], np.array(rsus)[order], np.array(values)[order], sd, other
    )


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


def raytraced(file: Path) -> Series:
    """Time differences of 5G stations: every point and draw is an instant of its own."""
    stamps, first, second, values, times, poses = [], [], [], [], [], []
    reference, last = np.zeros(3), ""
    with gzip.open(file, "rt", newline="") as stream:
        for row in csv.DictReader(stream):
            station = np.array([float(row[f"BS_{axis}"]) for axis in "xyz"])
            if row["tdoa"] == "NaN":
                reference, last = station, row["timestamp"]
                times.append((len(times) + 1) * POINT_SPACING_NS)
                poses.append([float(row[f"UE_{axis}"]) for axis in "xyz"])
                continue
            if row["timestamp"] != last:
                raise ValueError(f"{file}: draw {row['timestamp']} has no reference station")
            stamps.append(times[-1])
            first.append(reference)
            second.append(station)
            values.append(float(row["tdoa"]))
    seen = in_order(stamps, first, values, 1.0, second)
    return seen, path_of(np.array(times), np.array(poses))
