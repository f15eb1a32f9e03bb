"""A car drive: MEMS IMU at 100 Hz, RTK at 4 Hz as the truth (rtklibexplorer, BSD-3-Clause).

The folder holds ``imu_RUN.csv`` (accelerometer g x 3, gyro deg/s x 3, tick ms), its time tag of
RTKLIB, ``imu_RUN.csv.tag`` (start of the file in GPST at byte 64, then pairs of milliseconds since
then and bytes written), and ``gnss_RUN_sf.pos`` (RTKLIB solution). The last line of the IMU file
is cut where the recorder stopped. How the IMU is mounted and how late its clock is belongs to one
car, ``MOUNT``; another car gives its own. Map is east-north-up from the first fixed position.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from netpos.bags.errors import BagError
from netpos.inertial.attitude import GRAVITY_MPS2
from netpos.inertial.strapdown import earth_at
from netpos.messages.values import Array, ImuSample, Odometry
from netpos.world.geodesy import Datum

Stamps = NDArray[np.int64]

NS = 1_000_000_000
_FRD_TO_FLU = np.array([1.0, -1.0, -1.0])
_HEADER, _RECORD = 76, 8  # bytes of the tag file: up to the first record, and of each
_FIXED = 1.0
_MOVING_MPS = 1.0
# Errors of the IMU, from the 39 s of rest at the begin alone: at 100 Hz the axes scatter by 0.07
# to 0.14 m/s^2 and 0.002 to 0.04 rad/s (the engine runs), their means are off by 0.2 m/s^2 and
# 0.003 rad/s. What a car does not do is the usual choice.
TRACKER: dict[str, float | str | bool] = {
    "motion_model": "strapdown",
    "inertial_accel_density_mps2_sqrthz": 0.02,
    "gyro_noise_density": 2e-3,
    "accel_bias_sd_mps2": 0.2,
    "gyro_bias_sd_radps": 5e-3,
    "bias_correlation_time_s": 1000.0,
    "sideways_sd_mps": 0.2,
    "upwards_sd_mps": 0.2,
    "standstill_sd_mps": 0.05,
    "earth_rate": True,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Mount:
    """How the IMU sits in a car.

    attitude_deg : roll, pitch, yaw of the sensor against forward-right-down
    lever_arm_m : from the IMU to the antenna, forward-left-up
    clock_offset_s : added to the time of an IMU sample
    """

    attitude_deg: tuple[float, float, float]
    lever_arm_m: tuple[float, float, float]
    clock_offset_s: float

    def __post_init__(self) -> None:
        values = (*self.attitude_deg, *self.lever_arm_m, self.clock_offset_s)
        if not all(math.isfinite(value) for value in values):
            raise ValueError(f"the mount needs finite numbers, got {values}")

    @property
    def rotation(self) -> Rotation:
        """From the axes of the sensor to forward-right-down of the car: its inverse."""
        return Rotation.from_euler("ZYX", self.attitude_deg[::-1], degrees=True)


MOUNT = Mount(
    attitude_deg=(180.0, -6.79, 185.35), lever_arm_m=(0.0, 0.05, 0.0), clock_offset_s=-0.125
)
"""That of the car of run 1934, from the notes of the recording."""


@dataclass(frozen=True, slots=True, eq=False)
class CarDrive:
    """The drive in base_link and map.

    imu_ns (n,), rates (n, 6) angular velocity rad/s and specific force m/s^2; rtk_ns (k,) and
    antenna (k, 3) m of the fixed solutions; latitude_rad and height_m of the map's origin;
    lever_arm_m from the IMU to the antenna
    """

    imu_ns: Stamps
    rates: Array
    rtk_ns: Stamps
    antenna: Array
    latitude_rad: float
    height_m: float
    lever_arm_m: tuple[float, float, float]

    @property
    def tracker(self) -> dict[str, float | str | bool]:
        """Parameters of a tracker for this drive."""
        gravity = earth_at(self.latitude_rad, self.height_m).gravity_mps2
        latitude_deg = math.degrees(self.latitude_rad)
        return {**TRACKER, "gravity_mps2": gravity, "latitude_deg": latitude_deg}


def load_car_drive(path: Path, mount: Mount = MOUNT) -> CarDrive:
    """Read a recording of a car with the IMU mounted so.

    Raises
    ------
    BagError  missing folder or file, or a line that cannot be understood
    """
    path = Path(path)
    files = sorted(path.glob("imu_*.csv")) if path.is_dir() else []
    if len(files) != 1:
        raise BagError(f"{path} must be a folder with one imu_RUN.csv, it has {len(files)}")
    imu = files[0]
    run = imu.stem.removeprefix("imu_")
    ticks_ms, rates = _imu(imu, mount.rotation)
    start_ns, length_ms = _tag(imu.with_name(imu.name + ".tag"))
    share = (ticks_ms - ticks_ms[0]) / (ticks_ms[-1] - ticks_ms[0])
    offset_ns = round(mount.clock_offset_s * NS)
    imu_ns = start_ns + offset_ns + np.rint(share * (length_ms * 1e6)).astype(np.int64)
    rtk_ns, geodetic = _positions(path / f"gnss_{run}_sf.pos")
    on_earth = geodetic * [180.0 / math.pi, 180.0 / math.pi, 1.0]
    return CarDrive(
        imu_ns=imu_ns,
        rates=rates,
        rtk_ns=rtk_ns,
        antenna=Datum(*on_earth[0].tolist()).to_map(on_earth),
        latitude_rad=float(geodetic[0, 0]),
        height_m=float(geodetic[0, 2]),
        lever_arm_m=mount.lever_arm_m,
    )


def _imu(file: Path, mount: Rotation) -> tuple[Array, Array]:
    """Ticks (n,) ms and rates (n, 6) in base_link."""
    rows = []
    for number, line in enumerate(_lines(file)[:-1], start=1):  # the last may be cut
        try:
            values = [float(value) for value in line.split(",")]
        except ValueError:
            values = []
        if len(values) != 7 or not all(math.isfinite(value) for value in values):
            raise BagError(f"{file}, line {number}: 7 numbers expected; repair or remove the line")
        rows.append(values)
    table = np.array(rows).reshape(-1, 7)
    if len(table) < 2 or (np.diff(table[:, 6]) <= 0).any():
        raise BagError(f"{file}: ticks must increase; is it the file of one run?")
    turn = mount.inv()
    force = turn.apply(table[:, :3] * GRAVITY_MPS2) * _FRD_TO_FLU
    rate = turn.apply(np.radians(table[:, 3:6])) * _FRD_TO_FLU
    return table[:, 6], np.hstack([rate, force])


def _tag(file: Path) -> tuple[int, int]:
    """Start of a file in GPST [ns] and its length [ms]."""
    if not file.is_file():
        raise BagError(f"{file} does not exist; the IMU has no absolute time without it")
    data = file.read_bytes()
    if not data.startswith(b"TIMETAG") or len(data) < _HEADER + _RECORD:
        raise BagError(f"{file} is no RTKLIB time tag; fetch it again")
    seconds, fraction = struct.unpack_from("<Id", data, 64)
    last = _HEADER + ((len(data) - _HEADER) // _RECORD - 1) * _RECORD
    (length_ms,) = struct.unpack_from("<I", data, last)
    return int(seconds) * NS + round(float(fraction) * NS), int(length_ms)


def _positions(file: Path) -> tuple[Stamps, Array]:
    """Stamps (k,) and latitude, longitude [rad], height [m] (k, 3) of the fixed solutions."""
    stamps, rows = [], []
    for number, line in enumerate(_lines(file), start=1):
        if line.startswith("%") or not line.strip():
            continue
        words = line.split()
        try:
            when = datetime.strptime(f"{words[0]} {words[1]}", "%Y/%m/%d %H:%M:%S.%f")
            latitude, longitude, height, quality = (float(word) for word in words[2:6])
        except (ValueError, IndexError):
            raise BagError(
                f"{file}, line {number}: not an RTKLIB solution; repair or remove the line"
            ) from None
        if quality == _FIXED:
            whole = int(when.replace(tzinfo=UTC, microsecond=0).timestamp())
            stamps.append(whole * NS + when.microsecond * 1000)
            rows.append((math.radians(latitude), math.radians(longitude), height))
    if len(stamps) < 2 or (np.diff(stamps) <= 0).any():
        raise BagError(f"{file}: needs two fixed solutions, in the order of time")
    return np.array(stamps, dtype=np.int64), np.array(rows)


def _lines(file: Path) -> list[str]:
    try:
        return file.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise BagError(f"{file} does not exist; give the folder of the recording") from None
    except UnicodeDecodeError as error:
        raise BagError(f"{file} is not a text file ({error})") from None


def truth_of(drive: CarDrive, vue_id: str) -> list[Odometry]:
    """RTK as ground truth of base_link: velocity of neighbouring solutions, heading along it (kept
    where the car stands), level."""
    time = (drive.rtk_ns - drive.rtk_ns[0]) / NS
    velocity = np.gradient(drive.antenna, time, axis=0)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    moving = np.flatnonzero(speed > _MOVING_MPS)
    if not moving.size:
        raise BagError("the recording never moves; its heading is not known")
    yaw = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    yaw = np.interp(np.arange(len(time)), moving, yaw)
    turn = Rotation.from_euler("z", yaw[:, None])
    position = drive.antenna - turn.apply(drive.lever_arm_m)
    in_body = turn.inv().apply(velocity)
    return [
        Odometry(
            stamp_ns=stamp,
            vue_id=vue_id,
            position=position[i],
            quaternion=turn[i].as_quat(),
            linear_velocity=in_body[i],
        )
        for i, stamp in enumerate(drive.rtk_ns.tolist())
    ]


def imu_samples(drive: CarDrive, vue_id: str) -> list[ImuSample]:
    """The IMU as messages."""
    return [
        ImuSample(
            stamp_ns=stamp,
            vue_id=vue_id,
            angular_velocity=drive.rates[i, :3],
            specific_force=drive.rates[i, 3:],
        )
        for i, stamp in enumerate(drive.imu_ns.tolist())
    ]
