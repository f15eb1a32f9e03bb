"""deng2022's drives: one seed through least squares and the strapdown filter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.estimation.engine import Epochs
from netpos.estimation.fixes.position_fix import FixStatus
from netpos.estimation.measurement import LEVER
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.spatial.error_state import UNCONSTRAINED, Imu
from netpos.estimation.spatial.space import place_rows
from netpos.estimation.state import ERR_ATTITUDE, ERR_POSITION, ERR_VELOCITY
from netpos.evaluation.metrics import NS
from netpos.evaluation.pairing import Mask
from netpos.messages.values import Array, RsuInfo
from netpos.radio.noise import generator
from netpos.reproduction.deng2022.drives import Drive, Fixes, drive, fix_each
from netpos.reproduction.rows import RowTemplates, observation_rows
from netpos.scenario import Simulation, load_scenario
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import gate_thresholds
from netpos.tracking.estimators.strapdown_models import nav_of, sensors_of, start_sd, with_clock

VUE = "vue_1"
SCENARIO = "blocked_5g_drive"
HEIGHT_SD_M = 3.0
"""How well the height of a car's antenna is known without measuring it, where that is used."""
MAST_M = 10.0
"""Usual height of a station above the street: the mean of the paper's 5 to 15 m."""
OUTAGE_EVERY_S = 60
ALL_ANGLES = ("azimuth", "elevation", "range")
# Of the state handed to the filter at the start, which the paper takes as known: position [m],
# velocity [m/s], roll and pitch, heading [rad].
START_SD = (1.0, 0.1, float(np.radians(0.2)), float(np.radians(1.0)))

FIX, FIX_HEIGHT, LOOSE, LOOSE_DIAGONAL, LOOSE_FIXED, TIGHT, VEHICLE, DEFAULT, DEFAULT_VEHICLE = (
    "least squares",
    "least squares, height known to 3 m",
    "loose",
    "loose, variances alone",
    "loose, one covariance for all",
    "tight",
    "tight, vehicle constraints",
    "tight, default parameters",
    "tight, default IMU noise, vehicle constraints",
)
RANGE_SD_M = 1.0
FEW_STATIONS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """What the stations measure, and how many of them hear the vehicle; ``outage_s``: nobody hears
    it for so long in every minute."""

    name: str
    quantities: tuple[str, ...]
    fewest: int
    nearest: int
    outage_s: int = 0

    @property
    def one_way(self) -> bool:
        """Times of arrival by the device's clock, whose offset is unknown."""
        return "toa" in self.quantities


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One seed of a case: epochs, the truth of base_link and of the antenna, and what became of
    it.

    position (N, 3), velocity (N, 3) and attitude of base_link, antenna (N, 3); silence_end (N,)
    the predictions at the end of outages, see ``with_silence_ends``; clock_m (N,) offset of its
    clock; fixes by variant; epochs and drives by variant
    """

    stamps_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    position: Array
    velocity: Array
    attitude: Rotation
    antenna: Array
    silence_end: Mask
    clock_m: Array
    fixes: dict[str, Fixes]
    epochs: dict[str, Epochs]
    drives: dict[str, Drive]


@lru_cache(maxsize=8)
def simulation_of(case: Case) -> Simulation:
    """The scenario with what the case changes, under its own seed."""
    return Simulation(load_scenario(SCENARIO, changes=changes_of(case)))


def changes_of(case: Case) -> dict[str, Any]:
    """What the case changes in the scenario."""
    changes = {
        "measurement.quantities": list(case.quantities),
        "measurement.fewest": case.fewest,
        "measurement.nearest": case.nearest,
    }
    if case.one_way:
        changes["measurement.errors.toa_sd_s"] = RANGE_SD_M / SPEED_OF_LIGHT_MPS
    return changes


def config_of(case: Case) -> TrackerConfig:
    """The scenario's own tracker parameters, and those of the clock."""
    scenario = simulation_of(case).scenario
    device = scenario.devices[0]
    white, walk = device.clock.densities(device.beacon_interval_s)
    parameters = {"clock_white_density": white, "clock_walk_density": walk}
    return TrackerConfig.from_mapping({**scenario.tracker, **parameters})


