"""deng2022's drives: one seed through least squares and the strapdown filter; sums over many."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from netpos.evaluation.consistency import MeanTest, chi2_mean_bounds, effective_size, nees
from netpos.evaluation.metrics import NS
from netpos.evaluation.reproduce.frame import Work
from netpos.evaluation.reproduce.rows import RowTemplates, observation_rows
from netpos.filters.error_state import UNCONSTRAINED, Imu
from netpos.filters.measurement import LEVER
from netpos.filters.motion import SPEED_OF_LIGHT_MPS
from netpos.filters.position_fix import FixStatus
from netpos.filters.space import CLOCK, place_rows
from netpos.messages.values import Array
from netpos.radio.noise import generator
from netpos.scenario import Simulation, load_scenario
from netpos.tracking.config import TrackerConfig
from netpos.tracking.models import gate_thresholds
from netpos.tracking.strapdown_engine import Drive, Epochs, Fixes, drive, fix_each
from netpos.tracking.strapdown_models import nav_of, sensors_of, start_sd, with_clock

VUE = "vue_1"
SCENARIO = "blocked_5g_drive"
HEIGHT_SD_M = 3.0
"""How well the height of a car's antenna is known without measuring it, where that is used."""
OUTAGE_EVERY_S = 60
ALL_ANGLES = ("azimuth", "elevation", "range")
# Of the state handed to the filter at the start, which the paper takes as known: position [m],
# velocity [m/s], roll and pitch, heading [rad].
START_SD = (1.0, 0.1, float(np.radians(0.2)), float(np.radians(1.0)))

FIX, FIX_HEIGHT, LOOSE, LOOSE_DIAGONAL, LOOSE_FIXED, TIGHT, VEHICLE = (
    "least squares",
    "least squares, height known to 3 m",
    "loose",
    "loose, variances alone",
    "loose, one covariance for all",
    "tight",
    "tight, vehicle constraints",
)
VARIANTS = (FIX, FIX_HEIGHT, LOOSE, LOOSE_DIAGONAL, LOOSE_FIXED, TIGHT, VEHICLE)
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
        """Times of arrival by the device's clock, of which nothing is known."""
        return "toa" in self.quantities


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One seed of a case: epochs, the truth of base_link and of the antenna, and what became of
    it.

    position (N, 3), velocity (N, 3) and attitude of base_link, antenna (N, 3); heard (N,) whether
    any station did; clock_m (N,) offset of its clock; fixes by variant; drives by variant
    """

    stamps_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    position: Array
    velocity: Array
    attitude: Rotation
    antenna: Array
    heard: np.ndarray[tuple[int], np.dtype[np.bool_]]
    clock_m: Array
    fixes: dict[str, Fixes]
    drives: dict[str, Drive]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """Sums over the epochs of some runs, of one variant. square: north, east, down error^2 [m^2];
    solved of n epochs; nees: its sums for position (3), position, velocity, attitude (9) and the
    clock's offset (1); outage_m: (k, 2) horizontal and 3-D errors at the end of the outages;
    clock_m2: error^2 and variance of the clock's offset [m^2]. Without a clock its sums are 0."""

    n: int
    solved: int
    square: Array
    nees: Array
    n_eff: Array
    outage_m: Array
    clock_m2: Array

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            n=self.n + other.n,
            solved=self.solved + other.solved,
            square=self.square + other.square,
            nees=self.nees + other.nees,
            n_eff=self.n_eff + other.n_eff,
            outage_m=np.vstack([self.outage_m, other.outage_m]),
            clock_m2=self.clock_m2 + other.clock_m2,
        )

    @property
    def success_percent(self) -> float:
        """Share of epochs with a position."""
        return 100.0 * self.solved / self.n

    @property
    def rms_m(self) -> tuple[float, float, float]:
        """North, east, down, over the epochs with a position."""
        north, east, down = np.sqrt(self.square / self.solved).tolist()
        return north, east, down

    @property
    def clock_ns(self) -> tuple[float, float]:
        """RMS error of the clock's offset, and that its covariance says."""
        error, said = (1e9 / SPEED_OF_LIGHT_MPS * np.sqrt(self.clock_m2 / self.n)).tolist()
        return error, said

    def nees_test(self, states: int) -> MeanTest:
        """Mean NEES of the position (``states`` 3), of all but the biases (9) or of the clock's
        offset (1)."""
        which = {3: 0, 9: 1, 1: 2}[states]
        n_eff = float(self.n_eff[which])
        return MeanTest(
            mean=float(self.nees[which] / self.n),
            bounds=chi2_mean_bounds(states, n_eff),
            n_eff=n_eff,
        )


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


def epochs_of(simulation: Simulation, case: Case) -> Epochs:
    """Rows of all beacons; outages leave epochs without any."""
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


def loose_epochs(epochs: Epochs, fixes: Fixes, lever: tuple[float, float, float]) -> Epochs:
    """Epochs of position fixes in place of what they were made from (deng2022:eq.8), each with its
    covariance."""
    good = fixes.status == FixStatus.CONVERGED
    rows = place_rows(fixes.position[good], fixes.cov[good], lever)
    row_start = np.append(0, np.cumsum(3 * good.astype(np.int64)))
    return Epochs(epochs.stamps_ns, row_start, rows.reshape(-1, rows.shape[-1]))


