"""What the importers share: strict CSV lines, beacons out of stamps, one merged bag."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

import netpos
from netpos.bags.errors import BagError
from netpos.bags.types import codec
from netpos.bags.writer import whole_bag
from netpos.messages.topics import GROUND_TRUTH, IMU, RSU_INFO, RSU_MEASUREMENTS, of_vue
from netpos.messages.values import Array, ImuSample, Odometry, RsuInfo, RsuMeasurement


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a recording, able to say where it stands."""

    file: Path
    line: int
    values: Sequence[str]

    def error(self, problem: str) -> BagError:
        """The problem with file and line number."""
        return BagError(f"{self.file}, line {self.line}: {problem}; repair or remove the line")

    def number(self, column: int, name: str) -> float:
        """A finite number; BagError otherwise."""
        try:
            value = float(self.values[column])
        except ValueError:
            raise self.error(f"{name} {self.values[column]!r} is not a number") from None
        if not math.isfinite(value):
            raise self.error(f"{name} is {value}, not finite")
        return value

    def positive(self, column: int, name: str) -> float:
        """A number of metres above 0; BagError otherwise."""
        value = self.number(column, name)
        if value <= 0:
            raise self.error(f"{name} {value} m is not positive")
        return value

    def integer(self, column: int, name: str) -> int:
        """A whole number that is not negative; BagError otherwise."""
        try:
            value = int(self.values[column])
        except ValueError:
            raise self.error(f"{name} {self.values[column]!r} is not a whole number") from None
        if value < 0:
            raise self.error(f"{name} {value} is negative")
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeErrors:
    """Error model of ranges: white noise of some correlation time, a bias of each RSU and one that
    those of a network share."""

    range_sd_m: float
    noise_correlation_time_s: float
    range_bias_sd_m: float
    bias_correlation_time_s: float
    common_range_bias_sd_m: float
    common_bias_correlation_time_s: float

    def declared(self, rsu_id: str, position: Sequence[float], network: str = "") -> RsuInfo:
        """An RSU that says so."""
        return RsuInfo(
            rsu_id=rsu_id,
            position=np.array(position),
            network=network,
            range_bias_sd_m=self.range_bias_sd_m,
            bias_correlation_time_s=self.bias_correlation_time_s,
            common_range_bias_sd_m=self.common_range_bias_sd_m,
            common_bias_correlation_time_s=self.common_bias_correlation_time_s,
            noise_correlation_time_s=self.noise_correlation_time_s,
        )


def read_rows(file: Path, columns: int, *, header: bool) -> Iterator[Row]:
    """Lines of a CSV file with exactly ``columns`` fields; empty lines are skipped.

    Raises
    ------
    BagError  no such file, not text, no data, or a line with other than ``columns`` fields
    """
    if not file.is_file():
        raise BagError(f"{file} does not exist; give the folder of the recording")
    found = False
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            for line, values in enumerate(csv.reader(stream), start=1):
                if not values or (header and line == 1):
                    continue
                row = Row(file, line, values)
                if len(values) != columns:
                    raise row.error(f"{len(values)} fields, {columns} expected")
                found = True
                yield row
    except (UnicodeDecodeError, csv.Error) as error:
        raise BagError(f"{file} is not a CSV text file ({error})") from error
    if not found:
        raise BagError(f"{file} holds no data")


def recordings(name: str) -> Path | None:
    """Folder of a public recording below NETPOS_DATA, or else beside the project; None where it
    is absent."""
    root = Path(os.environ.get("NETPOS_ROOT") or Path(__file__).parents[6])
    folder = Path(os.environ.get("NETPOS_DATA") or root.parent / "shared" / "data") / name
    return folder if folder.is_dir() else None


def yaw_quaternion(yaw_rad: float) -> Array:
    """(4,) x y z w of a turn about z."""
    return np.array([0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)])


def truth_of_poses(stamps_ns: Sequence[int], poses: Array, vue_id: str) -> list[Odometry]:
    """Ground truth of poses (n, 4), x y z m and heading rad, at increasing stamps, n >= 2; the
    velocities are their differences, in the device's axes."""
    track = poses.copy()
    track[:, 3] = np.unwrap(track[:, 3])
    rates = np.gradient(track, (np.array(stamps_ns) - stamps_ns[0]) / 1e9, axis=0)
    return [
        _moving(stamp_ns, vue_id, pose, rate)
        for stamp_ns, pose, rate in zip(stamps_ns, track, rates, strict=True)
    ]


def _moving(stamp_ns: int, vue_id: str, pose: Array, rate: Array) -> Odometry:
    """pose (4,): x y z m, heading rad; rate (4,): per second, in map axes."""
    cos, sin = math.cos(pose[3]), math.sin(pose[3])
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id=vue_id,
        position=pose[:3].copy(),
        quaternion=yaw_quaternion(float(pose[3])),
        linear_velocity=np.array(
            [cos * rate[0] + sin * rate[1], cos * rate[1] - sin * rate[0], rate[2]]
        ),
        angular_velocity=np.array([0.0, 0.0, rate[3]]),
    )


def number_beacons(measurements: Sequence[RsuMeasurement]) -> list[RsuMeasurement]:
    """In stamp order, with one sequence number per stamp and ``expected`` its RSUs.

    The recordings carry no beacon number: measurements of one stamp are taken as one beacon.
    """
    ordered = sorted(measurements, key=lambda m: (m.stamp_ns, m.rsu_id))
    numbered: list[RsuMeasurement] = []
    for sequence, (stamp_ns, group) in enumerate(groupby(ordered, key=lambda m: m.stamp_ns)):
        beacon = list(group)
        names = [m.rsu_id for m in beacon]
        if len(set(names)) != len(names):
            raise BagError(f"an RSU of {', '.join(names)} measures twice at stamp {stamp_ns} ns")
        numbered.extend(replace(m, sequence=sequence, expected=len(beacon)) for m in beacon)
    return numbered


def write_recording(
    bag: Path,
    infos: Sequence[RsuInfo],
    measurements: Sequence[RsuMeasurement],
    truth: Sequence[Odometry],
    metadata: Mapping[str, str],
    imu: Sequence[ImuSample] = (),
) -> dict[str, int]:
    """Write one bag in stamp order, /rsu/info first; messages per topic.

    Raises
    ------
    FileExistsError  ``bag`` exists
    """
    messages = codec()
    measurements = number_beacons(measurements)
    stamps = [m.stamp_ns for m in measurements] + [t.stamp_ns for t in truth]
    stamps += [s.stamp_ns for s in imu[:1]]
    start_ns = min(stamps)
    merged = [(m.stamp_ns, RSU_MEASUREMENTS, messages.measurement_to_msg(m)) for m in measurements]
    merged += [
        (t.stamp_ns, of_vue(t.vue_id, GROUND_TRUTH), messages.odometry_to_msg(t)) for t in truth
    ]
    merged += [(s.stamp_ns, of_vue(s.vue_id, IMU), messages.imu_to_msg(s)) for s in imu]
    merged.sort(key=lambda item: item[0])
    with whole_bag(bag, metadata={**metadata, "netpos_version": netpos.__version__}) as writer:
        for info in infos:
            message = messages.rsu_info_to_msg(replace(info, stamp_ns=start_ns))
            writer.write(RSU_INFO, message, start_ns)
        for stamp_ns, topic, message in merged:
            writer.write(topic, message, stamp_ns)
        return writer.counts
