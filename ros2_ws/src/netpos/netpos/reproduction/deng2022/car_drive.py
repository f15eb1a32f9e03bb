"""deng2022 on a real drive: the IMU and the way are real, the stations are simulated along it; and
the error of the IMU alone while the aid, RTK, is withheld."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.bags.importers.car_imu_rtk import MOUNT, CarDrive, imu_samples, load_car_drive
from netpos.bags.importers.common import recordings
from netpos.estimation.engine import Epochs
from netpos.estimation.measurement import LEVER
from netpos.estimation.spatial.error_state import UNCONSTRAINED, Imu, Sensors
from netpos.estimation.spatial.space import place_rows
from netpos.estimation.state import NAV_POSITION, NAV_QUATERNION
from netpos.evaluation.metrics import NS
from netpos.messages.values import Array
from netpos.reproduction.deng2022.blocked_drive import (
    DEFAULT,
    LOOSE,
    TIGHT,
    VEHICLE,
    Case,
    default_config,
    ground_height_m,
    loose_epochs,
    ned,
)
from netpos.reproduction.deng2022.drives import Drive, drive, fix_each
from netpos.reproduction.deng2022.tally import Tally, added, is_lost, tally_errors
from netpos.reproduction.rows import RowTemplates, observation_rows
from netpos.scenario.along_path import FIELDS
from netpos.scenario.recorded_drive import VUE, station_drive
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.imu_buffer import ImuBuffer
from netpos.tracking.estimators.models import gate_thresholds
from netpos.tracking.estimators.strapdown_models import sensors_of
from netpos.tracking.first_fix.strapdown_start import StrapdownStart

RECORDING = "car_imu_rtk"
SEEDS = 20
"""Most seeds of the stations: the drive itself is one."""
RTK_SD_M = (0.03, 0.03, 0.05)
OUTAGE_S = 30.0
OUTAGE_EVERY_S = 10.0
SETTLE_S = 30.0
_SKIP = 20  # epochs after the start that do not count, as in netpos evaluate


Start = tuple[int, Array, Array]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The drive, what a tracker needs of it, and its state (stamp, nav, cov) once RTK and IMU have
    determined the heading; ``unset``: sensors and start by the library's default parameters."""

    drive: CarDrive
    imu: Imu
    config: TrackerConfig
    sensors: Sensors
    gate: Array
    start: Start
    unset: tuple[Sensors, Start]


@lru_cache(maxsize=1)
def recording() -> Recording | None:
    """The recording, ready to run; None where it is absent."""
    folder = recordings(RECORDING)
    if folder is None:
        return None
    drive = load_car_drive(Path(folder))
    config, unset = TrackerConfig.from_mapping(drive.tracker), default_config()
    return Recording(
        drive=drive,
        imu=Imu(drive.imu_ns, drive.rates),
        config=config,
        sensors=sensors_of(config),
        gate=gate_thresholds(config.gate_probability),
        start=_aligned(drive, config),
        unset=(sensors_of(unset), _aligned(drive, unset)),
    )


def _aligned(drive: CarDrive, config: TrackerConfig) -> Start:
    """Coarse alignment from rest, by RTK."""
    start, samples = StrapdownStart(config), ImuBuffer()
    pending = iter(imu_samples(drive, VUE))
    cov, lever = np.diag(np.square(RTK_SD_M)), np.array(MOUNT.lever_arm_m)
    for stamp, position in zip(drive.rtk_ns.tolist(), drive.antenna, strict=True):
        if stamp < drive.imu_ns[0]:
            continue
        for sample in pending:
            samples.add(sample)
            if sample.stamp_ns >= stamp:
                break
        start.add_fix(stamp, position, cov, lever)
        solution = start.solve(samples)
        if solution is not None:
            return solution
    raise ValueError(f"{RECORDING}: no heading found; does the recording move?")


def _variants(known: Recording) -> dict[str, tuple[Sensors, Start]]:
    """Variants of the tight coupling: parameters of the filter, and its start."""
    free = known.sensors._replace(constraints=UNCONSTRAINED)
    return {
        TIGHT: (free, known.start),
        VEHICLE: (known.sensors, known.start),
        DEFAULT: known.unset,
    }


