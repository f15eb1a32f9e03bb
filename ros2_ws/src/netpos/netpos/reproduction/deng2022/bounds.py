"""Bounds of all filters on deng2022's drives, dilution of their geometry, and smoothed outages.

The bound is the posterior Cramér-Rao bound along the true way: the covariance of a filter with
error-free measurements and IMU, so that it linearises at the truth, and with their real variances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from netpos.estimation.engine import Epochs
from netpos.estimation.measurement import ORIGIN, VALUE
from netpos.estimation.sensors.row import group_count
from netpos.estimation.spatial.error_state import (
    MEMORY,
    UNCONSTRAINED,
    Imu,
    Sensors,
    advance,
    correct,
)
from netpos.estimation.spatial.space import linearise_in_space
from netpos.estimation.state import NAV_POSITION
from netpos.evaluation.work import Work
from netpos.messages.values import Array
from netpos.reproduction.deng2022.blocked_drive import (
    SCENARIO,
    START_SD,
    TIGHT,
    VEHICLE,
    VUE,
    Case,
    changes_of,
    config_of,
    epochs_of,
    imu_of,
    silence_ends,
    simulation_of,
    started,
    with_silence_ends,
)
from netpos.reproduction.deng2022.drives import Drive, drive, smoothed_drive
from netpos.scenario import Simulation, load_scenario
from netpos.tracking.estimators.models import gate_thresholds
from netpos.tracking.estimators.strapdown_models import nav_of, sensors_of, start_sd

BOUND_RUNS = 20
"""The bound depends on who hears the vehicle alone: it hardly varies."""
SMOOTHED_RUNS = 10
EXACT = "exact vehicle constraints"
_EXACT_MPS = 0.01
_FREE_OF_ERRORS = {
    f"devices.0.imu.{name}": 0.0
    for name in (
        "gyro_noise_density_radps_sqrthz",
        "accel_noise_density_mps2_sqrthz",
        "gyro_bias_sd_radps",
        "accel_bias_sd_mps2",
    )
}


@dataclass(frozen=True, slots=True)
class Squares:
    """Sums of squares [m^2] of north, east, down over n epochs, and at the end of ``outages``."""

    n: int
    all: Array
    outages: int
    ends: Array

    def __add__(self, other: Squares) -> Squares:
        return Squares(
            self.n + other.n,
            self.all + other.all,
            self.outages + other.outages,
            self.ends + other.ends,
        )

    @property
    def rms_m(self) -> Array:
        """(3,) over all epochs."""
        return np.asarray(np.sqrt(self.all / self.n))

    @property
    def end_rms_m(self) -> Array:
        """(3,) at the end of the outages."""
        return np.asarray(np.sqrt(self.ends / self.outages))


def variants(sensors: Sensors) -> dict[str, Sensors]:
    """Parameters of the filter, by variant."""
    exact = sensors.constraints._replace(sideways_sd_mps=_EXACT_MPS, upwards_sd_mps=_EXACT_MPS)
    return {
        TIGHT: sensors._replace(constraints=UNCONSTRAINED),
        VEHICLE: sensors,
        EXACT: sensors._replace(constraints=exact),
    }


def true_states(simulation: Simulation, epochs: Epochs) -> Array:
    """(N, NAV) at the epochs."""
    truth = simulation.truth(VUE, epochs.stamps_ns)
    states = zip(truth.position, truth.velocity, truth.rotation.as_quat(), strict=True)
    return np.array([nav_of(*state) for state in states])


def on_the_way(epochs: Epochs, states: Array, cov: Array, imu: Imu, sensors: Sensors) -> Drive:
    """A filter from ``cov`` (n, n) whose rows and IMU have no errors, and which is put back on the
    true way, ``states`` (N, NAV), after each epoch; what it made of them before that."""
    navs, covs, dof = np.empty_like(states), np.empty((len(states), *cov.shape)), []
    P, memory, gate, before_ns = cov.copy(), np.zeros(MEMORY), gate_thresholds(1.0), None
    for i, (stamp_ns, first) in enumerate(zip(epochs.stamps_ns, epochs.row_start, strict=False)):
        nav = states[max(i - 1, 0)].copy()
        if before_ns is not None:
            advance(nav, P, memory, before_ns, stamp_ns, imu, sensors)
        rows, before_ns, used = epochs.rows[first : epochs.row_start[i + 1]].copy(), stamp_ns, 0
        if len(rows) > 0:
            rows[:, VALUE] -= linearise_in_space(rows, nav, P)[0]
            _, used = correct(nav, P, rows, gate, np.zeros(group_count(rows)))
        navs[i], covs[i] = nav, P
        dof.append(used)
    return Drive(navs, covs, np.zeros(len(states)), np.array(dof))


def bound_drives(case: Case, seed: int) -> tuple[Epochs, dict[str, Drive]]:
    """Filters that stay on the true way; their covariances are the bound."""
    changes = {**changes_of(case), **_FREE_OF_ERRORS}
    exact = Simulation(load_scenario(SCENARIO, seed=seed, changes=changes))
    config, cov = config_of(case), np.diag(start_sd(config_of(case), *START_SD) ** 2)
    epochs = with_silence_ends(epochs_of(simulation_of(case).with_seed(seed), case))
    states, imu = true_states(exact, epochs), imu_of(exact)
    return epochs, {
        name: on_the_way(epochs, states, cov, imu, by)
        for name, by in variants(sensors_of(config)).items()
    }


def _squares(epochs: Epochs, square: Array) -> Squares:
    """Of (N, 3) squares of east, north, up."""
    ends, ned = silence_ends(epochs), square[:, [1, 0, 2]]
    n = int(ends.sum())
    return Squares(len(ned) - n, ned[~ends].sum(axis=0), n, ned[ends].sum(axis=0))


def _bounds(case: Case, seeds: range) -> dict[str, Squares]:
    total: dict[str, Squares] = {}
    for seed in seeds:
        epochs, drives = bound_drives(case, seed)
        for name, done in drives.items():
            part = _squares(epochs, np.diagonal(done.cov, axis1=1, axis2=2)[:, :3])
            total[name] = total[name] + part if name in total else part
    return total


def dilution(epochs: Epochs, antenna: Array) -> Array:
    """Horizontal and vertical dilution of precision of ranges alone, (k, 2), of the epochs with at
    least three stations; antenna (N, 3) where it really was."""
    dilutions = []
    for position, first, last in zip(
        antenna, epochs.row_start, epochs.row_start[1:], strict=False
    ):
        if last - first >= 3:
            away = position - epochs.rows[first:last, ORIGIN : ORIGIN + 3]
            u = away / np.linalg.norm(away, axis=1)[:, None]
            var = np.diagonal(np.linalg.inv(u.T @ u))
            dilutions.append((np.sqrt(var[0] + var[1]), np.sqrt(var[2])))
    return np.array(dilutions).reshape(-1, 2)


def _dilutions(case: Case, seeds: range) -> tuple[int, Array]:
    n, total = 0, np.zeros(2)
    for seed in seeds:
        simulation = simulation_of(case).with_seed(seed)
        epochs = epochs_of(simulation, case)
        truth = simulation.truth(VUE, epochs.stamps_ns)
        lever = simulation.scenario.devices[0].lever_arm_m
        dilutions = dilution(epochs, truth.position + truth.rotation.apply(lever))
        n, total = n + len(dilutions), total + dilutions.sum(axis=0)
    return n, total


def _smoothed(case: Case, seeds: range) -> dict[str, Squares]:
    """Errors inside the outages alone, filtered ("... filtered") and smoothed."""
    config, total = config_of(case), dict[str, Squares]()
    gate = gate_thresholds(config.gate_probability)
    for seed in seeds:
        simulation = simulation_of(case).with_seed(seed)
        epochs, imu = epochs_of(simulation, case), imu_of(simulation)
        begin = (int(epochs.stamps_ns[0]), *started(simulation, case, config))
        truth = simulation.truth(VUE, epochs.stamps_ns).position
        silent = np.diff(epochs.row_start) == 0
        for name, by in variants(sensors_of(config)).items():
            if name == EXACT:
                continue
            filtered = drive(*begin, imu, epochs, by, gate).nav
            smoothed, _ = smoothed_drive(*begin, imu, epochs, by, gate)
            for what, nav in ((f"{name}, filtered", filtered), (f"{name}, smoothed", smoothed)):
                square = ((nav[:, NAV_POSITION] - truth) ** 2)[silent][:, [1, 0, 2]]
                part = Squares(len(square), square.sum(axis=0), 0, np.zeros(3))
                total[what] = total[what] + part if what in total else part
    return total


def _added(parts: list[dict[str, Squares]]) -> dict[str, Squares]:
    total = parts[0]
    for part in parts[1:]:
        total = {name: total[name] + part[name] for name in total}
    return total


def bounds(work: Work, case: Case) -> dict[str, Squares]:
    """The bound by variant: squares of the smallest standard deviations."""
    few = work.with_runs(min(work.runs, BOUND_RUNS))
    return _added(few.over_seeds(f"bound, {case.name}", _bounds, case))


def mean_dilution(work: Work, case: Case) -> tuple[float, float]:
    """Mean horizontal and vertical dilution of precision of a case that measures ranges alone."""
    few = work.with_runs(min(work.runs, BOUND_RUNS))
    parts = few.over_seeds(f"geometry, {case.name}", _dilutions, case)
    n, total = sum(part[0] for part in parts), np.sum([part[1] for part in parts], axis=0)
    return float(total[0] / n), float(total[1] / n)


def in_outages(work: Work, case: Case) -> dict[str, Squares]:
    """Errors inside the outages, by variant, filtered and smoothed."""
    few = work.with_runs(min(work.runs, SMOOTHED_RUNS))
    return _added(few.over_seeds(f"smoothed, {case.name}", _smoothed, case))