def default_config() -> TrackerConfig:
    """Parameters of a user who sets only the motion model: the library's noise of the
    IMU and of the clock, no vehicle constraints."""
    return TrackerConfig(motion_model="strapdown")


def epochs_of(simulation: Simulation, case: Case) -> Epochs:
    """Rows of all beacons. An outage leaves epochs without any: from the last beacon that is heard
    to the next one are ``outage_s`` seconds."""
    beacons = simulation.beacons(VUE)
    seen = simulation.observations(VUE)
    if case.outage_s:
        second = (beacons.stamp_ns - beacons.stamp_ns[0]) // int(NS)
        silent = (second % OUTAGE_EVERY_S) > OUTAGE_EVERY_S - case.outage_s
        seen = seen._replace(heard_by=np.where(silent, 0, seen.heard_by))
    templates = RowTemplates.of(simulation.rsus, simulation.fields)
    heard, row_start, rows, _ = observation_rows(seen, templates, 0)  # without slow errors
    rows[:, LEVER : LEVER + 3] = simulation.scenario.devices[0].lever_arm_m
    counts = np.zeros(beacons.stamp_ns.size, dtype=np.int64)
    counts[heard] = np.diff(row_start)
    return Epochs(beacons.stamp_ns, np.append(0, np.cumsum(counts)), rows)


def with_silence_ends(epochs: Epochs) -> Epochs:
    """The same epochs, and before each that ends a silence one of the same stamp without rows.

    What a filter says there is its prediction after the whole silence, just before it uses the
    first measurement.
    """
    rows = np.diff(epochs.row_start)
    first = np.flatnonzero((rows[:-1] == 0) & (rows[1:] > 0)) + 1
    row_start = np.append(0, np.cumsum(np.insert(rows, first, 0)))
    stamps = np.insert(epochs.stamps_ns, first, epochs.stamps_ns[first])
    return Epochs(stamps, row_start, epochs.rows)


def silence_ends(epochs: Epochs) -> Mask:
    """(N,) which of the epochs ``with_silence_ends`` has added."""
    return np.append(np.diff(epochs.stamps_ns) == 0, [False])


def ground_height_m(stations: tuple[RsuInfo, ...]) -> float:
    """Start height of fixes without a known height: the street, by the usual height of masts."""
    return float(np.mean([info.position[2] for info in stations])) - MAST_M


def fixes_of(simulation: Simulation, epochs: Epochs) -> dict[str, Fixes]:
    """Least squares without a height, as in the paper, and with the usual height of the antenna:
    wrong by one draw a drive, since an error of the map or of the car does not change on the
    way."""
    device = simulation.scenario.devices[0]
    wrong_m = HEIGHT_SD_M * generator(simulation.scenario.seed, f"{VUE}/height").standard_normal()
    known_m = device.antenna_height_m + device.lever_arm_m[2] + wrong_m
    return {
        FIX: fix_each(epochs, ground_height_m(simulation.rsus), 0.0),
        FIX_HEIGHT: fix_each(epochs, known_m, HEIGHT_SD_M),
    }


def loose_epochs(epochs: Epochs, fixes: Fixes, lever: tuple[float, float, float]) -> Epochs:
    """Epochs of position fixes, each with its covariance, instead of the measurements they were
    made from (deng2022:eq.8)."""
    good = fixes.status == FixStatus.CONVERGED
    rows = place_rows(fixes.position[good], fixes.cov[good], lever)
    row_start = np.append(0, np.cumsum(3 * good.astype(np.int64)))
    return Epochs(epochs.stamps_ns, row_start, rows.reshape(-1, rows.shape[-1]))


