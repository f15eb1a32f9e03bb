"""Readers of public gait, phone and attitude recordings: arrays in SI units, body FLU.

Every reader raises ``FileNotFoundError`` (absent) or ``ValueError`` (malformed); both name the
path. Stamps are int64 nanoseconds.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.io

from netpos.inertial.attitude import GRAVITY_MPS2

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecord:
    """Time-ordered samples in the body frame.

    stamp_ns : (n,)
    angular_velocity : (n, 3) rad/s, or None when the recording has no gyro
    specific_force : (n, 3) m/s^2
    magnetic_field : (n, 3) tesla, or None
    """

    stamp_ns: Stamps
    angular_velocity: Array | None
    specific_force: Array
    magnetic_field: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class WalkingBout:
    """Reference walking bout.

    initial_contact_ns : (k,) sorted, without repeats
    untimed : (start, end, count) of contacts without a time, between two timed ones: those the
        reference lists as NaN, and one of the other foot where the same foot lands twice
    """

    start_ns: int
    end_ns: int
    length_m: float
    initial_contact_ns: Stamps
    untimed: tuple[tuple[int, int, int], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class WaistRecord:
    imu: ImuRecord
    bouts: tuple[WalkingBout, ...]
    contact_entries: int  # as listed by the authors: with NaN and repeats


@dataclass(frozen=True, slots=True, eq=False)
class StepCountRecord:
    imu: ImuRecord
    true_step_ns: Stamps  # when the cumulative true count rises


@dataclass(frozen=True, slots=True, eq=False)
class WaypointRecord:
    imu: ImuRecord
    waypoint_ns: Stamps  # (k,)
    waypoint_m: Array  # (k, 2) map x, y


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeRecord:
    imu: ImuRecord
    quaternion: Array  # (n, 4) w x y z, body -> ENU; NaN where the cameras lost it
    moving: npt.NDArray[np.bool_]  # (n,)


def _require(path: Path) -> Path:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such recording; set NETPOS_DATA to the data folder")
    return path


def _malformed(path: Path, why: object) -> ValueError:
    return ValueError(f"{path}: not the expected recording ({why}); fetch it again")


def _samples(values: Any, path: Path, scale: float = 1.0) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise _malformed(path, f"expected (n, 3) samples, got {array.shape}")
    return array * scale


def _load_mat(path: Path) -> dict[str, Any]:
    try:
        return dict(scipy.io.loadmat(_require(path), simplify_cells=True))
    except FileNotFoundError:
        raise
    except Exception as error:  # scipy raises several unrelated types on a broken file
        raise _malformed(path, error) from error


def waist_to_flu(array: Array) -> Array:
    """Lower-back axes -> FLU: sensor x is up, y right, z forward.

    x carries +1 g. Right-handedness (f' = -w x f holds with this mapping) leaves y right and
    z forward, or y left and z backward; on the sacrum the outward face looks up, so gravity
    shows as negative z (-0.2, -0.5 g): z points forward, into the body.
    """
    return np.column_stack([array[:, 2], -array[:, 1], array[:, 0]])


def _untimed(contacts: Array, feet: list[str]) -> tuple[tuple[int, int, int], ...]:
    """(start, end, count) of untimed contacts between timed ones; contacts (k,) s, in order."""
    slots = []
    timed = np.flatnonzero(np.isfinite(contacts)).tolist()
    for a, b in itertools.pairwise(timed):
        count = b - a - 1
        if (count % 2 == 0) == (feet[a] == feet[b]):
            count += 1  # feet alternate
        if count > 0:
            slots.append((round(contacts[a] * 1e9), round(contacts[b] * 1e9), count))
    return tuple(slots)


def load_waist_imu(path: Path) -> WaistRecord:
    """``waist_imu/*/data.mat``: trial TimeMeasure1/Test11/Trial1, sensor LowerBack, INDIP bouts.

    Stamps count from the start of the trial, as the reference events do.
    """
    try:
        data = _load_mat(path)["data"]["TimeMeasure1"]["Test11"]["Trial1"]
        sensor = data["SU"]["LowerBack"]
        seconds = np.asarray(sensor["Timestamp"], dtype=np.float64)
        imu = ImuRecord(
            np.rint((seconds - seconds[0]) * 1e9).astype(np.int64),
            waist_to_flu(_samples(sensor["Gyr"], path, math.pi / 180)),
            waist_to_flu(_samples(sensor["Acc"], path, GRAVITY_MPS2)),
            waist_to_flu(_samples(sensor["Mag"], path, 1e-6)),
        )
        bouts, entries = [], 0
        for bout in data["Standards"]["INDIP"]["MicroWB"]:
            contacts = np.atleast_1d(np.asarray(bout["InitialContact_Event"], dtype=np.float64))
            entries += contacts.size
            finite = np.unique(np.rint(contacts[np.isfinite(contacts)] * 1e9).astype(np.int64))
            start, end = round(bout["Start"] * 1e9), round(bout["End"] * 1e9)
            untimed = _untimed(contacts, np.atleast_1d(bout["InitialContact_LeftRight"]).tolist())
            bouts.append(WalkingBout(start, end, float(bout["Length"]), finite, untimed))
    except (KeyError, TypeError, IndexError) as error:
        raise _malformed(path, repr(error)) from error
    return WaistRecord(imu, tuple(bouts), entries)


def load_steps_phone(path: Path) -> StepCountRecord:
    """``steps_phone/*.csv``: phone axes as recorded (placement unknown), no gyro."""
    try:
        rows = np.loadtxt(_require(path), delimiter=",", dtype=np.float64, ndmin=2)
        stamps = np.loadtxt(path, delimiter=",", dtype=np.int64, usecols=0, ndmin=1)
    except ValueError as error:
        raise _malformed(path, error) from error
    if rows.shape[0] < 2 or rows.shape[1] < 6:
        raise _malformed(path, f"expected 7 columns, got {rows.shape}")
    rises = np.nonzero(np.diff(rows[:, 5]) > 0)[0] + 1
    times = np.repeat(stamps[rises], np.rint(np.diff(rows[:, 5])[rises - 1]).astype(np.int64))
    return StepCountRecord(ImuRecord(stamps, None, _samples(rows[:, 1:4], path), None), times)


def phone_to_flu(array: Array) -> Array:
    """Android axes (x right, y top edge, z out of the screen) -> FLU, top edge forward."""
    return np.column_stack([array[:, 1], -array[:, 0], array[:, 2]])


def load_pdr_phone(path: Path) -> WaypointRecord:
    """``pdr_phone/*.txt``: 50 Hz phone log in Android axes with surveyed waypoints.

    The three sensors share their stamps (epoch ms); rows without all three are dropped.
    """
    wanted = {"TYPE_ACCELEROMETER": 0, "TYPE_GYROSCOPE": 1, "TYPE_MAGNETIC_FIELD": 2}
    samples: tuple[dict[int, list[float]], ...] = ({}, {}, {})
    points: list[tuple[int, float, float]] = []
    with _require(path).open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            cells = line.rstrip("\n").split("\t")
            if line.startswith("#") or len(cells) < 3:
                continue
            try:
                if cells[1] == "TYPE_WAYPOINT":
                    points.append((int(cells[0]), float(cells[2]), float(cells[3])))
                elif cells[1] in wanted:
                    xyz = [float(c) for c in cells[2:5]]
                    samples[wanted[cells[1]]][int(cells[0])] = xyz
            except (ValueError, IndexError) as error:
                raise _malformed(path, f"line {number}: {error}") from error
    common = sorted(set(samples[0]) & set(samples[1]) & set(samples[2]))
    if not common or not points:
        raise _malformed(path, "no IMU rows or no waypoints")
    take: Callable[[int, float], Array] = lambda i, scale: phone_to_flu(  # noqa: E731
        _samples([samples[i][t] for t in common], path, scale)
    )
    imu = ImuRecord(np.array(common) * 1_000_000, take(1, 1.0), take(0, 1.0), take(2, 1e-6))
    stamps = np.array([p[0] for p in points], dtype=np.int64) * 1_000_000
    return WaypointRecord(imu, stamps, np.array([p[1:] for p in points]))


def load_imu_mag_attitude(path: Path) -> AttitudeRecord:
    """``imu_mag_attitude/*.mat``: BROAD trial; the sensor axes are used as body axes."""
    data = _load_mat(path)
    try:
        force = _samples(data["imu_acc"], path)
        period_ns = 1e9 / float(data["sampling_rate"])
        imu = ImuRecord(
            np.rint(np.arange(len(force)) * period_ns).astype(np.int64),
            _samples(data["imu_gyr"], path),
            force,
            _samples(data["imu_mag"], path, 1e-6),
        )
        quaternion = np.asarray(data["opt_quat"], dtype=np.float64)
        return AttitudeRecord(imu, quaternion, np.asarray(data["movement"]).astype(np.bool_))
    except (KeyError, TypeError) as error:
        raise _malformed(path, repr(error)) from error