def station_tally(case: Case, seed: int) -> dict[str, Tally]:
    """Errors of the antenna against RTK, by coupling."""
    known = recording()
    assert known is not None
    simulated = station_drive(known.drive, fewest=case.fewest, nearest=case.nearest, seed=seed)
    templates = RowTemplates.of(simulated.stations, FIELDS)
    heard, row_start, rows, _ = observation_rows(simulated.seen, templates, 0)
    rows[:, LEVER : LEVER + 3] = MOUNT.lever_arm_m
    after = simulated.stamps_ns[heard] > known.start[0]
    first = int(np.argmax(after))
    epochs = Epochs(simulated.stamps_ns[heard][first:], row_start[first:], rows)
    fixes = fix_each(epochs, ground_height_m(simulated.stations), 0.0)
    variants = _variants(known)
    inputs = dict.fromkeys(variants, epochs)
    variants[LOOSE], inputs[LOOSE] = (
        variants[TIGHT],
        loose_epochs(epochs, fixes, MOUNT.lever_arm_m),
    )
    truth, tallies = simulated.antenna[heard][first:], {}
    for name, variant in variants.items():
        done = _run(known, inputs[name], *variant)
        error = ned(_antenna(done.nav) - truth)[_SKIP:]
        tallies[name] = tally_errors(error, lost=is_lost(inputs[name], done))
    return tallies


def _run(known: Recording, epochs: Epochs, sensors: Sensors, start: Start) -> Drive:
    result: Drive = drive(*start, known.imu, epochs, sensors, known.gate)
    return result


def _antenna(nav: Array) -> Array:
    """(n, 3) of states (n, NAV)."""
    return np.asarray(
        nav[:, NAV_POSITION] + Rotation.from_quat(nav[:, NAV_QUATERNION]).apply(MOUNT.lever_arm_m)
    )


def station_seeds(case: Case, seeds: range) -> dict[str, Tally]:
    """Sums over some seeds, by coupling."""
    return added([station_tally(case, seed) for seed in seeds])


@dataclass(frozen=True, slots=True, eq=False)
class Outages:
    """Horizontal errors [m] while nothing aids the IMU: error (outages, k) at time_s (k,) after
    the last RTK solution."""

    time_s: Array
    error: Array

    def at(self, seconds: float) -> Array:
        """(outages,) errors [m] after ``seconds``."""
        return np.asarray(self.error[:, int(np.argmin(np.abs(self.time_s - seconds)))])


def outages(variant: str) -> Outages:
    """``outages_with`` the parameters of the filter."""
    known = recording()
    assert known is not None
    return outages_with(*_variants(known)[variant])


def outages_with(sensors: Sensors, start: Start) -> Outages:
    """RTK aids the filter, and is withheld for 30 s, again and again, each time from the aided
    state."""
    known = recording()
    assert known is not None
    used = (known.drive.rtk_ns > known.start[0]) & (known.drive.rtk_ns <= known.imu.stamps_ns[-1])
    stamps, antenna = known.drive.rtk_ns[used], known.drive.antenna[used]
    cov = np.tile(np.diag(np.square(RTK_SD_M)), (len(stamps), 1, 1))
    rows = place_rows(antenna, cov, MOUNT.lever_arm_m)
    row_start = np.arange(len(stamps) + 1) * 3
    aiding = Epochs(stamps, row_start, rows.reshape(-1, rows.shape[-1]))
    aided = _run(known, aiding, sensors, start)
    elapsed = (stamps - stamps[0]) / NS
    grid = np.arange(0.0, OUTAGE_S + 0.1, 0.25)
    curves = []
    for begin in np.arange(SETTLE_S, elapsed[-1] - OUTAGE_S, OUTAGE_EVERY_S):
        k = int(np.searchsorted(elapsed, begin))
        inside = (elapsed > elapsed[k]) & (elapsed <= elapsed[k] + OUTAGE_S + 0.3)
        silent = Epochs(stamps[inside], np.zeros(inside.sum() + 1, dtype=np.int64), rows[0, :0])
        coast = drive(
            int(stamps[k]), aided.nav[k], aided.cov[k], known.imu, silent, sensors, known.gate
        )
        error = np.linalg.norm((_antenna(coast.nav) - antenna[inside])[:, :2], axis=1)
        curves.append(np.interp(grid, elapsed[inside] - elapsed[k], error))
    return Outages(grid, np.array(curves))
