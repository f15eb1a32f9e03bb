"""What the importers share: strict CSV lines, error models, truth of poses."""

from __future__ import annotations

import csv
import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from netpos.bags.errors import BagError
from netpos.messages.values import Array, Odometry, RsuInfo

CUT_LINES = "cut lines skipped"
UNKNOWN_RSSI = "RSSI not finite, taken as not measured"


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a recording, able to say where it stands.

    As a context (``with row:``) it skips and counts the last line of a file that ends within it,
    where what is left cannot be understood.
    """

    file: Path
    line: int
    values: Sequence[str]
    skipped: Counter[str]
    may_be_cut: bool = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        cut = self.may_be_cut and isinstance(error, BagError)
        if cut:
            self.skipped[CUT_LINES] += 1
        return cut

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

    def rssi_dbm(self, column: int) -> float:
        """A power in dBm; 0 (not measured), counted, where it is not finite."""
        try:
            value = float(self.values[column])
        except ValueError:
            raise self.error(f"RSSI {self.values[column]!r} is not a number") from None
        if math.isfinite(value):
            return value
        self.skipped[UNKNOWN_RSSI] += 1
        return 0.0

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


# A DW1000 radio: ranges within 10 cm, and an antenna delay that nobody has calibrated. What else
# an anchor has is learned while tracking.
UWB_DATA_SHEET = RangeErrors(
    range_sd_m=0.1,
    noise_correlation_time_s=0.0,
    range_bias_sd_m=0.0,
    bias_correlation_time_s=0.0,
    common_range_bias_sd_m=0.15,
    common_bias_correlation_time_s=60.0,
)


def read_rows(file: Path, columns: int, skipped: Counter[str], *, header: bool) -> Iterator[Row]:
    """Lines of a CSV file with exactly ``columns`` fields; empty lines are skipped. A first or
    last one that was cut is skipped and counted in ``skipped``.

    Raises
    ------
    BagError  no such file, not text, no data, or a line with other than ``columns`` fields
    """
    found = False
    for line, text, last in _lines(file):
        values = next(csv.reader([text]), [])
        if not values or (header and line == 1):
            continue
        first = line == 1 + header
        row = Row(file, line, values, skipped, may_be_cut=last and not text.endswith("\n"))
        if len(values) < columns and (first or last):
            skipped[CUT_LINES] += 1
            continue
        if len(values) != columns:
            raise row.error(f"{len(values)} fields, {columns} expected")
        found = True
        yield row
    if not found:
        raise BagError(f"{file} holds no data")


def _lines(file: Path) -> Iterator[tuple[int, str, bool]]:
    """Number and text of each line of a file, and whether it is the last."""
    if not file.is_file():
        raise BagError(f"{file} does not exist; give the folder of the recording")
    try:
        with file.open(newline="\n", encoding="utf-8") as stream:
            line, text = 0, next(stream, "")
            while text:
                following = next(stream, "")
                line += 1
                yield line, text, not following
                text = following
    except (UnicodeDecodeError, csv.Error) as error:
        raise BagError(f"{file} is not a CSV text file ({error})") from error


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
