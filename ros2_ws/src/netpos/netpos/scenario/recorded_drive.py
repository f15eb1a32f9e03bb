"""Make a bag of a recorded drive: real IMU, RTK as truth, simulated stations along its path."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from netpos.bags.importers.car_imu_rtk import (
    MOUNT,
    NS,
    CarDrive,
    Mount,
    imu_samples,
    load_car_drive,
    truth_of,
)
from netpos.bags.recording import write_values
from netpos.messages.values import RsuInfo
from netpos.radio.measure import Observations
from netpos.scenario.along_path import measurements_of, observe_along, stations_along

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

VUE = "vue_1"


@dataclass(frozen=True, slots=True, eq=False)
class StationDrive:
    """Epochs, one a second while the IMU runs, and what the stations measure: stamps_ns (n,),
    antenna (n, 3) m, the stations and their observations."""

    stamps_ns: Stamps
    antenna: Array
    stations: tuple[RsuInfo, ...]
    seen: Observations


def station_drive(drive: CarDrive, *, fewest: int, nearest: int, seed: int) -> StationDrive:
    """Simulate the stations of one seed.

    Raises ``ValueError`` for numbers of stations that are not 1 <= fewest <= nearest.
    """
    if not 1 <= fewest <= nearest:
        raise ValueError(f"needs 1 <= fewest <= nearest, got {fewest} and {nearest}")
    covered = (drive.rtk_ns >= drive.imu_ns[0]) & (drive.rtk_ns <= drive.imu_ns[-1])
    index = np.flatnonzero(covered)
    second = (drive.rtk_ns[index] - drive.rtk_ns[index[0]]) // NS
    index = index[np.append(True, np.diff(second) > 0)]
    stamps, antenna = drive.rtk_ns[index], drive.antenna[index]
    stations = stations_along(drive.antenna, seed)
    seen = observe_along(stations, stamps, antenna, seed, VUE, fewest=fewest, nearest=nearest)
    return StationDrive(stamps, antenna, stations, seen)


def import_car_drive(
    path: Path,
    bag: Path,
    *,
    fewest: int = 1,
    nearest: int = 2,
    seed: int = 1,
    mount: Mount = MOUNT,
) -> dict[str, int]:
    """Write the drive as a bag: /rsu/info, /rsu/measurements, the IMU and the truth.

    Returns
    -------
    messages per topic

    Raises
    ------
    BagError  missing folder or file, or a line that cannot be understood
    FileExistsError  ``bag`` exists
    ValueError  numbers of stations out of range
    """
    drive = load_car_drive(path, mount)
    simulated = station_drive(drive, fewest=fewest, nearest=nearest, seed=seed)
    height_m = float(simulated.antenna[0, 2])
    source = f"car-imu-rtk {Path(path).name}, simulated stations {fewest}-{nearest}, seed {seed}"
    return write_values(
        bag,
        rsus=simulated.stations,
        measurements=measurements_of(
            simulated.seen, simulated.stations, simulated.stamps_ns, VUE, drive.lever_arm_m
        ),
        truth=truth_of(drive, VUE),
        imu=imu_samples(drive, VUE),
        tracker={**drive.tracker, "device_height_m": height_m},
        metadata={"source": source},
    )
