"""Recordings that no importer of netpos reads, as measurements and truth for the baselines."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.yardsticks import Observations, ranges
from rosbags.highlevel import AnyReader

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
UWB_SD_M = 0.2
BEACON_SD_M = 1.0  # the ranges of the beacons are off by up to a metre
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


def uwb_tdoa(folder: Path) -> Series:
    """Time differences of eight anchors to a drone: |p - B| - |p - A|."""
    stamps, first, second, values, times, poses = [], [], [], [], [], []
    with gzip.open(folder / "const1_trial1_tdoa2.csv.gz", "rt", newline="") as stream:
        for row in csv.DictReader(stream):
            stamps.append(round(float(row["t_tdoa"]) * NS))
            first.append(TDOA_ANCHORS_M[int(row["idA"])])
            second.append(TDOA_ANCHORS_M[int(row["idB"])])
            values.append(float(row["tdoa_meas"]))
            pose = [row[f"pose_{axis}"] for axis in "xyz"]
            if all(pose) and "nan" not in [text.lower() for text in pose]:
                times.append(round(float(row["t_pose"]) * NS))
                poses.append([float(text) for text in pose])
    seen = in_order(stamps, first, values, UWB_SD_M, second)
    return seen, path_of(np.array(times), np.array(poses))


def four_anchors(folder: Path) -> Series:
    """Ranges of four anchors to a walking person (a ROS 1 bag)."""
    stamps, rsus, values, times, poses = [], [], [], [], []
    with AnyReader([folder / "four_anchors" / "data_example.bag"]) as bag:
        topics = ("/uwb_endorange_info", "/vicon_xb/viconPoseTopic")
        for connection, _, raw in bag.messages([c for c in bag.connections if c.topic in topics]):
            message = bag.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec * NS + message.header.stamp.nanosec
            if connection.topic == topics[0]:
                at = message.responder_location
                stamps.append(stamp)
                rsus.append([at.x, at.y, at.z])
                values.append(message.distance)
            else:
                at = message.pose.position
                times.append(stamp)
                poses.append([at.x, at.y, at.z])
    return in_order(stamps, rsus, values, UWB_SD_M), path_of(np.array(times), np.array(poses))


def range_beacons(folder: Path) -> Series:
    """Ranges of four radio beacons, taken as known, to a lawn mower (Plaza1)."""
    data = scipy.io.loadmat(folder / "Plaza1_.mat")
    beacons = {int(row[0]): [row[1], row[2], 0.0] for row in data["TL"]}
    rows = [row for row in data["TD"] if int(row[2]) in beacons]
    seen = in_order(
        [round(row[0] * NS) for row in rows],
        [beacons[int(row[2])] for row in rows],
        [row[3] for row in rows],
        BEACON_SD_M,
    )
    truth = data["GT"]
    level = np.column_stack([truth[:, 1:3], np.zeros(len(truth))])
    return seen, path_of(np.rint(truth[:, 0] * NS), level)


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