def less_told(fixes: Fixes) -> dict[str, Fixes]:
    """The fixes with less said of each: its variances without their correlations, or the mean
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
    """State nav and covariance handed to the filters at the first beacon, wrong by a draw of
    it."""
    truth = simulation.truth(VUE, simulation.beacons(VUE).stamp_ns[:1])
    seed, sd = simulation.scenario.seed, start_sd(config, *START_SD)
    error = sd * generator(seed, f"{VUE}/start").standard_normal(sd.size)
    turned = Rotation.from_rotvec(error[6:9]) * truth.rotation[0]
    place, velocity = truth.position[0] + error[:3], truth.velocity[0] + error[3:6]
    nav, cov = nav_of(place, velocity, turned.as_quat()), np.diag(sd**2)
    return with_clock(config, nav, cov) if case.one_way else (nav, cov)


def run(case: Case, seed: int) -> Run:
    """One drive through every variant."""
    simulation, config = simulation_of(case).with_seed(seed), config_of(case)
    device = simulation.scenario.devices[0]
    epochs = epochs_of(simulation, case)
    truth = simulation.truth(VUE, epochs.stamps_ns)
    height_m = device.antenna_height_m + device.lever_arm_m[2]
    fixes = {
        FIX: fix_each(epochs, height_m, 0.0),
        FIX_HEIGHT: fix_each(epochs, height_m, HEIGHT_SD_M),
    }
    sensors, gate = sensors_of(config), gate_thresholds(config.gate_probability)
    free = sensors._replace(constraints=UNCONSTRAINED)
    begin, imu = (int(epochs.stamps_ns[0]), *started(simulation, case, config)), imu_of(simulation)
    taken = {TIGHT: (epochs, free), VEHICLE: (epochs, sensors)}
    loose = {} if case.one_way else {LOOSE: fixes[FIX]}
    if case.nearest <= FEW_STATIONS and loose:
        loose |= less_told(fixes[FIX])
    for name, told in loose.items():
        taken[name] = (loose_epochs(epochs, told, device.lever_arm_m), free)
    return Run(
        stamps_ns=epochs.stamps_ns,
        position=truth.position,
        velocity=truth.velocity,
        attitude=truth.rotation,
        antenna=truth.position + truth.rotation.apply(device.lever_arm_m),
        heard=np.diff(epochs.row_start) > 0,
        clock_m=SPEED_OF_LIGHT_MPS * simulation.beacons(VUE).clock_offset_s,
        fixes=fixes,
        drives={name: drive(*begin, imu, which, by, gate) for name, (which, by) in taken.items()},
    )


def ned(error: Array) -> Array:
    """North, east, down (..., 3) of an error in map."""
    return np.stack([error[..., 1], error[..., 0], -error[..., 2]], axis=-1)


def _tally_fixes(done: Run, fixes: Fixes) -> Tally:
    good = fixes.status == FixStatus.CONVERGED
    error = ned(fixes.position - done.antenna)[good]
    return Tally(
        n=good.size,
        solved=int(good.sum()),
        square=(error**2).sum(axis=0),
        nees=np.zeros(3),
        n_eff=np.zeros(3),
        outage_m=np.zeros((0, 2)),
        clock_m2=np.zeros(2),
    )


def error_of(done: Run, result: Drive) -> Array:
    """(N, 9) position, velocity and attitude, estimate minus truth in the filter's terms."""
    turned = Rotation.from_quat(result.nav[:, 6:10]) * done.attitude.inv()
    return np.hstack(
        [
            result.nav[:, :3] - done.position,
            result.nav[:, 3:6] - done.velocity,
            turned.as_rotvec(),
        ]
    )


def _tally_drive(done: Run, result: Drive) -> Tally:
    error = error_of(done, result)
    values = [nees(error[:, :k], result.cov[:, :k, :k])[0] for k in (3, 9)]
    offset, offset_var = _clock(done, result)
    values.append(nees(offset[:, None], offset_var[:, None, None])[0])
    silent = ~done.heard
    ends = np.flatnonzero(silent[:-1] & done.heard[1:])
    ends = ends[ends >= OUTAGE_EVERY_S // 2]  # of whole outages
    at_end = [np.linalg.norm(error[ends, :k], axis=1) for k in (2, 3)]
    return Tally(
        n=len(error),
        solved=int(np.isfinite(error).all(axis=1).sum()),
        square=(ned(error[:, :3]) ** 2).sum(axis=0),
        nees=np.array([v.sum() for v in values]),
        n_eff=np.array([effective_size(v) if v.size else 0.0 for v in values]),
        outage_m=np.column_stack(at_end),
        clock_m2=np.array([(offset**2).sum(), offset_var.sum()]),
    )


def _clock(done: Run, result: Drive) -> tuple[Array, Array]:
    """(N,) error [m] and variance [m^2] of the clock's offset; 0 without one."""
    if result.cov.shape[1] <= CLOCK:
        return np.zeros(len(result.nav)), np.zeros(len(result.nav))
    return result.nav[:, CLOCK + 1] - done.clock_m, result.cov[:, CLOCK, CLOCK]


def tally_seeds(case: Case, seeds: range) -> dict[str, Tally]:
    """Sums over some seeds, by variant."""
    total: dict[str, Tally] = {}
    for seed in seeds:
        done = run(case, seed)
        parts = {name: _tally_fixes(done, fixes) for name, fixes in done.fixes.items()}
        parts |= {name: _tally_drive(done, result) for name, result in done.drives.items()}
        for name, part in parts.items():
            total[name] = total[name] + part if name in total else part
    return total


def over_seeds(work: Work, case: Case) -> dict[str, Tally]:
    """Sums over all seeds of the work, by variant."""
    jobs = work.over_seeds(case.name, tally_seeds, case)
    total = jobs[0]
    for job in jobs[1:]:
        total = {name: total[name] + job[name] for name in total}
    return total