def reduced_covariances(fixes: Fixes) -> dict[str, Fixes]:
    """The fixes with a reduced covariance: variances without correlations, or the mean
    covariance of all."""
    good = fixes.status == FixStatus.CONVERGED
    mean = np.broadcast_to(fixes.cov[good].mean(axis=0), fixes.cov.shape)
    return {
        LOOSE_DIAGONAL: fixes._replace(cov=fixes.cov * np.eye(3)),
        LOOSE_FIXED: fixes._replace(cov=mean),
    }


def imu_of(simulation: Simulation) -> Imu:
    """All samples of the device."""
    samples = simulation.imu_arrays(VUE)
    return Imu(samples.stamp_ns, np.hstack([samples.angular_velocity, samples.specific_force]))


def started(simulation: Simulation, case: Case, config: TrackerConfig) -> tuple[Array, Array]:
    """Start of the filters at the first beacon: a covariance, and the true state plus a draw
    from it."""
    truth = simulation.truth(VUE, simulation.beacons(VUE).stamp_ns[:1])
    seed, sd = simulation.scenario.seed, start_sd(config, *START_SD)
    error = sd * generator(seed, f"{VUE}/start").standard_normal(sd.size)
    turned = Rotation.from_rotvec(error[ERR_ATTITUDE]) * truth.rotation[0]
    position, velocity = (
        truth.position[0] + error[ERR_POSITION],
        truth.velocity[0] + error[ERR_VELOCITY],
    )
    nav, cov = nav_of(position, velocity, turned.as_quat()), np.diag(sd**2)
    return with_clock(config, nav, cov) if case.one_way else (nav, cov)


def run(case: Case, seed: int) -> Run:
    """One drive through every variant."""
    simulation = simulation_of(case).with_seed(seed)
    epochs, beacons = with_silence_ends(epochs_of(simulation, case)), simulation.beacons(VUE)
    truth = simulation.truth(VUE, epochs.stamps_ns)
    lever, fixes = simulation.scenario.devices[0].lever_arm_m, fixes_of(simulation, epochs)
    of_beacon = np.searchsorted(beacons.stamp_ns, epochs.stamps_ns)
    inputs = {TIGHT: epochs, VEHICLE: epochs, DEFAULT: epochs, DEFAULT_VEHICLE: epochs}
    loose = {} if case.one_way else {LOOSE: fixes[FIX]}
    if case.nearest <= FEW_STATIONS and loose:
        loose |= reduced_covariances(fixes[FIX])
    inputs |= {name: loose_epochs(epochs, used, lever) for name, used in loose.items()}
    return Run(
        stamps_ns=epochs.stamps_ns,
        position=truth.position,
        velocity=truth.velocity,
        attitude=truth.rotation,
        antenna=truth.position + truth.rotation.apply(lever),
        silence_end=silence_ends(epochs),
        clock_m=SPEED_OF_LIGHT_MPS * beacons.clock_offset_s[of_beacon],
        fixes=fixes,
        epochs=inputs,
        drives=_drives(simulation, case, inputs),
    )


def _drives(simulation: Simulation, case: Case, inputs: dict[str, Epochs]) -> dict[str, Drive]:
    """The filter of each variant on its epochs. All start from one state, each as uncertain as its
    parameters say."""
    imu, known, unset = imu_of(simulation), config_of(case), default_config()
    drives = {}
    for name, epochs in inputs.items():
        config = unset if name in (DEFAULT, DEFAULT_VEHICLE) else known
        sensors = sensors_of(config)._replace(constraints=UNCONSTRAINED)
        if name in (VEHICLE, DEFAULT_VEHICLE):
            sensors = sensors._replace(constraints=sensors_of(known).constraints)
        begin = (int(epochs.stamps_ns[0]), *started(simulation, case, config))
        gate = gate_thresholds(config.gate_probability)
        drives[name] = drive(*begin, imu, epochs, sensors, gate)
    return drives


def ned(error: Array) -> Array:
    """North, east, down (..., 3) of an error in map."""
    return np.stack([error[..., 1], error[..., 0], -error[..., 2]], axis=-1)
